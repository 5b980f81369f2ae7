import ast
import base64
import io
import json
import re
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from browser import browser, needs_browser
from command import refused, tog
from pydrake.math import RigidTransform, RotationMatrix

from tog_drake import video
from tog_drake.drawing import candidate_color_name
from tog_drake.errors import InputError
from tog_drake.inline_replay import inline_page, inline_replay
from tog_drake.recording import (
    RECORDING,
    Recorder,
    Recording,
    load_recording,
    positions_at,
    save_recording,
    world_of,
    world_text,
)
from tog_drake.rendering import rendering_problem
from tog_drake.replay import set_stage, show_recording
from tog_drake.scenario import load_scenario
from tog_drake.showing import save_episode
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Candidates, Grasps
from tog_drake.visualization import sketch_of

TIMES = (0.4, 0.42, 0.5, 0.7)
GRASPS = Grasps(
    np.tile(RigidTransform([0.5, 0.0, 0.1]).GetAsMatrix4(), (3, 1, 1)),
    np.full(3, 0.03),
    np.array([0.9, 0.5, 0.4]),
    np.tile([0.5, 0.015, 0.1], (3, 1)),
)
CANDIDATES = Candidates(GRASPS, np.array([0, 2]), np.array([0, 0, 1]))
SKETCH = sketch_of(candidates=CANDIDATES)


@pytest.fixture(scope="module")
def made():
    """A hammer that is moved and turned over by hand, and the recording of it."""
    scenario = load_scenario("Hammer", "cameras: {}")
    station = SimulationStation(scenario)
    recorder, context = Recorder(station, scenario), station.CreateDefaultContext()
    plant_context = station.GetMutableSubsystemContext(station.plant, context)
    hammer = station.plant.GetBodyByName("base", station.plant.GetModelInstanceByName("hammer"))
    for time in TIMES:
        context.SetTime(time)
        X_WB = RigidTransform(RotationMatrix.MakeZRotation(9.0 * time), [0.5, time, 0.1])
        station.plant.SetFreeBodyPose(plant_context, hammer, X_WB)
        recorder.observe(context)
        recorder.observe(context)  # at a time that was taken down already
    return recorder.recording(SKETCH, decided=0.45, closed=0.6)


@pytest.fixture
def folder(tmp_path, made):
    """The folder of an episode."""
    save_recording(tmp_path, made)
    (tmp_path / "episode.json").write_text("{}")
    return tmp_path


def test_what_is_loaded_is_what_was_recorded(folder, made):
    loaded = load_recording(folder)
    assert (loaded.world, loaded.names) == (made.world, made.names)
    assert loaded.times.tolist() == made.times.tolist() == list(TIMES)
    np.testing.assert_allclose(loaded.positions, made.positions, atol=1e-6)
    assert (loaded.decided, loaded.closed) == (0.45, 0.6)
    for name, array in vars(SKETCH).items():
        np.testing.assert_allclose(getattr(loaded.sketch, name), array, atol=1e-6)
    assert (folder / RECORDING).stat().st_size < 10_000


def test_what_was_seen_and_decided_is_shown_with_it(made):
    meshcat = show_recording(made)
    assert meshcat.HasPath("/decision/seen/grasps")
    assert meshcat.HasPath("/decision/seen/candidates/01_" + candidate_color_name(1))
    assert not meshcat.HasPath("/decision/seen/choice")
    assert not meshcat.HasPath("/decision/seen/cloud")


def test_an_episode_is_shown_at_the_poses_that_it_had(folder, made):
    stage = set_stage(load_recording(folder), rate=50.0)
    plant = stage.station.plant
    shown = {}
    for context in stage.frames():
        of_plant = stage.station.GetSubsystemContext(plant, context)
        shown[round(context.get_time() + TIMES[0], 3)] = plant.GetPositions(of_plant)
    for time, q in zip(made.times, made.positions, strict=True):
        turn = slice(9, 13)  # q and -q are the same rotation
        assert made.names[turn.start].endswith("_qw")
        sign = np.sign(shown[time][turn] @ q[turn])
        np.testing.assert_allclose(sign * shown[time][turn], q[turn], atol=1e-6)
        shown[time][turn] = q[turn]
        np.testing.assert_allclose(shown[time], q, atol=1e-6)
    assert min(shown) == TIMES[0] and max(shown) == TIMES[-1]


def test_between_two_samples_a_body_turns_by_the_shorter_way(made):
    flipped = replace(made, positions=made.positions.copy())
    flipped.positions[1, 9:13] *= -1.0
    plant = set_stage(made).station.plant
    between = positions_at(flipped, plant, np.array([0.41]))
    np.testing.assert_allclose(between, positions_at(made, plant, np.array([0.41])), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(between[0, 9:13]), 1.0)


def test_a_recorded_world_has_what_the_scenario_had_and_names_no_server_and_falls_no_more():
    scenario = load_scenario(
        "Household", "pipeline: {proposer: !Remote {url: 'http://host/secret'}}", seed=7
    )
    text = world_text(scenario)
    assert "secret" not in text
    world = world_of(Recording(text, (), np.array([0.0, 1.0]), np.zeros((2, 0)), SKETCH, 0.0))
    assert (world.random_seed, world.settle) == (7, None)
    assert len(world.directives) == len(scenario.directives)


def _arrays(made, **other):
    kept = {
        "world": np.frombuffer(made.world.encode(), np.uint8),
        "names": np.array(made.names),
        "times": made.times,
        "positions": made.positions.astype(np.float32),
        "decided": np.array([0.45, np.nan]),
    }
    sketch = {f"sketch_{name}": array for name, array in vars(SKETCH).items()}
    return kept | sketch | other


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"times": np.array([0.4, 0.4, 0.5, 0.7])}, "do not rise"),
        ({"times": np.array([0.4, 0.5, 0.6, 1e9])}, "600 s"),
        ({"times": np.array([-1.0, 0.5, 0.6, 0.7])}, "do not rise"),
        ({"times": np.array([0.4, np.nan, 0.5, 0.7])}, "not finite"),
        ({"times": np.array([])}, "two times at least"),
        ({"times": np.array(["a", "b"])}, "'times'"),
        ({"positions": np.zeros((4, 3), np.float32)}, "positions of shape (4, 3)"),
        ({"positions": np.full((4, 16), np.inf, np.float32)}, "not finite"),
        ({"positions": np.full((4, 16), 1e3, np.float32)}, "beyond 100"),
        ({"positions": np.array([{}])}, "'positions'"),
        ({"world": np.full(2_000_000, 32, np.uint8)}, "2000000 bytes"),
        ({"world": np.array([255, 254], np.uint8)}, "utf-8"),
        ({"names": np.array("one")}, "'names'"),
        ({"decided": np.array([np.nan, np.nan])}, "'decided'"),
        ({"decided": np.array([0.5, 1e300])}, "'decided'"),
        ({"decided": np.array([0.5])}, "'decided'"),
        ({"sketch_path": np.zeros((2, 4))}, "not rows of (3,)"),
        ({"sketch_cloud": np.full((2, 3), np.nan)}, "not finite"),
        ({"sketch_grasps": np.full((2, 2, 3), 1e30)}, "beyond 100 m"),
        ({"sketch_cloud_rgb": np.full((1, 3), 300, np.uint16)}, "sketch_cloud_rgb"),
        ({"sketch_cloud_rgb": np.zeros((1, 3), np.uint8)}, "do not fit together"),
        ({"sketch_choice": np.zeros((4, 2, 3))}, "do not fit together"),
        ({"sketch_candidates": np.zeros((101, 4, 2, 3))}, "do not fit together"),
        ({"sketch_contact": np.array([{}])}, "'sketch_contact'"),
    ],
    ids=str,
)
def test_a_hostile_recording_is_refused_with_what_is_wrong(folder, made, other, words):
    np.savez(folder / RECORDING, **_arrays(made, **other))
    with pytest.raises(InputError, match="cannot be replayed") as error:
        load_recording(folder)
    assert words in str(error.value)


def test_what_unpacks_to_more_than_it_should_is_refused_before_it_is_unpacked(folder):
    array = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6)}
    np.lib.format.write_array_header_1_0(array, header)
    with zipfile.ZipFile(folder / RECORDING, "w") as archive:
        archive.writestr("positions.npy", array.getvalue())
    with pytest.raises(InputError, match=r"shape \(1000000, 1000000\)"):
        load_recording(folder)


def test_what_is_cut_short_or_no_archive_is_refused(folder):
    whole = (folder / RECORDING).read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"P", b"[1, 2]"):
        (folder / RECORDING).write_bytes(content)
        with pytest.raises(InputError, match="no sound NPZ file"):
            load_recording(folder)


def test_a_recording_of_other_models_or_of_no_world_at_all_is_refused(made):
    names = ("hammer_base_qw", "elephant_q")
    other = replace(made, names=names, positions=np.zeros((4, 2)))
    with pytest.raises(InputError, match="elephant_q"):
        set_stage(other)
    with pytest.raises(InputError, match="is no unit quaternion"):
        set_stage(replace(made, positions=0.0 * made.positions))
    for world in ("directives: 3", "nonsense: 1", "{", "asset: ../../etc"):
        with pytest.raises(InputError):
            set_stage(replace(made, world=world))
    gone = "{directives: [{add_model: {name: a, file: 'package://tog_drake/gone.sdf'}}]}"
    with pytest.raises(InputError, match=r"gone\.sdf"):
        set_stage(replace(made, world=gone))


def test_an_episode_without_motion_leaves_no_recording_and_replay_says_so(folder, made):
    save_episode(folder, {})
    assert not (folder / RECORDING).exists()
    assert json.loads((folder / "episode.json").read_text()) == {}
    refused(tog("replay", folder), "without motion", "recording.npz", "tog run")
    refused(tog("replay", folder / "nowhere"), "no folder")
    refused(tog("replay", folder.parent), "holds no episode", "tog run --out")
    save_episode(folder, {}, made)
    assert load_recording(folder).names == made.names


def test_a_page_and_a_film_go_nowhere_that_cannot_be_written_to(folder):
    refused(tog("replay", folder, "--html", folder), "--html", "is a folder")
    refused(tog("replay", folder, "--video", folder / RECORDING / "a.mp4"), "is a file")


def test_the_page_holds_the_motion_and_is_small(folder):
    done = tog("replay", folder, "--html", folder / "page.html")
    assert (done.status, done.err) == (0, "")
    page = (folder / "page.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html>")
    assert len(page) < 5_000_000


@needs_browser
def test_a_browser_plays_the_page_without_complaint(folder):
    tog("replay", folder, "--html", folder / "page.html")
    with browser() as window:
        window.open(folder / "page.html")
        window.wait_for("typeof viewer !== 'undefined' && viewer.animator.duration > 0")
        assert window.do("return viewer.animator.duration") == pytest.approx(0.3, abs=0.05)
        assert not window.complaints()
        pytest.importorskip("meshcat")
        cell = f"<!DOCTYPE html><body>{inline_replay(folder).data}</body>"
        (folder / "cell.html").write_text(cell)
        window.open(folder / "cell.html")
        viewer = "document.querySelector('iframe').contentWindow.viewer"
        window.wait_for(f"{viewer} && {viewer}.animator.duration > 0")
        assert not window.complaints()


def test_in_a_notebook_each_body_is_where_it_was_and_no_server_is_asked(made):
    pytest.importorskip("meshcat")
    import umsgpack

    page = inline_page(made)
    assert len(page) < 2_000_000
    (packed,) = re.findall(r"const command of (\[.*\])\)", page)
    commands = [umsgpack.unpackb(base64.b64decode(c)) for c in ast.literal_eval(packed)]
    drawn = [c["path"] for c in commands if c["type"] == "set_object"]
    assert len(drawn) > 20
    (animation,) = (c for c in commands if c["type"] == "set_animation")
    (hammer,) = animation["animations"]  # nothing else moves
    tracks = {track["name"]: track["keys"] for track in hammer["clip"]["tracks"]}
    assert any(path.startswith(hammer["path"]) for path in drawn)
    assert len(tracks[".position"]) == 10
    np.testing.assert_allclose(tracks[".position"][0]["value"], made.positions[0, 13:], atol=1e-9)
    np.testing.assert_allclose(tracks[".position"][-1]["value"], made.positions[-1, 13:], atol=1e-9)


def test_without_the_package_a_notebook_hears_how_to_install_it(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshcat", None)
    with pytest.raises(InputError, match=re.escape("pip install 'tog_drake[notebooks]'")):
        inline_replay(folder)


@pytest.mark.skipif(rendering_problem() is not None, reason="cannot render")
def test_a_film_is_as_large_and_long_as_it_should_be_and_shows_what_moves(folder, made):
    import cv2

    done = tog("replay", folder, "--video", folder / "film.mp4")
    assert (done.status, done.err) == (0, "")
    assert "film.mp4" in done.out and any(codec in done.out for codec in video.CODECS.values())
    film, frames = cv2.VideoCapture(str(folder / "film.mp4")), []
    assert film.get(cv2.CAP_PROP_FPS) == 30.0
    while (read := film.read())[0]:
        frames.append(read[1].astype(float))
    assert len(frames) == 10  # 0.3 s, both ends among them
    assert frames[0].shape == (720, 1280, 3)
    assert frames[0].std() > 20.0 and frames[0].mean() > 60.0
    assert np.abs(frames[-1] - frames[0]).max() > 60.0  # the hammer
    assert np.abs(frames[-1] - frames[0])[:300].mean() < 2.0  # the arm stands still
    assert sorted(p.name for p in folder.iterdir()) == ["episode.json", "film.mp4", RECORDING]


def test_a_film_that_cannot_be_finished_leaves_the_earlier_one(folder, made, monkeypatch):
    (folder / "film.mp4").write_bytes(b"earlier")

    def stop(done, of):
        raise KeyboardInterrupt

    monkeypatch.setattr(video, "film", lambda stage: iter([np.zeros((720, 1280, 3), np.uint8)]))
    with pytest.raises(KeyboardInterrupt):
        video.write_video(folder / "film.mp4", made, stop)
    assert (folder / "film.mp4").read_bytes() == b"earlier"
    monkeypatch.setattr(video, "CODECS", {"none": "no such codec"})
    with pytest.raises(InputError, match="no such codec"):
        video.write_video(folder / "film.mp4", made)
