"""How near the robot is to what it must not touch, and how that changes with the joints."""

from functools import cache

import numpy as np
import pytest
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoPlan
from tog_drake.obstacles import Obstacles
from tog_drake.planning_model import MakePlanningModel

Q_LOOK = np.array([0.0, -0.9564, 0.0, -2.7824, 0.0, 2.2558, 0.7853])


@cache
def planning_model():
    return MakePlanningModel()


def scene(*points):
    return Obstacles(planning_model(), DistanceField(np.reshape(points, (-1, 3))), opening=0.08)


def below_the_hand(distance):
    """A point so far below the fingertips at the look posture, along the approach."""
    X_WG = planning_model().X_WG(Q_LOOK)
    return X_WG[:3, 3] + (0.0095 + distance) * X_WG[:3, 2]


def in_the_palm():
    return below_the_hand(-0.08)


def line(q_from, q_to):
    return PiecewisePolynomial.FirstOrderHold([0.0, 1.0], np.stack([q_from, q_to], axis=1))


def test_the_clearance_is_at_most_the_true_distance_and_not_far_below_it():
    measured = scene(below_the_hand(0.10)).cloud_clearance(Q_LOOK[None])[0]
    assert 0.05 < measured < 0.10


def test_the_hand_can_be_left_out():
    X_WG = planning_model().X_WG(Q_LOOK)
    in_a_finger = X_WG[:3, 3] + 0.047 * X_WG[:3, 1]
    near = scene(in_a_finger)
    assert near.cloud_clearance(Q_LOOK[None])[0] < 0
    assert near.cloud_clearance(Q_LOOK[None], with_hand=False)[0] > 0.05


def test_what_is_near_the_base_link_alone_does_not_count_for_it_cannot_move():
    assert scene([-0.1, 0.0, 0.02]).cloud_clearance(Q_LOOK[None])[0] > 0.05


def test_the_gradient_is_that_of_the_clearance():
    rng = np.random.default_rng(0)
    cloud = scene(*rng.uniform([0.4, -0.3, 0.0], [0.6, 0.3, 0.15], (200, 3)))
    q = Q_LOOK + rng.uniform(-0.3, 0.3, (200, 7))
    clearance, gradient = cloud.cloud_clearance_and_gradient(q)
    np.testing.assert_array_equal(clearance, cloud.cloud_clearance(q))
    direction = rng.normal(size=(200, 7))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    h = 5e-3
    change = cloud.cloud_clearance(q + h * direction) - cloud.cloud_clearance(q - h * direction)
    wrong = np.abs(change / (2 * h) - np.sum(gradient * direction, axis=1))
    # Not everywhere: the table is linear by pieces, and another sphere may become the nearest.
    assert np.median(wrong) < 0.03
    assert np.percentile(wrong, 90) < 0.15
    assert np.abs(change).max() / (2 * h) > 0.3


def test_configurations_are_counted_up_to_the_first_that_is_not_free():
    blocked = scene(in_the_palm())
    away = Q_LOOK + np.array([1.0, 0, 0, 0, 0, 0, 0])
    assert blocked.count_free(np.stack([away, away, Q_LOOK, away]), 0.0) == 2
    in_table = np.array([0.0, 1.2, 0.0, -1.2, 0.0, 1.5, 0.8])
    assert blocked.count_free(np.stack([away, in_table, away]), 0.0) == 1
    assert blocked.count_free(np.stack([away]), 0.0) == 1


def test_a_thin_pole_in_the_way_is_found_between_the_ends():
    q_to = Q_LOOK + np.array([1.0, 0, 0, 0, 0, 0, 0])
    middle = planning_model().X_WG((Q_LOOK + q_to) / 2)[:3, 3]
    pole = [middle + np.array([0, 0, z]) for z in np.arange(-0.2, 0.2, 0.01)]
    with pytest.raises(
        NoPlan, match=r"the way is not free 0\.\d+ s .* what the camera saw"
    ) as error:
        scene(*pole).check(line(Q_LOOK, q_to), "the way")
    assert "panda_" in str(error.value)
    scene().check(line(Q_LOOK, q_to), "the way")


def test_points_between_the_open_fingers_are_free():
    assert scene(below_the_hand(0.0)).cloud_clearance(Q_LOOK[None])[0] > 0


def test_the_table_is_named_when_it_is_hit():
    in_table = np.array([0.0, 1.2, 0.0, -1.2, 0.0, 1.5, 0.8])
    with pytest.raises(
        NoPlan,
        match=r"panda_rightfinger and table come nearer to each other than is safe, by \d+ mm",
    ):
        scene().check(line(Q_LOOK, in_table), "the way")


def test_a_posture_in_contact_is_refused_with_its_remedy():
    with pytest.raises(NoPlan, match=r"the posture is not free: .*; step back"):
        scene(in_the_palm()).require_free(Q_LOOK, "the posture", "step back")
