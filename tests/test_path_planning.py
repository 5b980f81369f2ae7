"""Paths of a point among walls in the plane, and around a ball in seven dimensions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import NoPlan
from tog_drake.path_planning import corners, find_path, shortcut, straight_line

LOWER, UPPER = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
LEFT, RIGHT = np.array([-0.8, 0.0]), np.array([0.8, 0.0])


def free_at_wall_with_gap(q):
    """Free except for a wall at |x| < 0.1 that leaves a gap at y > 0.6, (N,)."""
    return (np.abs(q[:, 0]) > 0.1) | (q[:, 1] > 0.6)


def leading(free):
    return len(free) if free.all() else int(np.argmin(free))


def wall_with_gap(q):
    return leading(free_at_wall_with_gap(q))


def closed_wall(q):
    return leading(np.abs(q[:, 0]) > 0.1)


def everything_free(q):
    return len(q)


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def test_a_free_straight_line_is_the_path():
    path = find_path(LEFT, RIGHT, everything_free, LOWER, UPPER, np.random.default_rng(0))
    np.testing.assert_array_equal(path, straight_line(LEFT, RIGHT, 0.05))


@pytest.mark.parametrize("seed", range(5))
def test_a_path_leads_around_a_wall_from_start_to_goal(seed):
    path = find_path(LEFT, RIGHT, wall_with_gap, LOWER, UPPER, np.random.default_rng(seed))
    np.testing.assert_array_equal(path[0], LEFT)
    np.testing.assert_array_equal(path[-1], RIGHT)
    assert free_at_wall_with_gap(path).all()
    assert np.abs(np.diff(path, axis=0)).max() <= 0.05 + 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_shortcuts_keep_the_ends_and_freedom_and_shorten_the_path(seed):
    rng = np.random.default_rng(seed)
    path = find_path(LEFT, RIGHT, wall_with_gap, LOWER, UPPER, rng)
    short = shortcut(path, wall_with_gap, rng)
    np.testing.assert_array_equal(short[[0, -1]], [LEFT, RIGHT])
    assert free_at_wall_with_gap(short).all()
    assert np.abs(np.diff(short, axis=0)).max() <= 0.05 + 1e-12
    # The shortest path touches both upper corners of the wall.
    shortest = 2 * np.hypot(0.7, 0.6) + 0.2
    assert shortest - 0.05 < length(short) < min(length(path) + 1e-12, 1.3 * shortest)


def test_a_path_is_found_in_seven_dimensions():
    lower, upper = -np.full(7, 3.0), np.full(7, 3.0)
    start, goal = np.full(7, -1.0), np.full(7, 1.0)

    def outside_a_ball(q):
        return leading(np.linalg.norm(q, axis=1) > 1.5)

    path = find_path(start, goal, outside_a_ball, lower, upper, np.random.default_rng(1))
    assert np.linalg.norm(path, axis=1).min() > 1.5
    assert np.abs(np.diff(path, axis=0)).max() <= 0.05 + 1e-12


@pytest.mark.parametrize(("start", "goal", "name"), [(0.0, 0.8, "start"), (-0.8, 0.0, "goal")])
def test_an_end_in_collision_is_named(start, goal, name):
    with pytest.raises(NoPlan, match=name):
        find_path(
            np.array([start, 0.0]),
            np.array([goal, 0.0]),
            wall_with_gap,
            LOWER,
            UPPER,
            np.random.default_rng(0),
        )


def test_a_closed_wall_ends_in_no_plan_and_not_in_a_loop():
    with pytest.raises(NoPlan, match="50 iterations"):
        find_path(
            LEFT, RIGHT, closed_wall, LOWER, UPPER, np.random.default_rng(0), max_iterations=50
        )


def test_the_same_seed_gives_the_same_path_and_another_seed_another():
    def plan(seed):
        rng = np.random.default_rng(seed)
        return shortcut(
            find_path(LEFT, RIGHT, wall_with_gap, LOWER, UPPER, rng), wall_with_gap, rng
        )

    np.testing.assert_array_equal(plan(3), plan(3))
    assert length(plan(3)) != length(plan(4))


@settings(max_examples=50, deadline=None)
@given(
    ends=st.lists(st.tuples(st.floats(-3, 3), st.floats(-3, 3)), min_size=2, max_size=2),
    step=st.floats(0.01, 1.0),
)
def test_a_straight_line_has_its_ends_exactly_and_no_step_too_long(ends, step):
    q_from, q_to = np.array(ends)
    line = straight_line(q_from, q_to, step)
    np.testing.assert_array_equal(line[[0, -1]], [q_from, q_to])
    assert np.abs(np.diff(line, axis=0)).max() <= step * (1 + 1e-9)
    assert length(line) == pytest.approx(np.linalg.norm(q_to - q_from))


def test_only_corners_remain_of_a_path():
    turn = np.array([0.0, 0.9])
    path = np.concatenate([straight_line(LEFT, turn, 0.05), straight_line(turn, RIGHT, 0.05)[1:]])
    np.testing.assert_array_equal(corners(path), [LEFT, turn, RIGHT])
