"""Timing of joint paths: numbers worked by hand, and limits that hold."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError, NoPlan
from tog_drake.panda import A_MAX, J_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.time_parameterization import (
    JointLimits,
    SplineConfig,
    come_to_rest,
    optimize_spline,
    rest_to_rest,
)

ONES = np.ones(7)
LIMITS = JointLimits(-3 * ONES, 3 * ONES, 2 * ONES, 10 * ONES, 5000 * ONES)


def rates(trajectory, times):
    return [trajectory.MakeDerivative(order).vector_values(times) for order in (1, 2, 3)]


def everything_is_far(q):
    return np.ones(len(q)), np.zeros_like(q)


def line(length):
    path = np.zeros((2, 7))
    path[1, 2] = length
    return path


def test_a_long_line_takes_the_time_that_its_peak_speed_needs():
    # The peak speed is 15/8 of the mean; 1 % is added for what lies between samples.
    trajectory = rest_to_rest(line(4.0), LIMITS)
    assert trajectory.end_time() == pytest.approx(1.01 * 15 / 8 * 4.0 / 2.0, rel=1e-4)


def test_a_short_line_takes_the_time_that_its_peak_acceleration_needs():
    # The peak acceleration is 10/√3 · length / duration².
    trajectory = rest_to_rest(line(0.1), LIMITS)
    assert trajectory.end_time() == pytest.approx(
        1.01 * np.sqrt(10 / np.sqrt(3) * 0.1 / 10), rel=1e-4
    )


def test_a_low_jerk_limit_is_kept_at_the_ends_where_the_jerk_peaks():
    limits = JointLimits(-3 * ONES, 3 * ONES, 2 * ONES, 10 * ONES, 20 * ONES)
    trajectory = rest_to_rest(line(0.1), limits)
    # The jerk at both ends is 60 · length / duration³.
    assert trajectory.end_time() == pytest.approx(1.01 * np.cbrt(60 * 0.1 / 20), rel=1e-4)


def test_a_minimum_duration_and_a_start_time_are_respected():
    trajectory = rest_to_rest(line(0.01), LIMITS, start_time=3.0, min_duration=2.0)
    assert (trajectory.start_time(), trajectory.end_time()) == (3.0, 5.0)
    np.testing.assert_allclose(trajectory.value(4.0).ravel(), line(0.005)[1], atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 12))
def test_every_path_is_passed_through_from_rest_to_rest_inside_the_limits(seed, count):
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.uniform(-0.1, 0.1, (count, 7)), axis=0)
    trajectory = rest_to_rest(path, LIMITS)
    times = np.linspace(0, trajectory.end_time(), 2000)
    q = trajectory.vector_values(times)
    np.testing.assert_allclose(q[:, [0, -1]].T, path[[0, -1]], atol=1e-12)
    assert np.abs(q.T[:, None] - path).max(axis=-1).min(axis=0).max() < 0.01
    for rate, limit in zip(rates(trajectory, times), LIMITS.rates(), strict=True):
        assert (np.abs(rate) / limit[:, None]).max() < 1.0
    velocity, acceleration, _ = rates(trajectory, [0.0, trajectory.end_time()])
    assert np.abs(velocity).max() < 1e-9
    assert np.abs(acceleration).max() < 1e-6


def test_half_the_speed_takes_twice_the_time_whatever_the_limit():
    for length in (0.01, 0.1, 4.0):
        fast, slow = (rest_to_rest(line(length), LIMITS.scaled(s), 0, 0.0) for s in (1.0, 0.5))
        assert slow.end_time() == pytest.approx(2 * fast.end_time())


def test_a_free_spline_is_fast_and_inside_the_limits_everywhere():
    path = np.linspace(np.zeros(7), np.array([1.0, -0.5, 0.3, 0, 0, 0.2, -1.0]), 20)
    spline = optimize_spline(path, LIMITS, everything_is_far, 0.01, SplineConfig())
    times = np.linspace(0, spline.end_time(), 3000)
    for rate, limit in zip(rates(spline, times), LIMITS.rates(), strict=True):
        assert (np.abs(rate) / limit[:, None]).max() < 1.0
    # Bang-bang at 10 rad/s² up to 2 rad/s takes 0.7 s and has no bound on the jerk.
    assert 0.7 < spline.end_time() < 1.05
    np.testing.assert_array_equal(spline.vector_values([0.0]).ravel(), path[0])
    np.testing.assert_allclose(spline.vector_values([spline.end_time()]).ravel(), path[-1])
    velocity, acceleration, _ = rates(spline, [0.0, spline.end_time()])
    assert np.abs(velocity).max() < 1e-9
    assert np.abs(acceleration).max() < 1e-6


def test_a_spline_goes_around_a_ball_in_joint_space():
    centre, radius = np.array([0.5, 0.02, 0, 0, 0, 0, 0]), 0.2

    def from_the_ball(q):
        away = q - centre
        distance = np.linalg.norm(away, axis=1)
        return distance - radius, away / distance[:, None]

    corner = np.array([0.5, 0.4, 0, 0, 0, 0, 0])
    goal = np.array([1.0, 0, 0, 0, 0, 0, 0])
    path = np.vstack([np.linspace(0 * ONES, corner, 10), np.linspace(corner, goal, 10)[1:]])
    spline = optimize_spline(path, LIMITS, from_the_ball, 0.05, SplineConfig())
    q = spline.vector_values(np.linspace(0, spline.end_time(), 500)).T
    assert from_the_ball(q)[0].min() > 0.04
    assert from_the_ball(q)[0].min() < 0.10  # it does not make a detour either


def test_leeway_holds_a_spline_near_its_path():
    corner, goal = np.eye(7)[0], np.eye(7)[1]
    path = np.vstack([np.linspace(0 * ONES, corner, 20), np.linspace(corner, goal, 20)[1:]])

    def largest_detour(leeway):
        spline = optimize_spline(path, LIMITS, everything_is_far, 0.0, SplineConfig(), leeway)
        q = spline.vector_values(np.linspace(0, spline.end_time(), 200)).T
        return np.abs(q[:, None] - path).max(axis=-1).min(axis=1).max()

    assert largest_detour(0.02) < 0.2 < largest_detour(np.inf)


def test_a_spline_that_cannot_keep_its_clearance_is_refused():
    def always_inside(q):
        return np.full(len(q), -0.1), np.zeros_like(q)

    with pytest.raises(NoPlan, match="optimisation failed"):
        optimize_spline(line(1.0), LIMITS, always_inside, 0.01, SplineConfig())


def test_a_solution_that_is_not_finite_is_refused_before_it_is_evaluated(monkeypatch):
    class Broken:
        def is_success(self):
            return True

        def GetSolution(self, variables):
            return np.nan * np.ones(np.shape(variables))

    monkeypatch.setattr("pydrake.solvers.SnoptSolver.Solve", lambda *_: Broken())
    with pytest.raises(NoPlan, match="not finite"):
        optimize_spline(line(1.0), LIMITS, everything_is_far, 0.01, SplineConfig())


@pytest.mark.parametrize("config", [SplineConfig(control_points=7), SplineConfig(order=3)])
def test_a_spline_that_cannot_rest_at_its_ends_is_refused(config):
    with pytest.raises(InputError, match="8 control points or more"):
        optimize_spline(line(1.0), LIMITS, everything_is_far, 0.01, config)


PANDA = JointLimits(Q_LOWER, Q_UPPER, V_MAX, A_MAX, J_MAX)
MIDDLE = (Q_LOWER + Q_UPPER) / 2
FREE = replace(PANDA, lower=-10 * ONES, upper=10 * ONES)  # no stop ends at a position limit


def sampled(stop, h=1e-3, end=0.5):
    """Positions every h, and velocity, acceleration and jerk as means over steps of h."""
    q = np.array([stop(t) for t in np.arange(0.0, end, h)])
    return q, [np.diff(q, n, axis=0) / h**n for n in (1, 2, 3)]


def test_a_stop_takes_the_distance_that_braking_takes():
    # 2 ms at 5000 rad/s³ up to 10 rad/s², 98 ms there, 2 ms back: on average at 0.5 rad/s.
    stop = come_to_rest(0 * ONES, ONES, 0 * ONES, LIMITS)
    np.testing.assert_allclose(stop(1.0), 0.5 * 0.102)
    assert (stop(0.1) < stop(0.102)).all()
    # At 20 rad/s³ it gets no farther than √20 rad/s², and takes as long up as down.
    gentle = come_to_rest(0 * ONES, ONES, 0 * ONES, replace(LIMITS, jerk=20 * ONES))
    np.testing.assert_allclose(gentle(1.0), 0.5 * 2 / np.sqrt(20))


def test_a_stop_from_near_all_limits_goes_hardly_farther_than_it_must():
    velocity, acceleration = 0.9 * V_MAX, 0.9 * A_MAX
    stop = come_to_rest(MIDDLE, velocity, acceleration, FREE)
    q, rates_of_stop = sampled(stop)
    braking_path = velocity**2 / (2 * A_MAX)  # with no limit of the jerk
    assert (q[-1] - MIDDLE > braking_path).all()
    assert (q[-1] - MIDDLE < 1.1 * braking_path).all()
    for rate, limit in zip(rates_of_stop, FREE.rates(), strict=True):
        assert (np.abs(rate) < (1 + 1e-5) * limit).all()
    np.testing.assert_array_equal(stop(0.5), stop(60.0))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), slow=st.sampled_from([0.0, 1e-3, 1.0]))
def test_every_stop_goes_on_smoothly_inside_the_limits_and_ends_at_rest(seed, slow):
    rng = np.random.default_rng(seed)
    velocity = slow * rng.uniform(-0.9, 0.9, 7) * V_MAX
    acceleration = rng.choice([0.0, 1.0]) * rng.uniform(-1, 1, 7) * A_MAX
    q, (first, second, third) = sampled(come_to_rest(MIDDLE, velocity, acceleration, FREE))
    np.testing.assert_array_equal(q[0], MIDDLE)
    np.testing.assert_allclose(first[0], velocity, atol=1e-3 * A_MAX.max())
    assert (np.abs(second[0] - acceleration) < 1.01e-3 * J_MAX).all()
    for rate, limit in zip((first, second, third), FREE.rates(), strict=True):
        assert (np.abs(rate) < (1 + 1e-5) * limit).all()
    assert np.abs(first[-10:]).max() < 1e-9
    # It does not turn back, but for what the acceleration at the start brings with it.
    left = velocity + acceleration * np.abs(acceleration) / (2 * J_MAX)
    back = first[3 + (np.abs(acceleration) / J_MAX / 1e-3).astype(int).max() :] * -np.sign(left)
    assert back.max() < 1e-9


def test_a_stop_ends_at_the_position_limits_and_never_jumps_to_them():
    before, beyond = Q_UPPER - 0.01, Q_UPPER + 0.005
    for start, end in ((before, Q_UPPER), (beyond, beyond)):
        for side in (1, -1):
            limits = PANDA if side == 1 else replace(PANDA, lower=-Q_UPPER, upper=-Q_LOWER)
            q, _ = sampled(come_to_rest(side * start, side * 0.5 * V_MAX, 0 * ONES, limits))
            np.testing.assert_array_equal(q[0], side * start)
            assert (side * q <= end).all()
            np.testing.assert_array_equal(q[-1], side * end)
