import numpy as np
import pytest
from pydrake.multibody.tree import BodyIndex
from scipy.spatial import cKDTree

from tog_drake.labelled_surface import LabelledSurface
from tog_drake.values import Grasps


@pytest.fixture
def bottle():
    """Two slabs along x: the body, 4 cm thick, for x < 0, and the cap, 2 cm thick, beyond it."""
    grid = np.arange(-0.05, 0.05, 0.001)
    x, z = (axis.ravel() for axis in np.meshgrid(grid, grid))
    half = np.where(x < 0, 0.02, 0.01)
    points = np.vstack([np.column_stack([x, side * half, z]) for side in (1, -1)])
    part = (points[:, 0] >= 0).astype(np.int64)
    names = (("bottle", "body"), ("bottle", "cap"))
    return LabelledSurface(BodyIndex(1), names, (), cKDTree(points), part)


def _grasps(*x: float) -> Grasps:
    X_WG = np.tile(np.eye(4), (len(x), 1, 1))
    X_WG[:, 0, 3] = x
    contact = X_WG[:, :3, 3] + [0, 0.02, 0]
    return Grasps(X_WG, np.full(len(x), 0.04), np.ones(len(x)), contact)


def test_pads_across_a_step_press_what_stands_out(bottle):
    (shares,) = bottle.pressed(np.eye(4), _grasps(0.004))
    assert shares == {("bottle", "body"): pytest.approx(1.0)}


def test_pads_on_one_part_press_it(bottle):
    assert bottle.pressed(np.eye(4), _grasps(-0.03, 0.03)) == [
        {("bottle", "body"): pytest.approx(1.0)},
        {("bottle", "cap"): pytest.approx(1.0)},
    ]


def test_each_pad_has_half_a_share(bottle):
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # half a turn about y: the thick end is now at x > 0
    upper = bottle.tree.data[:, 1] > 0
    half = cKDTree(np.vstack([bottle.tree.data[upper], bottle.tree.data[~upper] @ turned[:3, :3]]))
    part = np.concatenate([bottle.part[upper], bottle.part[~upper]])
    body = LabelledSurface(bottle.body, bottle.parts, (), half, part)
    (shares,) = body.pressed(np.eye(4), _grasps(0.03))
    assert shares == {("bottle", "cap"): pytest.approx(0.5), ("bottle", "body"): pytest.approx(0.5)}


def test_larger_pads_press_what_is_beside_them(bottle):
    (shares,) = bottle.pressed(np.eye(4), _grasps(-0.012), beside=0.0)
    assert shares == {("bottle", "body"): pytest.approx(1.0)}
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])  # the thick end is now at x > 0
    assert bottle.pressed(turned, _grasps(-0.012)) == [{("bottle", "cap"): pytest.approx(1.0)}]
    (shares,) = bottle.pressed(turned, _grasps(-0.012), beside=0.006)
    assert shares == {("bottle", "body"): pytest.approx(1.0)}


def test_pads_that_meet_nothing_press_nothing(bottle):
    assert bottle.pressed(np.eye(4), _grasps(0.2)) == [{}]


def test_what_is_pressed_moves_with_the_object(bottle):
    X_WO = np.eye(4)
    X_WO[0, 3] = 0.5
    (shares,) = bottle.pressed(X_WO, _grasps(0.53))
    assert shares == {("bottle", "cap"): pytest.approx(1.0)}
