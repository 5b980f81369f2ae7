"""What no motion of a real arm may do, whatever a model says: limits, and how it stops.

Pure functions of joint angles at the period of the commands. Rates are finite differences of what
was commanded: v = Δq / dt, a = Δv / dt, j = Δa / dt. Those of a smooth motion are means of its
derivatives, so that a motion inside the limits passes.
"""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from tog_drake.errors import InputError, Stopped
from tog_drake.panda import A_MAX, J_MAX, Q_LOWER, Q_UPPER, V_MAX, X_HG, forward_kinematics
from tog_drake.time_parameterization import JointLimits
from tog_drake.values import Array, GraspMotion

PERIOD = 0.005  # [s] of the commands
LONGEST_STOP = 0.3  # [s]


@dataclass
class SafetyConfig:
    """Beyond what a motion is refused, or stopped."""

    workspace_lower: list[float] = field(default_factory=lambda: [0.2, -0.5, 0.0])
    workspace_upper: list[float] = field(default_factory=lambda: [0.85, 0.5, 0.8])
    """Box [m] that the grasp frame's origin stays in, in the arm's base frame."""
    hand_speed: float = 0.5  # [m/s] of the grasp frame's origin
    position_margin: float = 0.01  # [rad] kept from the joints' position limits, also by a stop
    velocity: float = 0.8  # of each joint's limit; so are the next two
    acceleration: float = 0.9
    jerk: float = 0.9
    start_tolerance: float = 0.01  # [rad] a motion begins so close to where the arm is
    tracking_error: float = 0.1  # [rad] commanded against measured
    external_torque: list[float] = field(
        default_factory=lambda: [20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0]
    )  # [Nm] of each joint; what libfranka's examples set as collision thresholds
    grip_force: float = 70.0  # [N] of each finger, whatever the scenario's grip_force
    status_age: float = 0.1  # [s] an older status is none
    image_age: float = 1.0  # [s] nothing is decided on an older image
    stall: float = 0.1  # [s] this program itself may be late while the arm moves


class StopReason(Enum):
    """Why a motion was stopped, or never began."""

    OPERATOR = "operator"  # Ctrl-C, or the STOP button
    NOT_FINITE = "not_finite"  # a commanded position is NaN or infinite
    POSITION = "position"  # the arm could not stop inside its joints' position limits
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    JERK = "jerk"
    WORKSPACE = "workspace"  # the hand would leave its box
    HAND_SPEED = "hand_speed"
    START = "start"  # the first command is not where the arm is
    STALE_STATUS = "stale_status"
    ROBOT_MODE = "robot_mode"  # the arm carries out no commands: a reflex, the e-stop ...
    TRACKING = "tracking"  # the arm is not where it was commanded to be
    EXTERNAL_TORQUE = "external_torque"
    FOREIGN_COMMAND = "foreign_command"  # somebody else commands the arm
    STALLED = "stalled"  # this program itself was late
    DEADLINE = "deadline"  # the motion did not end in time


@dataclass(frozen=True)
class Commanded:
    """The last command, and the rates that it and those before it mean; each (7,)."""

    q: Array  # [rad]
    v: Array  # [rad/s]
    a: Array  # [rad/s²]

    @staticmethod
    def at_rest(q: Array) -> "Commanded":
        return Commanded(np.array(q), np.zeros(7), np.zeros(7))

    def then(self, q: Array) -> "Commanded":
        """Returns the same after another command, ``PERIOD`` later."""
        v = (q - self.q) / PERIOD
        return Commanded(np.array(q), v, (v - self.v) / PERIOD)


def limits_of(config: SafetyConfig) -> JointLimits:
    """Returns what the joints may do.

    Raises:
        InputError: a setting is out of bounds, or a stop would take too long or be too abrupt.
    """
    _check(config)
    margin = config.position_margin
    limits = JointLimits(
        Q_LOWER + margin,
        Q_UPPER - margin,
        config.velocity * V_MAX,
        config.acceleration * A_MAX,
        config.jerk * J_MAX,
    )
    longest = (limits.velocity / limits.acceleration).max() + 2 * PERIOD
    if longest > LONGEST_STOP:
        raise InputError(
            f"safety: at velocity {config.velocity:g} and acceleration {config.acceleration:g} of "
            f"the limits a stop may take {longest:.2f} s; valid: at most {LONGEST_STOP} s"
        )
    # A stop goes from any acceleration to any other at once; see ``braked``.
    if np.any(2 * limits.acceleration > limits.jerk * PERIOD):
        raise InputError(
            f"safety: jerk {config.jerk:g} of the limit is too little to brake at acceleration "
            f"{config.acceleration:g} of the limit within a period; give more of the one or less "
            "of the other"
        )
    return limits


def _check(config: SafetyConfig) -> None:
    """Raises InputError for a setting that is out of bounds."""
    for name in ("velocity", "acceleration", "jerk"):
        if not 0 < (share := getattr(config, name)) <= 1:
            raise InputError(f"safety: {name} is a share of the limit, above 0 to 1, not {share:g}")
    for name in (
        *("hand_speed", "start_tolerance", "tracking_error", "grip_force"),
        *("status_age", "image_age", "stall"),
    ):
        if not (value := getattr(config, name)) > 0:
            raise InputError(f"safety: {name} must be above 0, not {value:g}")
    if not 0 <= config.position_margin < 0.5:
        raise InputError(
            f"safety: position_margin must be from 0 to 0.5 rad, not {config.position_margin:g}"
        )
    lower, upper = config.workspace_lower, config.workspace_upper
    if not (len(lower) == len(upper) == 3 and np.all(np.less(lower, upper))):
        raise InputError(
            f"safety: workspace_lower {lower} and workspace_upper {upper} must be three numbers "
            "each [m], every lower below its upper"
        )
    if len(config.external_torque) != 7 or min(config.external_torque) <= 0:
        raise InputError(
            f"safety: external_torque must be seven numbers above 0 [Nm], not "
            f"{config.external_torque}"
        )


def braked(last: Commanded, limits: JointLimits) -> Commanded:
    """Returns the next command of a stop: each joint, by itself, as hard as it may brake.

    Acceleration changes from any value to any other within a period, which the limits of jerk allow
    (``limits_of`` sees to it), so that velocity falls in a straight line and ends exactly at 0.
    """
    a = np.clip(-last.v / PERIOD, -limits.acceleration, limits.acceleration)
    # To the last digit, where it ends: who asks whether it stands still compares with 0.
    v = np.where(np.abs(last.v) <= limits.acceleration * PERIOD, 0.0, last.v + a * PERIOD)
    return Commanded(last.q + v * PERIOD, v, (v - last.v) / PERIOD)


def rest(q: Array, v: Array, limits: JointLimits) -> Array:
    """Returns where ``braked`` would end from q and v (..., 7) [rad, s]: (..., 7) [rad]."""
    step = limits.acceleration * PERIOD
    n = np.floor(np.abs(v) / step)
    way = PERIOD * (n * np.abs(v) - step * n * (n + 1) / 2)
    return np.asarray(q + np.sign(v) * way)


Broken = tuple[StopReason, str]
"""A rule, and how it would be broken."""


def broken_rule(
    last: Commanded, q: Array, config: SafetyConfig, limits: JointLimits
) -> Broken | None:
    """Returns the first rule that commands q (N, 7) [rad] would break; None where they break none.

    Not only where they lead must be allowed, but also where the arm would come to rest if it braked
    there: so a stop is always possible.

    Args:
        last: the command before them.
        q: one every ``PERIOD``.
        config, limits: the rules.
    """
    if not np.isfinite(q).all():
        return StopReason.NOT_FINITE, "a commanded position is not finite"
    v = np.diff(np.vstack([last.q, q]), axis=0) / PERIOD
    a = np.diff(np.vstack([last.v, v]), axis=0) / PERIOD
    j = np.diff(np.vstack([last.a, a]), axis=0) / PERIOD
    q_rest = rest(q, v, limits)
    # (N + 1, 2, 3): of the last command and of each, there and at rest.
    both = np.stack([np.vstack([last.q, q]), np.vstack([last.q, q_rest])], axis=1)
    p = (forward_kinematics(both) @ X_HG)[..., :3, 3]
    speed = np.linalg.norm(np.diff(p[:, 0], axis=0), axis=-1) / PERIOD
    outside = np.maximum(config.workspace_lower - p[1:], p[1:] - config.workspace_upper)
    beyond = np.maximum(limits.lower - q_rest, q_rest - limits.upper)
    tiny = 1e-9  # of rounding, in every unit
    rules = (
        (StopReason.VELOCITY, "joint velocity limits by {:.3f} rad/s", _over(v, limits.velocity)),
        (
            StopReason.ACCELERATION,
            "joint acceleration limits by {:.2f} rad/s²",
            _over(a, limits.acceleration),
        ),
        (StopReason.JERK, "joint jerk limits by {:.0f} rad/s³", _over(j, limits.jerk)),
        (StopReason.POSITION, "joint position limits by {:.3f} rad", beyond.max(axis=1)),
        (StopReason.WORKSPACE, "the workspace box by {:.3f} m", outside.max(axis=(1, 2))),
        (StopReason.HAND_SPEED, "the hand's speed limit by {:.2f} m/s", speed - config.hand_speed),
    )
    first = min(rules, key=lambda rule: _first(rule[2] > tiny))
    row = _first(first[2] > tiny)
    if row == len(q):
        return None
    return first[0], f"a command is beyond {first[1].format(float(first[2][row]))}"


def _over(rate: Array, limit: Array) -> Array:
    excess: Array = (np.abs(rate) - limit * (1 + 1e-6)).max(axis=1)  # 1e-6: of rounding
    return excess


def _first(wrong: Array) -> int:
    """The row of the first True; the number of rows where there is none."""
    return int(np.argmax(wrong)) if wrong.any() else len(wrong)


def check_motion(motion: GraspMotion, q_measured: Array, config: SafetyConfig) -> None:
    """Checks all of a motion as it would be commanded from ``q_measured`` (7,) [rad].

    Raises:
        Stopped: naming the rule that it would break, and when.
    """
    limits = limits_of(config)
    check_start(motion, q_measured, config)
    times = np.arange(1, round(motion.duration / PERIOD) + 1) * PERIOD
    q = motion.arm.vector_values(np.minimum(times, motion.duration)).T
    broken = broken_rule(Commanded.at_rest(motion.arm.value(0.0).ravel()), q, config, limits)
    if broken is not None:
        rule, how = broken
        raise Stopped(
            f"the planned motion is not executed: {how} (safety rule {rule.value}); give a lower "
            "hardware.speed or pipeline.trajectory.speed, or widen hardware.safety, knowingly",
            rule,
        )


def check_start(motion: GraspMotion, q_measured: Array, config: SafetyConfig) -> None:
    """Raises Stopped unless the motion begins where the arm is."""
    away = np.abs(motion.arm.value(0.0).ravel() - q_measured).max()
    if not away <= config.start_tolerance:  # NaN is not, either
        raise Stopped(
            f"the motion begins {away:.4f} rad away from where the arm is, more than "
            f"{config.start_tolerance:g}; it is not executed: run again",
            StopReason.START,
        )
