"""Inverse kinematics: every answer reaches its pose, and no configuration is missed."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tog_drake.panda import Q_LOWER, Q_UPPER, forward_kinematics
from tog_drake.panda_ik import BRANCHES, follow_path, inverse_kinematics, within_limits

SECOND_ELBOW = -0.467  # [rad] q4 beyond which the arm folds the other way


def _is_regular(q):
    """Away from the sets on which branches meet or angles are free."""
    near_straight = abs(q[3] - SECOND_ELBOW) < 1e-2
    return abs(q[1]) > 1e-4 and not near_straight and abs(abs(q[4]) - np.pi / 2) > 1e-3


def _recovery_error(q):
    """How far the best solution at q's pose and q7 is from q itself, (N,)."""
    solutions = inverse_kinematics(forward_kinematics(q), q[:, 6:])[:, 0]
    difference = np.abs(solutions - q[:, None]).max(axis=-1)
    return np.where(np.isnan(difference), np.inf, difference).min(axis=-1)


@settings(max_examples=200, deadline=None)
@given(fraction=st.lists(st.floats(0, 1), min_size=7, max_size=7))
def test_every_configuration_is_among_the_solutions_at_its_own_pose(fraction):
    q = Q_LOWER + np.array(fraction) * (Q_UPPER - Q_LOWER)
    assume(_is_regular(q))
    assert _recovery_error(q[None])[0] < 1e-6


def test_configurations_of_the_second_elbow_branch_are_found_too():
    rng = np.random.default_rng(0)
    lower, upper = Q_LOWER.copy(), Q_UPPER.copy()
    lower[3] = SECOND_ELBOW + 0.01
    q = rng.uniform(lower, upper, (500, 7))
    assert _recovery_error(q).max() < 1e-6


def test_every_solution_reaches_the_pose():
    rng = np.random.default_rng(1)
    X = forward_kinematics(rng.uniform(Q_LOWER, Q_UPPER, (100, 7)))
    q7 = np.linspace(Q_LOWER[6], Q_UPPER[6], 12)
    q = inverse_kinematics(X, q7)
    assert q.shape == (100, 12, BRANCHES, 7)
    solved = np.isfinite(q).all(axis=-1)
    assert solved.mean() > 0.2
    error = np.abs(forward_kinematics(q) - X[:, None, None])[solved]
    assert error.max() < 1e-9
    assert np.all(np.broadcast_to(q7[:, None], solved.shape)[solved] == q[solved][:, 6])
    assert np.isnan(q[~solved]).all()


def test_the_eight_branches_at_one_pose_are_eight_different_configurations():
    q = np.array([[0.3, 0.4, 0.2, -0.4, 0.3, 1.5, 0.4]])
    solutions = inverse_kinematics(forward_kinematics(q), q[:, 6])[0, 0]
    distance = np.abs(solutions[:, None] - solutions[None]).max(axis=-1)
    assert np.all(distance[~np.eye(BRANCHES, dtype=bool)] > 1e-3)


@pytest.mark.parametrize("q2", [0.0, 1e-12, 1e-9, 1e-6])
def test_at_the_shoulder_singularity_the_pose_is_still_reached(q2):
    q = np.array([[0.3, q2, -0.7, -2.0, 0.4, 1.8, 0.2]])
    X = forward_kinematics(q)
    solutions = inverse_kinematics(X, q[:, 6:])[0, 0]
    solved = np.isfinite(solutions).all(axis=-1)
    assert solved.any()
    assert np.abs(forward_kinematics(solutions[solved]) - X).max() < 1e-9


@pytest.mark.parametrize("place", [[1.2, 0.0, 0.2], [0.0, -1.1, 0.0], [0.0, 0.0, 2.0]])
def test_a_pose_out_of_reach_has_no_solution(place):
    X = np.diag([1.0, -1.0, -1.0, 1.0])[None].copy()
    X[0, :3, 3] = place
    assert np.isnan(inverse_kinematics(X, np.linspace(-2.8, 2.8, 12))).all()


def test_nan_is_outside_the_limits():
    q = np.array([(Q_LOWER + Q_UPPER) / 2, Q_UPPER - 0.04, np.full(7, np.nan)])
    assert within_limits(q, 0.0).tolist() == [True, True, False]
    assert within_limits(q, 0.05).tolist() == [True, False, False]


def _lift(q, height=0.15, points=13):
    X = np.repeat(forward_kinematics(q)[:, None], points, axis=1)
    X[..., 2, 3] += np.linspace(0, height, points)
    return X


def test_a_path_starts_at_the_given_configuration_and_reaches_every_pose():
    q = np.array([[0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.8], [0.5, 0.4, -0.3, -1.9, 0.2, 2.2, 0.3]])
    X = _lift(q)
    path = follow_path(X, q)
    np.testing.assert_array_equal(path[:, 0], q)
    assert np.abs(forward_kinematics(path) - X).max() < 3e-6
    assert np.abs(np.diff(path, axis=1)).max() < 0.1


def test_a_lift_past_the_shoulder_singularity_changes_q7_instead_of_jumping():
    q = np.array([[0.61, 0.14, -0.42, -2.25, -0.14, 2.22, -1.11]])
    X = _lift(q)
    nearest, steps = q[0], []
    for solutions in inverse_kinematics(X[0], q[0, 6:])[:, 0]:
        step = np.abs(solutions - nearest).max(axis=-1)
        nearest = solutions[np.nanargmin(step)]
        steps.append(np.nanmin(step))
    assert max(steps) > 0.5  # with q7 fixed
    path = follow_path(X, q)[0]
    assert np.abs(np.diff(path, axis=0)).max() < 0.05
    assert np.abs(forward_kinematics(path) - X[0]).max() < 3e-6


def test_a_path_that_leaves_the_reach_or_the_limits_is_nan():
    q = np.array([[0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.8], [0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 2.85]])
    assert np.isnan(follow_path(_lift(q, height=1.5), q)).all()
    path = follow_path(_lift(q), q, limit_margin=0.1)
    assert np.isfinite(path[0]).all()
    assert np.isnan(path[1]).all()


def test_a_path_does_not_depend_on_its_neighbours():
    rng = np.random.default_rng(2)
    q = rng.normal([0.0, 0.4, 0.0, -2.1, 0.0, 2.3, 0.6], 0.35, (40, 7))
    X = _lift(q, height=0.4, points=31)
    together = follow_path(X, q)
    alone = np.concatenate([follow_path(X[i : i + 1], q[i : i + 1]) for i in range(len(q))])
    assert 10 < np.isfinite(together).all(axis=(1, 2)).sum() < 40
    np.testing.assert_allclose(together, alone, rtol=0, atol=1e-9)
