"""What no motion of a real arm may do, whatever a model says: limits, and how it stops.

Pure functions of joint angles at the period of the commands. Rates are finite differences of what
was commanded: v = Δq / dt, a = Δv / dt, j = Δa / dt, which no derivative of a smooth motion through
the same points stays below everywhere.
"""

from dataclasses import dataclass, field
from enum import Enum


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
