"""What the arm's driver does with commands, as rules: no LCM, no clock, no physics.

The rules are those of drake-franka-driver in position mode and of the controller behind it. The
driver carries out the newest command until the next one; it ignores those that are too old; a
message it does not understand ends it. The controller answers what no arm can follow by a reflex:
the arm brakes and stands, and nothing is carried out until the driver was started anew.

Where the real one is known less than that, this one is the stricter: it is a rehearsal.
"""

import math
from collections.abc import Callable
from enum import Enum

import numpy as np
from drake import lcmt_panda_command

from tog_drake.panda import A_MAX, J_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.stations.lcm_bus import POSITION_MODE, RobotMode
from tog_drake.time_parameterization import JointLimits, come_to_rest
from tog_drake.values import Array

EXPIRY = 0.1  # [s] the driver's --expire_sec: a command that is older, or as far ahead, is none
FIRST_STEP = 0.01  # [rad] the first command may be so far from where the arm is held
# A step is judged as the speed it means. Time stamps say when a command was sent, which a busy
# computer does unevenly: two in quick succession count as the period of a 200 Hz sender, and after
# a gap the step is taken to be made in this time, for the arm has stood still before.
SHORTEST, LONGEST = 0.005, 0.02  # [s]
MAX_CHANGE = 0.5  # of the velocity limit: a greater change between two commands is a discontinuity
FILTER = 30.0  # [Hz] cut-off of the low-pass through which commands reach the joints


class Verdict(Enum):
    """What became of a command."""

    ACCEPTED = "accepted"
    EXPIRED = "expired"  # too old, or of the future
    IGNORED = "ignored"  # the driver is in no mode to move
    REFLEX = "reflex"  # no arm could follow it
    ENDED = "ended"  # the driver does not understand it, and ends


class ArmDriver:
    """The driver of an arm that stands at ``q`` (7,) [rad]. Times are Unix times [s].

    Args:
        q: where the arm is held until the first command.
        recover_after: [s] from a reflex, or the driver's end, to a driver that was started anew;
            infinite: it stays so.
        longest: [s] see ``LONGEST``; more of it forgives commands that were lost.
    """

    def __init__(self, q: Array, recover_after: float = math.inf, longest: float = LONGEST):
        self.mode = RobotMode.MOVE
        self.running = True  # False: the process has ended; no status is sent
        self.why = ""  # it is in another mode than MOVE, or not running
        self.q_desired = q  # (7,) [rad] what the joints are told
        self.moved = False  # whether a command ever asked for anything but standing still
        self._recover_after = recover_after
        self._longest = longest
        self._back_at = math.inf  # when it is started anew
        self._brake: tuple[float, Callable[[float], Array]] | None = None  # since when, and how
        self._q_first = q
        # Of the last accepted command, (7,) [rad], what it meant, (7,) [rad/s], and [µs].
        self._q, self._v = q, np.zeros(7)
        self._utime: int | None = None  # None: there was none

    def receive(self, data: bytes, now: float) -> Verdict:
        """Takes a message of the command channel; says what became of it."""
        if not self.running or self.mode is not RobotMode.MOVE:
            return Verdict.IGNORED
        try:
            utime, q = read_arm_command(data)
        except ValueError as error:
            self.end(str(error), now)
            return Verdict.ENDED
        if abs(now - utime / 1e6) > EXPIRY:
            return Verdict.EXPIRED
        v = self._speed(q, utime)
        if problem := self._problem(q, v):
            self.reflex(problem, now)
            return Verdict.REFLEX
        self._q, self._v, self._utime = q, v, utime
        self.moved = self.moved or bool(np.any(np.abs(q - self._q_first) > 1e-3))
        return Verdict.ACCEPTED

    def _speed(self, q: Array, utime: int) -> Array:
        if self._utime is None:
            return np.zeros(7)
        dt = min(max((utime - self._utime) / 1e6, SHORTEST), self._longest)
        return (q - self._q) / dt

    def _problem(self, q: Array, v: Array) -> str:
        """Why no arm could follow a command, or nothing."""
        if not np.all(np.isfinite(q)):
            return "a commanded position is not finite"
        for problem, value, most in (
            ("a position below its limit", Q_LOWER - q, 0.0),
            ("a position above its limit", q - Q_UPPER, 0.0),
            ("a jump: a velocity beyond its limit", np.abs(v), V_MAX),
            ("a discontinuity of the velocity", np.abs(v - self._v), MAX_CHANGE * V_MAX),
        ):
            if np.any(value > most):
                joint = int(np.argmax(value - most))
                return f"{problem} (joint {joint + 1}, {np.broadcast_to(value, 7)[joint]:.3g})"
        if self._utime is None and np.any(np.abs(q - self._q) > FIRST_STEP):
            return "the first command is not where the arm is"
        return ""

    def reflex(self, why: str, now: float, lasts: float | None = None) -> None:
        """Brakes as hard as the joints may, and stands.

        Args:
            why: in words.
            now: when.
            lasts: [s] until it recovers; None: ``recover_after``.
        """
        self.mode, self.why = RobotMode.REFLEX, why
        limits = JointLimits(Q_LOWER, Q_UPPER, V_MAX, A_MAX, J_MAX)
        self._brake = now, come_to_rest(self._q, self._v, np.zeros(7), limits)
        self._back_at = now + (self._recover_after if lasts is None else lasts)

    def end(self, why: str, now: float, silence: float | None = None) -> None:
        """Ends the process: no status. Started anew after ``silence`` [s], or ``recover_after``."""
        if self.mode is RobotMode.MOVE:
            self.reflex(why, now)  # without its driver, the arm brakes too
        self.running, self.why = False, why
        self._back_at = now + (self._recover_after if silence is None else silence)

    def advance(self, now: float, dt: float) -> Array:
        """Returns what the joints are told now, (7,) [rad], ``dt`` [s] after the last time."""
        if now >= self._back_at:
            self._start_anew()
        target = self._q
        if self._brake is not None:
            since, profile = self._brake
            target = profile(now - since)
        share = dt / (dt + 1 / (2 * np.pi * FILTER))
        self.q_desired = self.q_desired + share * (target - self.q_desired)
        return self.q_desired

    def _start_anew(self) -> None:
        self.mode, self.running, self.why = RobotMode.MOVE, True, ""
        self._brake, self._back_at = None, math.inf
        self._q, self._v, self._utime = self.q_desired, np.zeros(7), None


def read_arm_command(data: bytes) -> tuple[int, Array]:
    """Returns utime [µs] and the positions (7,) [rad] of a command in position mode.

    Raises:
        ValueError: it is another message, or in another mode.
    """
    try:
        m = lcmt_panda_command.decode(data)
    except Exception as error:  # of struct or numbers: LCM's own code does not say
        raise ValueError("a command is no lcmt_panda_command") from error
    counts = m.num_joint_position, m.num_joint_velocity, m.num_joint_torque
    if counts != (7, 0, 0):
        raise ValueError(f"a command holds {counts} positions, velocities, torques, not (7, 0, 0)")
    if m.control_mode_expected != POSITION_MODE:
        raise ValueError(
            f"a command expects control mode {m.control_mode_expected}; this is {POSITION_MODE}"
        )
    return m.utime, np.asarray(m.joint_position, dtype=float)
