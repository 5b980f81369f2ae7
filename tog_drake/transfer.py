"""From one posture to another, around everything: the long ways of a motion.

A path of straight lines that is free, then the fastest spline near it that keeps its distance, then
a dense check of the spline; several times over, and in the end the path itself, with stops.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pydrake.trajectories import CompositeTrajectory, Trajectory

from tog_drake.errors import InputError, NoPlan
from tog_drake.obstacles import Obstacles
from tog_drake.panda import A_MAX, J_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.path_planning import corners, find_path, shortcut
from tog_drake.time_parameterization import (
    JointLimits,
    SplineConfig,
    optimize_spline,
    rest_to_rest,
)
from tog_drake.values import Array

_ROUNDING = 1e-6  # [m]
_RATES = ("velocity", "acceleration", "jerk")
_LIMIT_PERIOD = 0.005  # [s] between the samples at which the limits are checked
_TOLERANCE = 1e-3  # part of a limit that rounding may take more


@dataclass
class TransferConfig:
    """How a way is looked for, and how far it stays from what the camera saw."""

    clearance: float = 0.01  # [m] from the cloud that is planned for
    path_step: float = 0.05  # [rad] between checked configurations of a path
    shortcuts: int = 30  # tried on a path that is not straight
    attempts: int = 5  # paths and splines tried before the arm is sent along a path with stops
    spline: SplineConfig = field(default_factory=SplineConfig)


def plan_transfer(
    q_from: Array,
    q_to: Array,
    what: str,
    obstacles: Obstacles,
    limits: JointLimits,
    config: TransferConfig,
    seed: int,
) -> tuple[Trajectory, str]:
    """Returns the fastest way that is found between two free postures, checked, and how it was.

    Args:
        q_from, q_to: (7,) [rad]; at both the arm is at rest.
        what: the way is, for a person.
        obstacles: what it must not touch.
        limits: of the joints.
        config: see ``TransferConfig``.
        seed: decides everything that is random.

    Raises:
        NoPlan: no path was found, or none could be followed without touching anything.
    """
    ends = np.stack([q_from, q_to])
    # Where an end itself is nearer to something, no more than that can be asked of the way.
    clearance = min(config.clearance, float(obstacles.cloud_clearance(ends).min()) - _ROUNDING)
    hand_margin = obstacles.count_free(ends, clearance, hand_margin=True) == len(ends)

    def count_free(q: Array) -> int:
        return obstacles.count_free(q, clearance, hand_margin=hand_margin)

    def check(way: Trajectory) -> None:
        obstacles.check(way, what, hand_margin=hand_margin)

    rng = np.random.default_rng(seed)
    step, path, failure = config.path_step, None, ""
    for attempt in range(config.attempts):
        spread = 1.0 + attempt  # [rad] beyond the ends: first look for paths that stay near
        lower = np.maximum(limits.lower, ends.min(axis=0) - spread)
        upper = np.minimum(limits.upper, ends.max(axis=0) + spread)
        # The optimisation does not know the robot itself nor the known world: where that fails the
        # check, it is held ever closer to the path, which does.
        leeway = np.inf if attempt == 0 else 0.4 / 2**attempt  # [rad]
        try:
            path = find_path(q_from, q_to, count_free, lower, upper, rng, step=step)
            path = shortcut(path, count_free, rng, step=step, attempts=config.shortcuts)
            spline = optimize_spline(
                path,
                limits,
                obstacles.cloud_clearance_and_gradient,
                clearance,
                config.spline,
                leeway,
            )
            check(spline)
            return spline, f"optimised, attempt {attempt + 1}"
        except NoPlan as error:
            if path is None:
                raise
            failure = str(error)
    assert path is not None
    stops = _with_stops(corners(path), limits)
    check(stops)
    return stops, f"with stops, since {config.attempts} attempts to optimise failed: {failure}"


def _with_stops(path: Array, limits: JointLimits) -> Trajectory:
    """Follows straight lines exactly, at rest at every corner: slow, but as safe as the path."""
    segments: list[Trajectory] = []
    for line in pairwise(path):
        start = segments[-1].end_time() if segments else 0.0
        segments.append(rest_to_rest(np.stack(line), limits, start))
    return CompositeTrajectory(segments)


def limits_at(speed: float, position_margin: float, q_now: Array, q_path: Array) -> JointLimits:
    """Returns the robot's limits at a speed.

    The margin to the position limits gives way to ``q_now`` (7,) and ``q_path`` (N, 7); the limits
    themselves do so to ``q_now`` alone, where the arm is already.

    Args:
        speed: part of the fastest, above 0, up to 1.
        position_margin: [rad] kept from the joints' position limits.
        q_now, q_path: [rad].

    Raises:
        InputError: a speed that is none.
    """
    if not 0 < speed <= 1:
        raise InputError(f"trajectory.speed is {speed}; valid: above 0, up to 1")
    q = np.vstack([q_now, q_path])
    lower, upper = Q_LOWER + position_margin, Q_UPPER - position_margin
    lower = np.clip(q.min(axis=0), np.minimum(Q_LOWER, q_now), lower)
    upper = np.clip(q.max(axis=0), upper, np.maximum(Q_UPPER, q_now))
    return JointLimits(lower, upper, V_MAX, A_MAX, J_MAX).scaled(speed)


def check_limits(arm: Trajectory, q_now: Array, limits: JointLimits) -> None:
    """Raises NoPlan unless the motion starts at rest at q_now, is finite and inside the limits."""
    end = arm.end_time()
    times = np.linspace(0, end, int(end / _LIMIT_PERIOD) + 2)
    q = arm.vector_values(times)
    rates = [arm.MakeDerivative(order).vector_values(times) for order in (1, 2, 3)]
    if not all(np.isfinite(values).all() for values in (q, *rates)):
        raise NoPlan("the motion holds values that are not finite; plan with another seed")
    start = max(np.abs(q[:, 0] - q_now).max(), np.abs(rates[0][:, 0]).max())
    if start > 1e-9:
        raise NoPlan(f"the motion starts {start:.2g} away from rest at the arm's present posture")
    middle, half = (limits.upper + limits.lower) / 2, (limits.upper - limits.lower) / 2
    used = {"position": np.abs(q.T - middle) / half}  # 1 is at the limit
    for name, rate, limit in zip(_RATES, rates, limits.rates(), strict=True):
        used[name] = np.abs(rate.T) / limit
    for name, part in used.items():
        if part.max() > 1 + _TOLERANCE:
            i, joint = np.unravel_index(part.argmax(), part.shape)
            raise NoPlan(
                f"the motion would break the {name} limit of joint {joint + 1} at "
                f"{times[i]:.2f} s, at {100 * part.max():.1f} % of it; plan with a lower speed"
            )
