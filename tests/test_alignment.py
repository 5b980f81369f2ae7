"""How far cameras are off, on views of boxes whose poses are then changed by a known amount."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.common.value import Value
from scipy.spatial.transform import Rotation
from tabletop import RED, TABLE, look

from tog_drake.alignment import Aligner, alignments
from tog_drake.cameras import L515
from tog_drake.doctor import camera_checks
from tog_drake.scenario import load_scenario
from tog_drake.stations.depth_noise import noisy_depth
from tog_drake.values import CameraView, Workspace

# Cameras on one side of three boxes: each two share faces that look along x and along y.
BOXES = [
    TABLE,
    ((0.46, -0.03, 0.0), (0.54, 0.03, 0.06), RED),
    ((0.55, 0.07, 0.0), (0.62, 0.16, 0.05), RED),
    ((0.52, -0.16, 0.0), (0.60, -0.07, 0.05), RED),
]
EYES = [(0.25, 0.0, 0.45), (0.33, 0.22, 0.4), (0.33, -0.22, 0.4)]
MIDDLE = np.array([0.5, 0.0, 0.03])


@cache
def views(noisy=False):
    seen = [look(BOXES, eye=eye, width=640, height=480) for eye in EYES]
    if not noisy:
        return seen
    noise, rng = L515.depth_noise["640x480"], np.random.default_rng(0)
    return [replace(v, depth=noisy_depth(v.depth, noise, v.intrinsics.fx, rng)) for v in seen]


def moved(view, shift, turn_deg=(0, 0, 0)):
    """The view of a camera that is believed to be elsewhere, and by what (4, 4)."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    X[:3, 3] = MIDDLE + shift - X[:3, :3] @ MIDDLE
    return replace(view, X_WC=X @ view.X_WC), X


def left_over(X):
    """How far (4, 4) moves the middle [m] and turns [deg]."""
    turn = np.degrees(np.linalg.norm(Rotation.from_matrix(X[:3, :3]).as_rotvec()))
    return np.linalg.norm(X[:3, :3] @ MIDDLE + X[:3, 3] - MIDDLE), turn


def test_cameras_whose_poses_are_exact_are_off_by_less_than_a_millimetre():
    first, *others = alignments(views(), Workspace())
    assert (first.shift, first.turn) == (0, 0)
    for found in others:
        assert found.shift < 0.001
        assert np.degrees(found.turn) < 0.3
        assert found.shift_told and found.turn_told and found.tolerable
        assert "recalibrate" not in found.said("wrist")


@pytest.mark.parametrize(
    ("shift", "turn"),
    [
        ((0.004, -0.004, 0.002), (0.3, 0.5, -0.5)),
        ((0.0, 0.0, 0.008), (0, 0, 0)),
        ((-0.010, 0.008, -0.006), (1.0, -1.0, 1.0)),
    ],
)
def test_how_far_a_camera_was_moved_is_found(shift, turn):
    wrist, side, other = views()
    off, X = moved(side, shift, turn)
    found = alignments([wrist, off, other], Workspace())
    rest = left_over(found[1].X @ X)
    assert rest[0] < 0.001
    assert rest[1] < 0.3
    assert not found[1].tolerable
    assert found[2].tolerable
    assert found[1].said("wrist").endswith("off against wrist: recalibrate its X_PB")


def test_through_noise_it_is_found_too():
    wrist, side, other = views(noisy=True)
    off, X = moved(side, (0.004, -0.004, 0.002), (0.3, 0.5, -0.5))
    found = alignments([wrist, off, other], Workspace())
    assert left_over(found[1].X @ X)[0] < 0.002
    assert not found[1].tolerable


def test_a_bare_table_tells_height_and_slant_but_not_where_on_it_a_camera_is():
    wrist, side = (look([TABLE], eye=eye, width=640, height=480) for eye in EYES[:2])
    off, _ = moved(side, (0.005, 0.0, 0.006))
    _, found = alignments([wrist, off], Workspace())
    assert found.shift == pytest.approx(0.006, abs=0.001)
    assert not found.shift_told and not found.turn_told
    assert not found.tolerable
    _, found = alignments([wrist, side], Workspace())
    assert found.said("wrist") == "its view shares too little with that of wrist to tell"


def test_views_that_share_nothing_tell_nothing():
    away = look([TABLE], eye=(0.5, 3.0, 0.4), target=(0.5, 4.0, 0.0))
    _, found = alignments([views()[0], away], Workspace())
    assert not found.shift_told and not found.turn_told
    assert (found.shift, found.turn) == (0, 0)


def test_the_stage_says_it_by_camera_without_the_first():
    stage = Aligner(Workspace(), lambda q: (np.array([[0.0, 0.0, 9.0]]), np.array([0.1])))
    context = stage.CreateDefaultContext()
    off, _ = moved(views()[1], (0.0, 0.0, 0.008))
    images = (CameraView("wrist", views()[0]), CameraView("side", off))
    stage.GetInputPort("views").FixValue(context, Value(images))
    stage.GetInputPort("panda.position_measured").FixValue(context, np.zeros(7))
    found = stage.GetOutputPort("alignments").Eval(context)
    assert list(found) == ["side"]
    assert found["side"].shift == pytest.approx(0.008, abs=0.001)


def test_the_doctor_finds_the_cameras_of_a_simulated_scenario_where_they_are_said_to_be():
    checks = camera_checks(load_scenario("side_cameras"))
    assert [check.name for check in checks] == [f"camera side_{i}" for i in (1, 2, 3, 4)]
    for check in checks:
        assert check.ok
        assert float(check.found.split()[0]) < 1.0  # [mm]


def test_the_doctor_has_nothing_to_compare_a_single_camera_with():
    (check,) = camera_checks(load_scenario("Mug"))
    assert check.ok
    assert "nothing to compare" in check.found
