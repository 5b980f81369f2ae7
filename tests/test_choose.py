"""``tog choose``: a view in three files in, grasps in the camera's frame out."""

import json

import cv2
import numpy as np
import pytest
from command import refused, tog, tog_serve
from tabletop import HAMMER_SIZED, RED, TABLE, look

from tog_drake import choose
from tog_drake.choose import GRASPS_SCHEMA
from tog_drake.record import SCHEMA

TASK = ("--task", "pick up the box")
BLOCK = ((0.44, -0.02, 0.0), (0.56, 0.02, 0.06), RED)  # 12 cm along x of W, 4 cm along y
ABOVE = (0.4, 0.0, 0.55)  # from here the camera sees little more than its top


def _write(folder, view):
    """Writes a view as the three files of a recording; returns the options that name them."""
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "color.png"), view.rgb[..., ::-1])
    cv2.imwrite(str(folder / "depth.png"), np.round(view.depth * 1000).astype(np.uint16))
    np.save(folder / "depth.npy", view.depth)
    camera = {k: getattr(view.intrinsics, k) for k in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.json").write_text(json.dumps(camera), encoding="utf-8")
    (folder / "X_WC.json").write_text(json.dumps(view.X_WC.tolist()), encoding="utf-8")
    return _files(folder)


def _files(folder, depth="depth.png"):
    return (
        "--rgb", folder / "color.png", "--depth", folder / depth,
        "--intrinsics", folder / "camera.json",
    )  # fmt: skip


@pytest.fixture(scope="module")
def view():
    return look([TABLE, BLOCK], eye=ABOVE)


@pytest.fixture(scope="module")
def folder(view, tmp_path_factory):
    """The view of a block on a table, in files."""
    folder = tmp_path_factory.mktemp("view")
    _write(folder, view)
    return folder


@pytest.fixture(scope="module")
def chosen(folder, tmp_path_factory):
    """What the command prints, and the folder that it fills."""
    out = tmp_path_factory.mktemp("chosen") / "new"
    return tog("choose", *_files(folder, "depth.npy"), *TASK, "--json", "--out", out), out


@pytest.fixture(scope="module")
def grasps(chosen):
    return json.loads((chosen[1] / "grasps.json").read_text(encoding="utf-8"))


def test_it_prints_one_json_object_and_writes_grasps_overlay_and_record(chosen):
    done, out = chosen
    assert done.status == 0, done.err
    record = json.loads(done.out, parse_constant=pytest.fail)
    assert {path.name for path in out.iterdir()} == {
        "grasps.json", "overlay.png", "episode.json", "report.html"
    }  # fmt: skip
    assert json.loads((out / "episode.json").read_text(encoding="utf-8")) == record
    assert record["schema"] == SCHEMA
    assert record["outcome"] == "chosen"
    assert record["scenario"] is record["object"] is record["grasp_success"] is None
    counts = record["counts"]
    assert counts["proposed"] > 10
    assert counts["feasible"] + record["rejected"]["hidden"] == counts["proposed"]
    assert f"{counts['feasible']} feasible" in done.err
    assert record["seconds"]["select"] > 0
    assert record["seconds"]["plan"] is record["seconds"]["execute"] is None
    assert "outcome: chosen" in done.err


def test_grasps_say_their_frames_and_every_pose_is_rigid(grasps):
    assert grasps["schema"] == GRASPS_SCHEMA
    assert grasps["frame"].startswith("camera: x right, y down, z forward")
    assert "z approach, y closing" in grasps["grasp_frame"]
    poses = [grasps["X_CW"], *(g["X_CG"] for g in grasps["grasps"])]
    for X in map(np.array, poses):
        np.testing.assert_allclose(X[:3, :3] @ X[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(X[:3, :3]) == pytest.approx(1.0)
        assert X[3].tolist() == [0, 0, 0, 1]


def test_every_grasp_closes_on_the_block_from_above_in_the_cameras_frame(grasps, view):
    lower, upper, _ = BLOCK
    X_WC = view.X_WC  # where the camera really was, which the command was not told
    for grasp in grasps["grasps"]:
        contact = X_WC[:3, :3] @ grasp["contact"] + X_WC[:3, 3]
        assert np.all(contact > np.array(lower) - 0.006)
        assert np.all(contact < np.array(upper) + 0.006)
        X_WG = X_WC @ np.array(grasp["X_CG"])
        # A slanted grip across an edge may have its middle a little beside the block.
        assert np.all(X_WG[:2, 3] > np.array(lower[:2]) - 0.006)
        assert np.all(X_WG[:2, 3] < np.array(upper[:2]) + 0.006)
        assert 0 < X_WG[2, 3] < upper[2] + 0.01
        assert X_WG[2, 2] < 0  # the approach leads down
        assert 0 < grasp["width"] < 0.08
        assert 0 <= grasp["score"] <= 1


def test_the_best_grasps_close_across_the_block_and_not_along_it(grasps, view):
    best = np.array(grasps["grasps"][0]["X_CG"])
    closing = view.X_WC[:3, :3] @ best[:3, 1]
    assert abs(closing[1]) > 0.9
    assert grasps["grasps"][0]["width"] == pytest.approx(0.04, abs=0.006)


def test_pixels_are_the_contacts_through_the_intrinsics(grasps, view):
    camera = view.intrinsics
    for grasp in grasps["grasps"]:
        x, y, z = grasp["contact"]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        assert grasp["pixel"] == pytest.approx([u, v], abs=1e-6)
        assert 0 <= u < camera.width
        assert 0 <= v < camera.height


def test_the_contact_is_what_the_camera_saw_at_its_pixel(grasps, view):
    u, v = np.round([grasp["pixel"] for grasp in grasps["grasps"]]).astype(int).T
    seen = np.array(
        [
            view.depth[max(0, b - 2) : b + 3, max(0, a - 2) : a + 3]
            for a, b in zip(u, v, strict=True)
        ]
    )
    z = np.array([grasp["contact"][2] for grasp in grasps["grasps"]])
    assert np.all(np.abs(seen - z[:, None, None]).min(axis=(1, 2)) < 0.008)


def test_scores_fall_and_choice_and_candidates_are_rows(grasps, chosen):
    scores = [grasp["score"] for grasp in grasps["grasps"]]
    assert scores == sorted(scores, reverse=True)
    record = json.loads(chosen[0].out)
    assert len(scores) <= record["counts"]["proposed"]  # those that hide a finger are left out
    assert grasps["choice"] == record["choice"]["index"]
    assert len(grasps["candidates"]) == record["counts"]["candidates"]
    assert all(0 <= row < len(scores) for row in grasps["candidates"])
    pixel = grasps["grasps"][grasps["choice"]]["pixel"]
    assert record["choice"]["pixel"] == pytest.approx(pixel, abs=0.01)


def test_the_overlay_is_the_picture_with_something_drawn_on_it(chosen, view):
    overlay = cv2.imread(str(chosen[1] / "overlay.png"))
    assert overlay is not None
    assert overlay.shape[0] >= view.rgb.shape[0]
    assert len(np.unique(overlay.reshape(-1, 3), axis=0)) > 10


def test_depth_in_millimetres_gives_about_the_same_table_and_metres_the_same(
    folder, grasps, tmp_path
):
    for name in ("depth.png", "depth.tiff"):
        if name == "depth.tiff":
            cv2.imwrite(str(folder / name), np.load(folder / "depth.npy"))
        out = tmp_path / name
        assert tog("choose", *_files(folder, name), *TASK, "--out", out).status == 0
        found = json.loads((out / "grasps.json").read_text(encoding="utf-8"))
        if name == "depth.tiff":
            assert found == grasps
        np.testing.assert_allclose(found["X_CW"], grasps["X_CW"], atol=2e-3)


def test_the_same_seed_gives_the_same_files_and_the_depth_scale_can_be_given(
    folder, grasps, tmp_path
):
    cv2.imwrite(str(folder / "scaled.png"), (np.load(folder / "depth.npy") * 5e4).astype(np.uint16))
    files = _files(folder, "scaled.png")
    for out in ("a", "b"):
        done = tog(
            "choose", *files, *TASK, "--depth-scale", 50000, "--seed", 0, "--out", tmp_path / out
        )
        assert done.status == 0, done.err
    for name in ("grasps.json", "overlay.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    found = json.loads((tmp_path / "a" / "grasps.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(found["X_CW"], grasps["X_CW"], atol=1e-3)


def test_a_camera_pose_tells_which_way_is_up(tmp_path):
    view = look([TABLE, BLOCK], eye=(0.5, 0.001, 0.5))
    files = _write(tmp_path / "v", view)
    pose = ("--camera-pose", tmp_path / "v" / "X_WC.json")
    assert tog("choose", *files, *TASK, *pose, "--out", tmp_path / "out").status == 0
    sideways = view.X_WC.copy()
    sideways[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # level: it would see no table
    pose[1].write_text(json.dumps(sideways.tolist()), encoding="utf-8")
    refused(tog("choose", *files, *TASK, *pose, "--out", tmp_path / "o2"), "no table found")


def test_a_part_that_cannot_be_told_apart_is_said_and_not_guessed(tmp_path):
    files = _write(tmp_path / "v", look([TABLE, HAMMER_SIZED]))
    done = tog(
        "choose", *files, "--task", "hold it by the blade", "--json", "--out", tmp_path / "out"
    )
    record = json.loads(done.out)
    assert (done.status, record["outcome"], record["choice"]) == (1, "no_choice", None)
    assert "alike all along" in record["message"]


def test_what_is_too_wide_for_the_hand_ends_in_status_1_with_the_outcome(tmp_path):
    board = ((0.40, -0.12, 0.0), (0.64, 0.12, 0.012), RED)
    files = _write(tmp_path / "v", look([TABLE, board], eye=(0.3, 0.0, 0.6)))
    out = tmp_path / "out"
    done = tog("choose", *files, *TASK, "--selector", "top-score", "--json", "--out", out)
    record = json.loads(done.out)
    assert (done.status, record["outcome"]) == (1, "no_grasp")
    assert "no grasp proposed" in record["message"]
    found = json.loads((out / "grasps.json").read_text(encoding="utf-8"))
    assert (found["grasps"], found["choice"]) == ([], None)


def test_grasps_that_push_a_finger_behind_what_was_seen_are_counted(folder, tmp_path, monkeypatch):
    def every_third(X_WG, opening, views):
        return (np.arange(len(X_WG)) % 3 == 0).astype(float)

    monkeypatch.setattr(choose, "hidden_share", every_third)
    done = tog("choose", *_files(folder), *TASK, "--json", "--out", tmp_path / "out")
    record = json.loads(done.out)
    hidden = -(-record["counts"]["proposed"] // 3)
    assert record["rejected"] == {"hidden": hidden}
    assert record["counts"]["feasible"] == record["counts"]["proposed"] - hidden


def test_grasps_that_all_push_a_finger_behind_what_was_seen_are_counted_as_hidden(
    folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(choose, "hidden_share", lambda X_WG, opening, views: np.ones(len(X_WG)))
    done = tog("choose", *_files(folder), *TASK, "--json", "--out", tmp_path / "out")
    record = json.loads(done.out)
    count = record["counts"]["proposed"]
    assert (done.status, record["outcome"]) == (1, "no_grasp")
    assert f"all {count} proposed grasps would push a finger behind" in record["message"]
    assert record["rejected"] == {"hidden": count}
    assert count > 10
    found = json.loads((tmp_path / "out" / "grasps.json").read_text(encoding="utf-8"))
    assert (found["grasps"], found["candidates"], found["choice"]) == ([], [], None)


# --- bad input ----------------------------------------------------------------------------------


def _depth(folder, image):
    cv2.imwrite(str(folder / "depth.png"), image)


def _camera(folder, **changes):
    path = folder / "camera.json"
    camera = {**json.loads(path.read_text(encoding="utf-8")), **changes}
    path.write_text(json.dumps({k: v for k, v in camera.items() if v is not None}))


SIZE = (240, 320)
BAD = {
    "no colour image": (lambda f: (f / "color.png").unlink(), ["no file", "color.png"]),
    "no depth": (lambda f: (f / "depth.png").unlink(), ["no file", "depth.png"]),
    "no intrinsics": (lambda f: (f / "camera.json").unlink(), ["no file", "camera.json"]),
    "unreadable colour": (lambda f: (f / "color.png").write_bytes(b"x"), ["cannot read", "color"]),
    "unreadable depth": (lambda f: (f / "depth.png").write_bytes(b"x"), ["cannot read", "depth"]),
    "empty depth file": (lambda f: (f / "depth.png").write_bytes(b""), ["cannot read", "depth"]),
    "half a depth file": (
        lambda f: (f / "depth.png").write_bytes((f / "depth.png").read_bytes()[:60]),
        ["depth.png"],
    ),
    "a folder": (
        lambda f: ((f / "depth.png").unlink(), (f / "depth.png").mkdir()),
        ["no file", "depth.png"],
    ),
    "all holes": (lambda f: _depth(f, np.zeros(SIZE, np.uint16)), ["all holes"]),
    "sizes differ": (
        lambda f: _depth(f, np.full((120, 160), 500, np.uint16)),
        ["320×240", "160×120", "aligned"],
    ),
    "8 bits": (lambda f: _depth(f, np.full(SIZE, 50, np.uint8)), ["uint8", "uint16 or float32"]),
    "three channels": (lambda f: _depth(f, np.full((*SIZE, 3), 50, np.uint16)), ["one channel"]),
    "wrong unit": (lambda f: _depth(f, np.full(SIZE, 60000, np.uint16)), ["60 m", "depth-scale"]),
    "intrinsics are no JSON": (lambda f: (f / "camera.json").write_text("fx"), ["as JSON"]),
    "fx is missing": (lambda f: _camera(f, fx=None), ["fx", "None"]),
    "fx is negative": (lambda f: _camera(f, fx=-300), ["fx = -300"]),
    "cy is outside": (lambda f: _camera(f, cy=4000), ["cy = 4000", "0..240"]),
    "for another size": (lambda f: _camera(f, width=640), ["640×240", "320×240"]),
    "a wall of noise": (
        lambda f: _depth(f, np.random.default_rng(0).integers(300, 900, SIZE, np.uint16)),
        ["no table found"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_one_line_that_names_it_and_says_why(case, view, tmp_path):
    files = _write(tmp_path / "v", view)
    spoil, words = BAD[case]
    spoil(tmp_path / "v")
    refused(tog("choose", *files, *TASK, "--json", "--out", tmp_path / "out"), *words)
    assert not (tmp_path / "out").exists()


def test_a_bare_table_is_no_object_in_view(tmp_path):
    files = _write(tmp_path / "v", look([TABLE]))
    refused(tog("choose", *files, *TASK, "--out", tmp_path / "out"), "no object in view")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--task", ""), ["no words"]),
        ((*TASK, "--k", "0"), ["K is '0'", "at least 1", "auto"]),
        ((*TASK, "--k", "many"), ["K is 'many'", "at least 1", "auto"]),
        ((*TASK, "--selector", "best"), ["'best'", "geometric, top-score, random"]),
        ((*TASK, "--selector", "oracle"), ["oracle", "simulated", "geometric, top-score, random"]),
        ((*TASK, "--proposer", "gpd"), ["'gpd'", "antipodal"]),
        ((*TASK, "--depth-scale", "0"), ["--depth-scale", "above 0"]),
        ((*TASK, "--depth-scale", "nan"), ["--depth-scale", "above 0"]),
        ((*TASK, "--camera-pose", "nowhere.json"), ["no file nowhere.json"]),
    ],
)
def test_a_bad_option_is_one_line_with_what_is_valid(arguments, words, folder, tmp_path):
    done = tog("choose", *_files(folder), *arguments, "--out", tmp_path / "out")
    refused(done, *words)
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_way_of_the_output_is_said_before_the_work(folder, tmp_path):
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    done = tog("choose", *_files(folder), *TASK, "--out", tmp_path / "taken")
    refused(done, "taken is a file")
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "mine"


# --- a real frame -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mug(shared_data, tmp_path_factory):
    """The options that name a recorded view of a mug, and the folder of what is chosen on it."""
    frame = shared_data / "rgbd" / "red_mug_6dof"
    info = json.loads((frame / "info.json").read_text(encoding="utf-8"))
    options = (
        "--rgb", frame / "color.png", "--depth", frame / "depth.png",
        "--intrinsics", frame / "info.json", "--depth-scale", info["depth_units_per_metre"],
        "--task", "hold the red mug by the handle", "--json",
    )  # fmt: skip
    out = tmp_path_factory.mktemp("mug")
    done = tog("choose", *options, "--out", out)
    assert done.status == 0, done.err
    return options, out


def test_on_a_recorded_view_the_grasp_is_on_the_red_mug(mug):
    options, out = mug
    found = json.loads((out / "grasps.json").read_text(encoding="utf-8"))
    u, v = np.round(found["grasps"][found["choice"]]["pixel"]).astype(int)
    bgr = cv2.imread(str(options[1]))[v - 6 : v + 7, u - 6 : u + 7].reshape(-1, 3)
    red = (bgr[:, 2] > 90) & (bgr[:, 2] > 1.8 * bgr[:, :2].max(axis=1))
    assert red.any(), f"no red near pixel {u, v}"


def test_on_a_recorded_view_the_grasps_it_wrote_lead_to_the_same_choice(mug, tmp_path):
    options, out = mug
    written = out / "grasps.json"
    done = tog("choose", *options, "--proposer", f"file:{written}", "--out", tmp_path)
    assert done.status == 0, done.err
    assert json.loads(done.out)["proposer"] == {
        "kind": "file", "path": str(written), "frame": None, "gripper": None
    }  # fmt: skip
    first = json.loads(written.read_text(encoding="utf-8"))
    second = json.loads((tmp_path / "grasps.json").read_text(encoding="utf-8"))
    assert (second["choice"], second["candidates"]) == (first["choice"], first["candidates"])
    for mine, theirs in zip(first["grasps"], second["grasps"], strict=True):
        for key in mine:
            np.testing.assert_allclose(mine[key], theirs[key], atol=1e-9)


def test_on_a_recorded_view_a_server_proposes_the_same_to_the_last_bit(mug, tmp_path):
    options, out = mug
    with tog_serve() as url:
        done = tog("choose", *options, "--proposer", f"remote:{url}", "--out", tmp_path)
    assert done.status == 0, done.err
    assert json.loads(done.out)["proposer"]["url"] == url
    assert (tmp_path / "grasps.json").read_bytes() == (out / "grasps.json").read_bytes()
