"""Ways to put a joint path in time, all inside limits up to the jerk.

- ``rest_to_rest`` follows a path exactly, in closed form: for the short straight lines of approach
  and lift, and as the last resort for any other.
- ``optimize_spline`` finds the fastest spline near a path that keeps its distance from what may
  not be touched: for the long way to the grasp.
- ``come_to_rest`` leaves the path and brakes: for an arm that does not follow.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.planning import KinematicTrajectoryOptimization
from pydrake.polynomial import Polynomial
from pydrake.solvers import MathematicalProgramResult, SnoptSolver, SolverOptions
from pydrake.trajectories import BsplineTrajectory, PathParameterizedTrajectory, PiecewisePolynomial

from tog_drake.errors import InputError, NoPlan
from tog_drake.values import Array

ClearanceAndGradient: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""From q (N, 7) to the clearance (N,) [m] and its gradient (N, 7) [m/rad]."""

# s(τ) = 10τ³ − 15τ⁴ + 6τ⁵ moves from 0 to 1 with velocity and acceleration zero at both ends and
# with the least integral of squared jerk (Flash and Hogan, 1985).
_MINIMUM_JERK = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
PEAK_SPEED = 1.875  # of s(τ), in the middle: times the mean speed


@dataclass(frozen=True)
class JointLimits:
    """What the joints may do; velocity, acceleration and jerk are limits of the magnitude."""

    lower: Array  # (7,) [rad]
    upper: Array  # (7,) [rad]
    velocity: Array  # (7,) [rad/s]
    acceleration: Array  # (7,) [rad/s²]
    jerk: Array  # (7,) [rad/s³]

    def rates(self) -> tuple[Array, Array, Array]:
        """Returns the limits of the first, second and third derivative."""
        return self.velocity, self.acceleration, self.jerk

    def scaled(self, speed: float) -> "JointLimits":
        """Returns limits under which every motion takes 1/``speed`` times as long."""
        v, a, j = self.rates()
        return JointLimits(self.lower, self.upper, speed * v, speed**2 * a, speed**3 * j)


def rest_to_rest(
    path: Array, limits: JointLimits, start_time: float = 0.0, min_duration: float = 0.1
) -> PathParameterizedTrajectory:
    """Returns the path's smooth interpolation, travelled in a minimum-jerk profile.

    Velocity, acceleration and jerk of the profile fall with the first, second and third power of
    the duration, so the shortest duration inside the limits follows from one sampling at unit
    duration, without a solver.

    Args:
        path: (P, 7) [rad], P >= 2; the points are passed at equal steps of the profile's s.
        limits: of the joints; those of the position are not looked at.
        start_time: [s].
        min_duration: [s].
    """
    if len(path) == 2:  # a spline of continuous curvature needs a point more
        path = np.stack([path[0], path.mean(axis=0), path[1]])
    spline = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        np.linspace(0, 1, len(path)), path.T
    )
    s, ds, dds, ddds = (_MINIMUM_JERK.deriv(n)(np.linspace(0, 1, 1001)) for n in range(4))
    s = np.clip(s, 0, 1)
    q1, q2, q3 = (spline.MakeDerivative(n).vector_values(s) for n in (1, 2, 3))
    rates = (q1 * ds, q2 * ds**2 + q1 * dds, q3 * ds**3 + 3 * q2 * ds * dds + q1 * ddds)
    needed = [
        (np.abs(rate).max(axis=1) / limit).max() ** (1 / order)
        for order, (rate, limit) in enumerate(zip(rates, limits.rates(), strict=True), 1)
    ]
    duration = max(min_duration, 1.01 * max(needed))  # 1 %: between the samples
    coefficients = _MINIMUM_JERK.coef / duration ** np.arange(6)
    time_scaling = PiecewisePolynomial([Polynomial(coefficients)], [0.0, duration])
    time_scaling.shiftRight(start_time)
    return PathParameterizedTrajectory(spline, time_scaling)


def come_to_rest(
    q: Array, velocity: Array, acceleration: Array, limits: JointLimits
) -> Callable[[float], Array]:
    """Returns the command that takes every joint, by itself, to rest as fast as its limits allow.

    In closed form: at the greatest jerk to the braking acceleration, there for a while, and at the
    greatest jerk back to zero. Velocity is not limited, for nothing makes it larger but the
    acceleration that is there already. A joint that cannot come to rest before a limit of its
    position stands still there, abruptly; one that is beyond it already goes no farther.

    Args:
        q, velocity, acceleration: (7,) [rad, s] at time 0.
        limits: of the joints; an acceleration beyond its limit does not grow.

    Returns:
        From the time [s] since then to the command (7,) [rad].
    """
    j, most = limits.jerk, np.maximum(limits.acceleration, np.abs(acceleration))
    # The velocity that is left when the acceleration goes straight to zero tells where to brake.
    left = velocity + acceleration * np.abs(acceleration) / (2 * j)
    sign = -np.sign(np.where(left == 0, acceleration, left))
    v, a = sign * velocity, sign * acceleration  # so that to brake is to increase v up to zero
    # Without a hold, v changes by (peak² − a²) / 2j and then by peak² / 2j.
    peak = np.minimum(most, np.sqrt(np.maximum(0.0, a**2 / 2 - j * v)))
    gained = (2 * peak**2 - a**2) / (2 * j)
    hold = np.divide(-v - gained, peak, out=np.zeros_like(v), where=peak == most)
    phases = (
        ((peak - a) / j, sign * j),
        (np.maximum(0.0, hold), np.zeros_like(j)),
        (peak / j, -sign * j),
    )
    lower, upper = np.minimum(limits.lower, q), np.maximum(limits.upper, q)

    def command(t: float) -> Array:
        p, v, a, rest = q, velocity, acceleration, t
        for duration, jerk in phases:
            dt = np.clip(rest, 0.0, duration)
            p = p + v * dt + a * dt**2 / 2 + jerk * dt**3 / 6
            v = v + a * dt + jerk * dt**2 / 2
            a = a + jerk * dt
            rest = rest - dt
        return np.asarray(np.clip(p, lower, upper))

    return command


@dataclass
class SplineConfig:
    """How the fastest spline is looked for."""

    order: int = 4  # of the B-spline, at least 4: piecewise cubic
    control_points: int = 12  # at least 8; more follow a winding path better and take longer
    clearance_samples: int = 40  # configurations at which the clearance is demanded
    initial_duration: float = 4.0  # [s] where the search begins
    tolerance: float = 1e-3  # of optimality and of the constraints
    major_iterations: int = 50  # of the solver; its time limit has no effect
    limit_margin: float = 0.01  # part of each limit that is left to the tolerance


def optimize_spline(
    path: Array,
    limits: JointLimits,
    clearance_and_gradient: ClearanceAndGradient,
    clearance: float,
    config: SplineConfig,
    leeway: float = np.inf,
) -> BsplineTrajectory:
    """Returns the fastest spline from rest to rest that stays inside limits and keeps clear.

    Clearance holds at samples only: check the result densely. Velocity, acceleration and jerk
    hold everywhere, since a B-spline lies in the convex hull of its control points; velocity and
    acceleration are zero at both ends.

    Args:
        path: (P, 7) [rad], clear; the spline starts and ends exactly at its ends.
        limits: of the joints.
        clearance_and_gradient: see ``ClearanceAndGradient``.
        clearance: demanded [m].
        config: see ``SplineConfig``.
        leeway: how far the spline's control points may move away from the path [rad].

    Raises:
        NoPlan: the solver found none, or something that is not finite.
        InputError: the spline has too few control points or too low an order.
    """
    if not 4 <= config.order <= config.control_points or config.control_points < 8:
        raise InputError(
            f"a spline of order {config.order} with {config.control_points} control points cannot "
            "start and end at rest; valid: order 4 or more, 8 control points or more"
        )
    trajopt = KinematicTrajectoryOptimization(7, config.control_points, config.order)
    trajopt.AddDurationCost(1.0)
    trajopt.AddDurationConstraint(0.1, None)
    trajopt.AddPositionBounds(limits.lower, limits.upper)
    v, a, j = ((1 - config.limit_margin) * limit for limit in limits.rates())
    trajopt.AddVelocityBounds(-v, v)
    trajopt.AddAccelerationBounds(-a, a)
    trajopt.AddJerkBounds(-j, j)
    for s, q in ((0.0, path[0]), (1.0, path[-1])):
        trajopt.AddPathPositionConstraint(q, q, s)
        trajopt.AddPathVelocityConstraint(np.zeros(7), np.zeros(7), s)
        trajopt.AddPathAccelerationConstraint(np.zeros(7), np.zeros(7), s)
    _demand_clearance(trajopt, clearance_and_gradient, clearance, config.clearance_samples)

    points = _points_along(path, config.control_points)
    trajopt.SetInitialGuess(_b_spline(points, config.order, config.initial_duration))
    if np.isfinite(leeway):
        trajopt.get_mutable_prog().AddBoundingBoxConstraint(
            points - leeway, points + leeway, trajopt.control_points()
        )
    options = SolverOptions()
    solver = SnoptSolver()
    options.SetOption(solver.id(), "Major iterations limit", config.major_iterations)
    options.SetOption(solver.id(), "Major feasibility tolerance", config.tolerance)
    options.SetOption(solver.id(), "Major optimality tolerance", config.tolerance)
    result = solver.Solve(trajopt.prog(), trajopt.prog().initial_guess(), options)
    return _spline(trajopt, result, path)


def _demand_clearance(
    trajopt: KinematicTrajectoryOptimization,
    clearance_and_gradient: ClearanceAndGradient,
    clearance: float,
    samples: int,
) -> None:
    """Demands the clearance at evenly spaced inner points of the spline."""
    basis, points = trajopt.basis(), trajopt.control_points()
    inner = np.linspace(0, 1, samples + 2)[1:-1]
    weights = np.array(
        [[basis.EvaluateBasisFunctionI(i, s) for i in range(points.shape[1])] for s in inner]
    )

    def evaluate(x: Any) -> Any:
        """The clearances at control points x (7 n,), a joint after the other."""
        differentiate = x.dtype == object  # then x holds Drake's AutoDiffXd
        values = ExtractValue(x) if differentiate else x
        c, dc_dq = clearance_and_gradient(weights @ values.reshape(points.shape).T)
        if not differentiate:
            return c
        dc_dx = (dc_dq[:, :, None] * weights[:, None, :]).reshape(samples, x.size)
        return InitializeAutoDiff(c, dc_dx @ ExtractGradient(x)).ravel()

    lower, upper = np.full(samples, clearance), np.full(samples, np.inf)
    trajopt.get_mutable_prog().AddConstraint(evaluate, lower, upper, points.ravel())


def _points_along(path: Array, count: int) -> Array:
    """Returns control points (7, count) spread along the path; three at each end stand for rest."""
    rows = np.linspace(0, len(path) - 1, count - 4)
    along = np.stack([np.interp(rows, np.arange(len(path)), joint) for joint in path.T])
    return np.concatenate([along[:, [0, 0]], along, along[:, [-1, -1]]], axis=1)


def _spline(
    trajopt: KinematicTrajectoryOptimization, result: MathematicalProgramResult, path: Array
) -> BsplineTrajectory:
    """Returns the spline of a solution, with the ends exact that the solver met to a tolerance."""
    points = np.asarray(result.GetSolution(trajopt.control_points()))
    duration = result.GetSolution(trajopt.duration())
    # Drake ends the process when it evaluates a spline that holds NaN.
    if not (np.isfinite(points).all() and np.isfinite(duration) and duration > 0):
        raise NoPlan("the optimisation ended with values that are not finite; try another seed")
    if not result.is_success():
        raise NoPlan(
            f"the optimisation failed ({result.get_solution_result().name}); try another seed"
        )
    points[:, :3], points[:, -3:] = path[:1].T, path[-1:].T
    return _b_spline(points, trajopt.basis().order(), float(duration))


def _b_spline(points: Array, order: int, duration: float) -> BsplineTrajectory:
    basis = BsplineBasis(order, points.shape[1], KnotVectorType.kClampedUniform, 0.0, duration)
    return BsplineTrajectory(basis, list(points.T[:, :, None]))
