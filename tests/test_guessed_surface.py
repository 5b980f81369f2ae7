"""What is guessed of a box that was seen from above: its sides, and from where they would show."""

import numpy as np
import pytest
from tabletop import TABLE, look

from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoGrasp
from tog_drake.guessed_surface import camera_poses, guessed_shell, standing, unbarred
from tog_drake.pinhole import project

BOX = ((0.45, -0.05, 0.0), (0.55, 0.05, 0.2), (200, 0, 0))
SIDES, TOP = 4 * 0.1 * 0.2, 0.1 * 0.1  # [m²]


def top_of_box():
    """What a camera straight above sees of the box, (N, 3)."""
    x, y = np.meshgrid(np.linspace(0.45, 0.55, 21), np.linspace(-0.05, 0.05, 21))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.2)])


@pytest.fixture(scope="module")
def shell():
    return guessed_shell(top_of_box(), 0.0, seed=0)


def test_a_thing_reaches_down_to_the_table_and_shows_all_but_its_underside(shell):
    top = shell.normal[:, 2] > 0.9
    assert top.mean() == pytest.approx(TOP / (TOP + SIDES), abs=0.06)
    side = np.abs(shell.normal[:, 2]) < 0.1
    assert (top | side).all()
    assert shell.p_W[side, 2].min() < 0.02
    np.testing.assert_allclose(shell.middle, [0.5, 0.0, 0.1], atol=0.01)
    assert shell.radius == pytest.approx(np.hypot(0.1, np.hypot(0.05, 0.05)), abs=0.01)


def test_from_above_the_top_is_shown_and_from_the_front_one_side_and_the_top(shell):
    above = look([TABLE, BOX], eye=(0.5, 0.001, 0.9), target=(0.5, 0.0, 0.0))
    np.testing.assert_array_equal(shell.shown(above), shell.normal[:, 2] > 0.9)
    front = shell.shown(look([TABLE, BOX], eye=(0.0, 0.0, 0.45), target=(0.5, 0.0, 0.1)))
    assert front[shell.normal[:, 0] < -0.9].mean() > 0.95
    assert not front[shell.normal[:, 0] > 0.9].any()
    assert not front[np.abs(shell.normal[:, 1]) > 0.9].any()


def test_what_lies_outside_the_image_or_behind_another_thing_is_not_shown(shell):
    elsewhere = look([TABLE, BOX], eye=(0.0, 0.0, 0.45), target=(0.0, 0.5, 0.0))
    assert not shell.shown(elsewhere).any()
    wall = ((0.35, -0.3, 0.0), (0.37, 0.3, 0.4), (0, 0, 200))
    assert not shell.shown(
        look([TABLE, BOX, wall], eye=(0.0, 0.0, 0.2), target=(0.5, 0.0, 0.1))
    ).any()


def test_points_without_a_volume_say_so():
    with pytest.raises(NoGrasp, match="2 points span no volume"):
        guessed_shell(np.array([[0.5, 0.0, 0.1], [0.5, 0.1, 0.1]]), 0.0, seed=0)


def test_what_was_seen_stands_on_the_table():
    column = standing(np.array([[0.505, 0.005, 0.2]]), table_height=0.0)
    assert column[0].tolist() == [0.505, 0.005, 0.2]
    np.testing.assert_allclose(column[1:, 2], np.arange(0.0, 0.2, 0.01), atol=1e-9)
    assert len(standing(np.zeros((0, 3)), 0.0)) == 0


def test_every_place_to_look_from_sees_the_thing_whole_upright_and_not_too_near(shell):
    camera = look([TABLE]).intrinsics
    poses = camera_poses(shell, camera, distance=0.3)
    for X_WC in poses:
        np.testing.assert_allclose(X_WC[:3, :3].T @ X_WC[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(X_WC[:3, :3]) > 0
        assert X_WC[2, 0] == pytest.approx(0.0, abs=1e-12)
        assert X_WC[2, 1] < 0
        pixel = project(shell.p_W, camera, X_WC)
        assert (pixel > 0).all()
        assert (pixel < [camera.width, camera.height]).all()
        assert np.linalg.norm(shell.p_W - X_WC[:3, 3], axis=1).min() >= 0.3


def test_another_thing_bars_the_sight_from_its_side_alone(shell):
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.005), np.arange(0.0, 0.4, 0.005))
    wall = np.column_stack([np.full(y.size, 0.40), y.ravel(), z.ravel()])
    others = DistanceField(wall)
    front = shell.normal[:, 0] < -0.9
    assert not unbarred(shell, np.array([0.1, 0.0, 0.1]), others)[front].any()
    assert unbarred(shell, np.array([0.9, 0.0, 0.3]), others)[shell.normal[:, 0] > 0.9].all()
