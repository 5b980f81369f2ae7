"""The images of a real camera: whoever brings them, the ports of a station are these."""

from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from tog_drake.stations.lcm_bus import ImagePair
from tog_drake.values import Intrinsics

UPDATE_PERIOD = 0.02  # [s] faster than any of these cameras

NO_IMAGES = ImagePair(0, np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32))


class Feed(Protocol):
    """A camera that is connected, and goes on taking images until it is closed."""

    intrinsics: Intrinsics

    def newest(self) -> ImagePair | None:
        """Returns the newest images; None before the first."""

    def problem(self) -> str:
        """Returns what went wrong last, for a person; "" where nothing did."""

    def close(self) -> None:
        """Ends it."""


class CameraFeed(LeafSystem):
    """Brings the newest images of a connected camera into a Diagram.

    .. pydrake_system::

        name: CameraFeed
        output_ports:
        - rgb_image
        - depth_image
        - stamp

    ``stamp`` is when the images were taken, in Unix time [s]; 0, long ago, before the first, and
    the images are 0×0 then. Images come in while the Diagram stands still: an update every
    ``UPDATE_PERIOD`` takes the newest over into the state, and outputs read nothing but that.
    """

    def __init__(self, feed: Feed):
        super().__init__()
        self._feed = feed
        self._images = self.DeclareAbstractState(Value(NO_IMAGES))
        self.DeclarePeriodicUnrestrictedUpdateEvent(UPDATE_PERIOD, 0.0, self._take)
        tickets = {self.abstract_state_ticket(self._images)}
        self.DeclareAbstractOutputPort(
            "rgb_image", lambda: Value(ImageRgba8U()), self._CalcColor, tickets
        )
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F()), self._CalcDepth, tickets
        )
        self.DeclareVectorOutputPort("stamp", 1, self._CalcStamp, tickets)

    def _take(self, context: Context, state: State) -> EventStatus:
        images = self._feed.newest()
        if images is None or images is self._held(context):
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._images)).set_value(images)
        return EventStatus.Succeeded()

    def _held(self, context: Context) -> ImagePair:
        images: ImagePair = context.get_abstract_state(int(self._images)).get_value()
        return images

    def _CalcColor(self, context: Context, output: Value) -> None:
        rgb = self._held(context).rgb
        image = ImageRgba8U(rgb.shape[1], rgb.shape[0])
        image.mutable_data[..., :3] = rgb
        image.mutable_data[..., 3] = 255
        output.set_value(image)

    def _CalcDepth(self, context: Context, output: Value) -> None:
        depth = self._held(context).depth
        image = ImageDepth32F(depth.shape[1], depth.shape[0])
        image.mutable_data[..., 0] = depth
        output.set_value(image)

    def _CalcStamp(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._held(context).utime / 1e6)
