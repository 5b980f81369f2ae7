"""A camera whose driver is another process, which sends its images over LCM."""

from dataclasses import dataclass

from pydrake.lcm import DrakeLcm
from pydrake.systems.sensors import CameraConfig

from tog_drake.camera import rendered_intrinsics
from tog_drake.errors import InputError
from tog_drake.stations.lcm_bus import ImagePair, Inbox, read_images
from tog_drake.values import Intrinsics


@dataclass
class LcmImages:
    """A camera whose images come as `lcmt_image_array`: `!LcmImages {channel: TOG_WRIST}`.

    Its intrinsics are those of the scenario's camera of the same name, by Drake's rule: `center_x`
    and `center_y` count from the image's corner, half a pixel more than most calibrations say.
    """

    channel: str = ""

    def open(self, lcm: DrakeLcm, setup: CameraConfig) -> "LcmFeed":
        """Listens to the channel.

        Args:
            lcm: images arrive while somebody calls its ``HandleSubscriptions``.
            setup: the camera as the scenario has it; the messages carry no intrinsics.

        Raises:
            InputError: no channel is named.
        """
        if not self.channel:
            raise InputError("!LcmImages needs a channel: !LcmImages {channel: TOG_WRIST}")
        return LcmFeed(lcm, self.channel, scenario_intrinsics(setup))


class LcmFeed:
    """The newest good message of a channel with images."""

    def __init__(self, lcm: DrakeLcm, channel: str, intrinsics: Intrinsics):
        self.intrinsics = intrinsics
        self.inbox: Inbox[ImagePair] = Inbox(lcm, channel, read_images)

    def newest(self) -> ImagePair | None:
        return self.inbox.newest

    def problem(self) -> str:
        if not self.inbox.refused:
            return ""
        return (
            f"{self.inbox.refused} messages were refused, the last because {self.inbox.why_refused}"
        )

    def close(self) -> None:
        """Nothing is held open."""


def scenario_intrinsics(setup: CameraConfig) -> Intrinsics:
    """Returns the pinhole model of the camera as the scenario has it."""
    return rendered_intrinsics(setup.MakeCameras()[0].core().intrinsics())
