"""What the hand's driver does with commands, as rules: no LCM, no clock, no physics.

The rules are those of franka_hand_driver. A command wider than the hand is a move to that width. A
narrower one is a grasp: the hand closes until something resists with the force of the command,
**whatever the width it names** (so users of libfranka's ``grasp`` report: franka_ros, issue 130).
A new command stops what is going on; one that is like the last accepted one is ignored for ever.
Homing, which the real one does when it starts, is taken to have been done.
"""

import math
from enum import Enum

from drake import lcmt_schunk_wsg_command

from tog_drake.panda import MAX_OPENING

SPEED = 0.1  # [m/s] of both fingers towards each other: the driver's --grasp_speed as it is set
MOVING_RATE = 0.005  # [m/s] what the status says while an operation runs, however fast it is
MAX_FORCE = 140.0  # [N] of the hand, for a moment
_ARRIVED = 0.001  # [m] a move ends so close to its width


class HandVerdict(Enum):
    """What became of a command."""

    MOVE = "move"
    GRASP = "grasp"
    IGNORED = "ignored"  # it is like the last one
    REFUSED = "refused"  # no message, or no width


class HandDriver:
    """The driver of a hand that is open by ``opening`` [m].

    Args:
        opening: between the pads.
        stiffness: [N/m] of each finger: how hard it presses when told to go where it cannot.
    """

    def __init__(self, opening: float, stiffness: float):
        self.rate = 0.0  # [m/s] what the status says
        self.force = 0.0  # [N] that the last command named
        self._stiffness = stiffness
        self._command = opening  # [m] what the fingers are told
        self._last: tuple[float, float] | None = None  # width [mm] and force [N] of the command
        self._goal = opening  # [m] of a move
        self._press: float | None = None  # [m] beyond contact, of a grasp; None: it is a move

    def receive(self, data: bytes, opening: float) -> HandVerdict:
        """Takes a message of the command channel, the hand being open by ``opening`` [m]."""
        try:
            m = lcmt_schunk_wsg_command.decode(data)
        except Exception:  # of struct or numbers: LCM's own code does not say
            return HandVerdict.REFUSED
        if not (math.isfinite(m.target_position_mm) and math.isfinite(m.force)):
            return HandVerdict.REFUSED
        if (m.target_position_mm, m.force) == self._last:
            return HandVerdict.IGNORED
        self._last = m.target_position_mm, m.force
        self.force = m.force
        self._goal = min(max(m.target_position_mm / 1e3, 0.0), MAX_OPENING)
        self.rate = MOVING_RATE
        self._command = opening
        if self._goal >= opening:
            self._press = None
            return HandVerdict.MOVE
        force = min(max(m.force, 0.0), MAX_FORCE)
        self._press = 2 * force / self._stiffness
        return HandVerdict.GRASP

    def advance(self, opening: float, dt: float) -> float:
        """Returns what the fingers are told [m], ``dt`` [s] after the last time.

        Below ``opening`` they squeeze what is between them.
        """
        if self.rate == 0.0:
            return self._command
        if self._press is None:
            self._command = min(self._command + SPEED * dt, self._goal)
            done = abs(opening - self._goal) < _ARRIVED
        else:
            pressing = opening - self._press
            self._command = max(self._command - SPEED * dt, pressing)
            done = self._command == pressing
        if done:
            self.rate = 0.0
        return self._command
