"""Grasps from files of other tools: what is read, what it means, and what is refused."""

import json
import pickle
import struct
import zipfile

import numpy as np
import pytest
from command import refused, tog
from hypothesis import given, settings
from hypothesis import strategies as st
from tabletop import HAMMER_SIZED, RED, TABLE, look
from things import box, cloud, moved

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import InputError, NoGrasp
from tog_drake.grasp_check import check_grasps
from tog_drake.panda import MAX_OPENING
from tog_drake.pipeline import PipelineConfig, make_proposer
from tog_drake.proposers.antipodal import Antipodal, AntipodalProposer
from tog_drake.proposers.file import File, FileProposer
from tog_drake.proposers.grasp_document import GRIPPERS, MAX_GRASPS, NAMES
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import View, Workspace

BAR = box((-0.10, -0.012, 0.004), (0.10, 0.012, 0.031))  # 24 mm wide along y, its top at 31 mm
SEEN = cloud((BAR, (150, 0, 0)))
NO_VIEW = View.empty()


def above(x=0.0, z=0.026, yaw=0.0):
    """X_WG that comes from above at x, and closes along y of W where yaw is 0 [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    X_WG = np.eye(4)
    X_WG[:3] = [[-c, -s, 0, x], [-s, c, 0, 0], [0, 0, -1, z]]
    return X_WG


def document(**changes):
    """Two grasps of the bar, the worse one first; None leaves an entry out."""
    content = {
        "poses": np.stack([above(0.05), above(-0.05)]),
        "scores": np.array([0.5, 0.75]),
        "frame": "world",
        "gripper": "G",
    }
    return {k: v for k, v in {**content, **changes}.items() if v is not None}


def write_json(path, content):
    lists = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in content.items()}
    path.write_text(json.dumps(lists), encoding="utf-8")
    return path


def write_npz(path, content):
    np.savez(path, **content)
    return path


WRITERS = {"g.json": write_json, "g.npz": write_npz}


def proposed(path, view=NO_VIEW, seen=SEEN, **declared):
    return FileProposer(File(str(path), **declared)).propose(seen, view)


@pytest.mark.parametrize("name", WRITERS)
def test_grasps_come_out_best_first_as_they_were_written(name, tmp_path):
    widths, contacts = np.array([0.024, 0.02]), np.array([[0.05, 0.01, 0.02], [-0.05, 0.01, 0.02]])
    path = WRITERS[name](tmp_path / name, document(widths=widths, contacts=contacts))
    grasps = proposed(path)
    assert grasps.score.tolist() == [0.75, 0.5]
    assert grasps.width.tolist() == [0.02, 0.024]
    np.testing.assert_array_equal(grasps.X_WG, [above(-0.05), above(0.05)])
    np.testing.assert_array_equal(grasps.p_WContact, contacts[::-1])


def test_a_missing_width_is_measured_and_a_missing_contact_is_where_a_pad_meets_the_bar(tmp_path):
    grasps = proposed(write_json(tmp_path / "g.json", document()))
    assert grasps.width == pytest.approx(0.024, abs=1e-6)
    for X_WG, contact in zip(grasps.X_WG, grasps.p_WContact, strict=True):
        x, y, z = (contact - X_WG[:3, 3]) @ X_WG[:3, :3]
        assert abs(y) == pytest.approx(0.012, abs=1e-6)  # on one of the two sides
        assert max(abs(x), abs(z)) < 0.003  # at the middle of the pad


@pytest.mark.parametrize("yaw", [0.0, 0.5, np.pi / 2])
@pytest.mark.parametrize("gripper", ["G", "franka_hand", "contact_graspnet"])
def test_every_gripper_means_the_same_hand_about_the_same_bar(gripper, yaw, tmp_path):
    X_WG = above(yaw=yaw)
    # The bases of the two hands, written down from their descriptions and not from the table that
    # is tested: 0.1034 m behind G along the approach; the network's x closes.
    x, y, z, p = X_WG[:3].T
    base = p - 0.1034 * z
    axes = {"G": (x, y, z, p), "franka_hand": (x, y, z, base), "contact_graspnet": (y, -x, z, base)}
    pose = np.eye(4)
    pose[:3] = np.stack(axes[gripper], axis=-1)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    content = document(poses=pose[None], scores=np.ones(1), gripper=gripper)
    (found,) = proposed(write_json(tmp_path / "g.json", content)).X_WG
    np.testing.assert_allclose(found, X_WG, atol=1e-12)


def test_the_cameras_frame_is_turned_and_moved_into_the_world(tmp_path):
    view = look([TABLE, ((-0.1, -0.012, 0.0), (0.1, 0.012, 0.031), RED)], eye=(-0.2, 0.1, 0.5))
    X_CW = np.linalg.inv(view.X_WC)
    contact = np.array([[0.0, 0.012, 0.026]])
    content = document(
        poses=(X_CW @ above())[None],
        scores=np.ones(1),
        contacts=contact @ X_CW[:3, :3].T + X_CW[:3, 3],
        frame="camera",
    )
    grasps = proposed(write_json(tmp_path / "g.json", content), view)
    np.testing.assert_allclose(grasps.X_WG, above()[None], atol=1e-12)
    np.testing.assert_allclose(grasps.p_WContact, contact, atol=1e-12)


def test_grasps_of_single_precision_become_true_rotations(tmp_path):
    poses = document()["poses"].astype(np.float32)
    poses[:, :3, :3] += np.float32(1e-4)
    grasps = proposed(write_npz(tmp_path / "g.npz", document(poses=poses)))
    for X in grasps.X_WG:
        np.testing.assert_allclose(X[:3, :3] @ X[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(grasps.X_WG, [above(-0.05), above(0.05)], atol=2e-4)


def test_a_grasp_with_nothing_between_its_fingers_is_dropped(tmp_path):
    content = document(poses=np.stack([above(0.05), above(0.5)]))
    assert proposed(write_json(tmp_path / "g.json", content)).score.tolist() == [0.5]


def test_where_no_grasp_holds_anything_it_says_what_may_be_wrong(tmp_path):
    path = write_json(tmp_path / "g.json", document(gripper="franka_hand"))
    with pytest.raises(NoGrasp, match=r"g\.json: 2 of the 2 grasps .*'world'.*'franka_hand'"):
        proposed(path)
    with pytest.raises(NoGrasp, match="holds no grasps"):
        proposed(write_json(path, document(poses=np.zeros((0, 4, 4)), scores=np.zeros(0))))
    with pytest.raises(NoGrasp, match="2 of the 2 grasps"):
        proposed(write_json(path, document()), seen=cloud((moved(BAR, (2.0, 0)), RED)))


@pytest.mark.parametrize("name", WRITERS)
def test_frame_and_gripper_can_be_declared_by_who_uses_the_file(name, tmp_path):
    path = WRITERS[name](tmp_path / name, document(frame=None, gripper=None))
    assert len(proposed(path, frame="world", gripper="G")) == 2
    with pytest.raises(InputError, match=r"does not say its frame; valid: .*camera, world"):
        proposed(path, gripper="G")
    with pytest.raises(InputError, match=r"its gripper; valid.*franka_hand, contact_graspnet"):
        proposed(path, frame="world")
    path = WRITERS[name](tmp_path / name, document())
    with pytest.raises(InputError, match="its frame is 'world', not 'camera' as declared"):
        proposed(path, frame="camera")
    with pytest.raises(InputError, match="unknown gripper 'wsg50'; valid: G, franka_hand"):
        proposed(path, gripper="wsg50")


def test_a_scenario_names_the_file_by_a_tag(tmp_path):
    path = write_json(tmp_path / "g.json", document(frame=None, gripper=None))
    text = f"pipeline: {{proposer: !File {{path: {path}, frame: world, gripper: G}}}}"
    config = parse_scenario(text, "text", Scenario()).pipeline
    assert config.proposer == File(str(path), "world", "G")
    assert len(make_proposer(config, 0).propose(SEEN, NO_VIEW)) == 2
    assert PipelineConfig().proposer == Antipodal()


# --- what is refused ----------------------------------------------------------------------------


def _pose(change):
    poses = document()["poses"]
    change(poses[1])
    return document(poses=poses)


def _set(*place, to):
    def change(X):
        X[place] = to

    return change


def _mirror(X):
    X[:3, 0] *= -1


BAD = {
    "no poses": (document(poses=None), "has no poses"),
    "no scores": (document(scores=None), "has no scores"),
    "another name": (document(confidences=np.ones(2)), "'confidences'.*scores"),
    "flat poses": (document(poses=np.zeros((2, 16))), r"poses\[0\].*\(N, 4, 4\)"),
    "one pose": (document(poses=np.eye(4)), r"poses\[0\].*\(N, 4, 4\)"),
    "fewer scores": (document(scores=np.ones(1)), "scores is for 1 grasps, poses for 2"),
    "text for numbers": (document(scores=["0.5", "0.6"]), r"scores.*finite numbers"),
    "truth for numbers": (document(scores=np.array([True, False])), "scores.*numbers"),
    "nan": (_pose(_set(0, 3, to=np.nan)), r"poses\[1\] is not finite"),
    "inf": (document(scores=np.array([0.5, np.inf])), r"scores\[1\] is not finite"),
    "a mirrored hand": (_pose(_mirror), r"poses\[1\] is no rigid transform.*det R is -1"),
    "a scaled hand": (_pose(_set(0, 0, to=1.1)), r"poses\[1\] is no rigid transform"),
    "beyond floats": (
        _pose(_set(slice(3), slice(3), to=[[1e200, 1e200, 0], [-1e200, 1e200, 0], [0, 0, 1]])),
        r"poses\[1\] is no rigid transform",
    ),
    "no rotation": (_pose(_set(slice(3), slice(3), to=0)), r"poses\[1\] is no rigid transform"),
    "a last row": (_pose(_set(3, 0, to=0.1)), r"poses\[1\] is no rigid.*last row"),
    "millimetres": (_pose(_set(0, 3, to=500.0)), "poses reach 500.*metres"),
    "score above 1": (document(scores=np.array([0.5, 7.0])), r"scores\[1\] is 7; .*0 to 1"),
    "score below 0": (document(scores=np.array([-0.5, 1.0])), r"scores\[0\] is -0.5"),
    "a wide grasp": (document(widths=np.array([0.02, 0.12])), r"widths\[1\] is 0.12.*0.08"),
    "contacts": (document(contacts=np.zeros((2, 2))), r"contacts\[0\].*\(N, 3\)"),
    "far contacts": (document(contacts=np.full((2, 3), 999.0)), "contacts reach 999"),
    "unknown frame": (document(frame="base"), "unknown frame 'base'; valid: camera, world"),
    "too many": (
        document(poses=np.tile(np.eye(4), (MAX_GRASPS + 1, 1, 1)), scores=np.ones(MAX_GRASPS + 1)),
        f"at most {MAX_GRASPS}",
    ),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("case", BAD)
def test_what_is_no_grasp_is_refused_and_named(case, name, tmp_path):
    content, message = BAD[case]
    path = WRITERS[name](tmp_path / name, content)
    with pytest.raises(InputError, match=message) as caught:
        FileProposer(File(str(path)))
    assert str(path) in str(caught.value)
    assert "valid" in str(caught.value)


class _Trap:
    """Loading the pickle of this would raise, not only be noticed."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


def test_pickled_dictionaries_are_not_loaded_and_how_to_convert_them_is_said_and_works(tmp_path):
    by_segment = {
        "first": {1: document()["poses"], 2: np.stack([above(0.0)])},
        "second": {1: np.array([0.5, 0.75]), 2: np.array([0.9])},
        "third": {1: np.zeros((2, 3)), 2: np.zeros((1, 3))},
    }
    path = tmp_path / "predictions.npz"
    np.savez(path, **{k: np.array(v, dtype=object) for k, v in by_segment.items()})
    with pytest.raises(InputError, match=r"pickled objects \(first, second, third\)") as caught:
        FileProposer(File(str(path)))
    advice = str(caught.value).partition("for A, B, C: ")[2]
    for letter, own in zip("ABC", by_segment, strict=True):
        advice = advice.replace(f"'{letter}'", f"'{own}'")
    advice = advice.replace("'grasps.npz'", repr(str(tmp_path / "grasps.npz")))
    exec(advice, {"numpy": np})
    held = FileProposer(File(str(tmp_path / "grasps.npz"))).document
    assert (len(held.scores), held.frame, held.gripper) == (3, "camera", "contact_graspnet")
    np.savez(path, poses=np.array(_Trap(), dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="pickled objects"):
        FileProposer(File(str(path)))


def test_what_is_missing_or_too_much_is_named(tmp_path):
    with pytest.raises(InputError, match="!File lacks its path"):
        FileProposer(File())
    path = tmp_path / "g.npz"
    np.savez(path, **document(), extra=np.array(_Trap(), dtype=object))
    with pytest.raises(InputError, match=r"beside its poses and scores; valid: it without extra$"):
        FileProposer(File(str(path)))
    with pytest.raises(InputError, match="no use for 'more', leave it out"):
        FileProposer(File(str(write_npz(path, document(more=np.zeros(2))))))
    write_npz(path, document(frame=None, gripper=None))
    with pytest.raises(InputError, match="does not say its frame") as caught:
        FileProposer(File(str(path)))
    text = str(caught.value).partition("--scenario-text '")[2].rstrip("'")
    config = parse_scenario(text, "text", Scenario()).pipeline.proposer
    assert len(FileProposer(config).document.scores) == 2


def _member(path, data, name="poses.npy", method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr(name, data)


def _npy(header, data=b"", version=b"\x01\x00"):
    header = header.encode()
    length = struct.pack("<H" if version == b"\x01\x00" else "<I", len(header))
    return b"\x93NUMPY" + version + length + header + data


HUGE = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 4, 4)}\n"
FILES = {
    "nothing": (lambda p: p.write_bytes(b""), "neither JSON nor NPZ"),
    "text": (lambda p: p.write_text("grasps"), "neither JSON nor NPZ"),
    "a list": (lambda p: p.write_text("[1, 2]"), "holds a list"),
    "a pickle": (lambda p: p.write_bytes(pickle.dumps(document())), "neither JSON nor NPZ"),
    "deep": (lambda p: p.write_text('{"poses": ' + "[" * 100_000), "neither JSON nor NPZ"),
    "long number": (lambda p: p.write_text('{"poses": ' + "9" * 9999 + "}"), "neither JSON"),
    "great number": (
        lambda p: p.write_text('{"poses": [], "scores": [' + "9" * 400 + '], "frame": "world", '
        '"gripper": "G"}'), "poses for 0",
    ),
    "great score": (
        lambda p: write_json(p, document(scores=[0.5, 10**400])), "too large",
    ),
    "too large": (lambda p: p.write_bytes(b" " * 16_000_001), "16000001 bytes"),
    "half a zip": (
        lambda p: (write_npz(p, document()), p.write_bytes(p.read_bytes()[:-30])), "neither",
    ),
    "damaged": (
        lambda p: (write_npz(p, document()), _flip(p, 200)), "no sound NPZ|neither",
    ),
    "a huge shape": (lambda p: _member(p, _npy(HUGE)), "shape"),
    "a negative shape": (
        lambda p: _member(p, _npy(HUGE.replace("1000000000000", "-1"))), "shape",
    ),
    "a shape that lies": (
        lambda p: _member(p, _npy(HUGE.replace("1000000000000", "2"), b"\0" * 9)), "cut short",
    ),
    "a header that is code": (lambda p: _member(p, _npy("__import__('os')\n")), "no sound NPZ"),
    "a header of gigabytes": (
        lambda p: _member(p, _npy(HUGE, b" " * 10**7, b"\x02\x00")), "version 1.0",
    ),
    "a bomb": (lambda p: _member(p, b"\0" * 3 * 10**7), "no sound NPZ"),
    "many": (
        lambda p: write_npz(p, {f"a{i}": np.zeros(1) for i in range(101)}), "holds 101 files",
    ),
    "structures": (lambda p: write_npz(p, {"poses": np.zeros(2, "f8,f8")}), "valid: numbers"),
}  # fmt: skip


def _flip(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("case", FILES)
def test_a_file_that_is_none_or_means_harm_is_refused(case, tmp_path):
    write, message = FILES[case]
    write(tmp_path / "g.npz")
    with pytest.raises(InputError, match=message):
        FileProposer(File(str(tmp_path / "g.npz")))


@given(st.data())
@settings(max_examples=40)
def test_any_damage_to_a_file_is_refused_or_harmless(tmp_path_factory, data):
    path = write_npz(tmp_path_factory.mktemp("x") / "g.npz", document(widths=np.full(2, 0.02)))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        held = FileProposer(File(str(path))).document
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(held.poses).all()


def test_any_of_the_names_may_be_missing_or_wrong_and_nothing_else_happens(tmp_path):
    for name in NAMES:
        for value in (3, "x", {}, [], [[]], [None], [{}], [[[1]]], True, ["a" * 1000] * 3):
            path = write_json(tmp_path / "g.json", {**document(), name: value})
            with pytest.raises(InputError):
                FileProposer(File(str(path)))


# --- what this project writes -------------------------------------------------------------------


@pytest.fixture(scope="module")
def antipodal():
    view = look([TABLE, HAMMER_SIZED], eye=(0.3, 0.25, 0.45))
    seen = scene_cloud([view], Workspace(), CloudConfig())
    return view, seen, AntipodalProposer(Antipodal(), Workspace(), 0).propose(seen, view)


def test_the_grasps_of_our_own_proposer_come_back_bit_for_bit(antipodal, tmp_path):
    view, seen, grasps = antipodal
    content = document(
        poses=grasps.X_WG, scores=grasps.score, widths=grasps.width, contacts=grasps.p_WContact
    )
    for name, write in WRITERS.items():
        again = proposed(write(tmp_path / name, content), view, seen)
        for mine, theirs in zip(vars(grasps).values(), vars(again).values(), strict=True):
            np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("gripper", ["G", "franka_hand", "contact_graspnet"])
def test_the_gripper_that_is_declared_holds_and_another_one_does_not(gripper, antipodal, tmp_path):
    view, seen, grasps = antipodal
    grasps = grasps.take(np.arange(0, len(grasps), 4))
    poses = (np.linalg.inv(view.X_WC) @ grasps.X_WG @ np.linalg.inv(GRIPPERS[gripper])).astype("f4")
    content = document(poses=poses, scores=grasps.score, frame="camera", gripper=None)
    path = write_npz(tmp_path / "g.npz", content)

    def holding(grasps):
        return sum(problem == "" for problem in check_grasps(grasps, seen)) / len(grasps)

    share = {}
    for name in GRIPPERS:
        try:
            share[name] = holding(proposed(path, view, seen, gripper=name))
        except NoGrasp:
            share[name] = 0.0
    ours = holding(grasps)
    assert ours > 0.75
    assert share.pop(gripper) > ours - 0.05
    assert max(share.values()) < 0.1, share


def test_grasps_with_widths_and_contacts_in_the_wrong_gripper_or_frame_are_refused(
    antipodal, tmp_path
):
    view, seen, grasps = antipodal
    right = document(
        poses=grasps.X_WG, scores=grasps.score, widths=grasps.width, contacts=grasps.p_WContact
    )
    assert len(proposed(write_npz(tmp_path / "g.npz", right), view, seen)) == len(grasps)
    for wrong in ({"gripper": "contact_graspnet"}, {"gripper": "franka_hand"}, {"frame": "camera"}):
        path = write_npz(tmp_path / "g.npz", {**right, **wrong})
        (said,) = wrong.values()
        with pytest.raises(NoGrasp, match=rf"of the {len(grasps)} grasps have nothing .*{said}"):
            proposed(path, view, seen)


def test_without_contacts_those_of_our_own_proposer_are_found_again_nearly(antipodal, tmp_path):
    view, seen, grasps = antipodal
    again = proposed(
        write_json(tmp_path / "g.json", document(poses=grasps.X_WG, scores=grasps.score)),
        view,
        seen,
    )
    assert len(again) == len(grasps)
    y = np.einsum("ni,ni->n", again.p_WContact - grasps.X_WG[:, :3, 3], grasps.X_WG[:, :3, 1])
    assert np.median(np.abs(np.abs(y) - grasps.width / 2)) < 0.004
    assert np.median(np.abs(again.width - grasps.width)) < 0.004
    assert np.all((again.width >= 0) & (again.width <= MAX_OPENING))


RUN = ("run", "--no-meshcat", "--task", "use the hammer")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("file", ["'file'", "antipodal", "file:PATH"]),
        ("file:", ["'file:'", "file:PATH"]),
        ("antipodal:x", ["'antipodal:x'", "file:PATH"]),
        ("file:nowhere.npz", ["no file of grasps 'nowhere.npz'"]),
    ],
)
def test_a_proposer_that_cannot_be_made_is_one_line_before_anything_starts(given, words, tmp_path):
    for command in ((*RUN, "--proposer"), ("eval", "Hammer", "--proposers")):
        refused(tog(*command, given, "--out", tmp_path / "out"), *words)
