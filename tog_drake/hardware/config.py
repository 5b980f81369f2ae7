"""What a scenario says of the real robot, in its section ``hardware``."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from tog_drake.errors import InputError
from tog_drake.safety import SafetyConfig
from tog_drake.stations.lcm_camera import LcmImages
from tog_drake.stations.realsense import RealSense

if TYPE_CHECKING:
    from tog_drake.scenario import Scenario

RealCamera: TypeAlias = LcmImages | RealSense


@dataclass
class HardwareConfig:
    """The real robot behind the same scenario: how it is reached, and how far it is trusted."""

    lcm_url: str = ""
    """Of the drivers; "" is LCM's default group on this host."""
    cameras: dict[str, RealCamera] = field(
        default_factory=lambda: {"wrist": LcmImages(channel="TOG_WRIST")}
    )
    """Who brings the images of each of the scenario's cameras that the pipeline reads."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    speed: float = 0.25
    """Of the planned motion's; 0.05 for the first run on an arm."""


def hardware_of(scenario: "Scenario") -> HardwareConfig:
    """Returns what the scenario says of the real robot.

    Raises:
        InputError: it says nothing.
    """
    if scenario.hardware is None:
        raise InputError(
            "the scenario has no section hardware; valid: --scenario panda_lcm, or one like it"
        )
    return scenario.hardware
