"""What travels between the robot's drivers and this program, as LCM messages.

The contract is that of drake-franka-driver (RobotLocomotion): one process drives the arm, another
the hand, which speaks the messages of a Schunk WSG gripper. Units are SI on this side of every
function here; millimetres exist in the hand's messages alone. What arrives is data from elsewhere:
it is bounded and checked here, and a message that is not what it should be counts as none.
"""

import math
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, TypeVar

import numpy as np
from drake import (
    lcmt_header,
    lcmt_image,
    lcmt_image_array,
    lcmt_panda_command,
    lcmt_panda_status,
    lcmt_schunk_wsg_command,
    lcmt_schunk_wsg_status,
)
from pydrake.lcm import DrakeLcm

from tog_drake.panda import MAX_OPENING
from tog_drake.values import Array

PANDA_COMMAND = "PANDA_COMMAND"  # lcmt_panda_command
PANDA_STATUS = "PANDA_STATUS"  # lcmt_panda_status
HAND_COMMAND = "PANDA_HAND_COMMAND"  # lcmt_schunk_wsg_command
HAND_STATUS = "PANDA_HAND_STATUS"  # lcmt_schunk_wsg_status

POSITION_MODE = lcmt_panda_status.CONTROL_MODE_POSITION
_AHEAD = 1.0  # [s] a message that was sent so far in the future was not sent at all
_FAR = 1e3  # no angle, speed, torque or opening of this robot is as large, in SI units
_MOST_PIXELS = 4096 * 3072
_MOST_IMAGES = 8

Value = TypeVar("Value")


class RobotMode(IntEnum):
    """libfranka's ``RobotMode``, as ``lcmt_panda_status.robot_mode`` carries it."""

    OTHER = 0
    IDLE = 1
    MOVE = 2  # the only one in which commands are carried out
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERY = 6


@dataclass(frozen=True)
class ArmStatus:
    """What the arm's driver says."""

    utime: int  # [µs] Unix time at which it was sent
    q: Array  # (7,) [rad]
    v: Array  # (7,) [rad/s]
    torque_external: Array  # (7,) [Nm] what the world does to the arm, Drake's sign
    robot_mode: int  # of RobotMode, or one that it does not know


@dataclass(frozen=True)
class HandStatus:
    """What the hand's driver says."""

    utime: int  # [µs] Unix time
    opening: float  # [m] between the pads
    rate: float  # [m/s] of it; the real driver says 0.005 while it moves, else 0
    force: float  # [N] the real driver always says 0


@dataclass(frozen=True)
class ImagePair:
    """A colour image and the depth image aligned to it."""

    utime: int  # [µs] Unix time
    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) float32 [m]; 0, inf and NaN are holes

    def __deepcopy__(self, memo: dict[int, object]) -> "ImagePair":
        # Every update of a Diagram copies its state, and nothing in it ever changes.
        return self


def make_lcm(url: str = "") -> DrakeLcm:
    """Returns LCM with a receive buffer that holds images.

    Args:
        url: "" is LCM's default group, on this host alone (ttl 0).
    """
    return DrakeLcm(url or "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4194304")


class Inbox(Generic[Value]):
    """Keeps the newest message of a channel that is what it should be.

    Messages of before the newest one (LCM over UDP may turn them round, or bring them twice), those
    from the future, and those that ``read`` refuses are counted in ``refused``, nothing else.
    Messages arrive while somebody calls ``lcm.HandleSubscriptions``.
    """

    def __init__(
        self,
        lcm: DrakeLcm,
        channel: str,
        read: Callable[[bytes], Value],
        clock: Callable[[], float] = time.time,
    ):
        self.channel = channel
        self.newest: Value | None = None
        self.received = 0
        self.refused = 0
        self.why_refused = ""  # the last one
        self._read = read
        self._clock = clock
        lcm.Subscribe(channel, self._receive)

    def age(self) -> float:
        """Returns how long ago the newest message was sent [s]; infinite where there is none."""
        if self.newest is None:
            return math.inf
        return self._clock() - _utime(self.newest) / 1e6

    def _receive(self, data: bytes) -> None:
        try:
            value = self._read(data)
            if _utime(value) / 1e6 > self._clock() + _AHEAD:
                raise ValueError("it comes from the future: are the clocks alike?")
            if self.newest is not None and _utime(value) <= _utime(self.newest):
                raise ValueError("it is not newer than the one before")
        except ValueError as error:
            self.refused += 1
            self.why_refused = str(error)
            return
        self.received += 1
        self.newest = value


def _utime(value: Any) -> int:
    return int(value.utime)


def read_arm_status(data: bytes) -> ArmStatus:
    """Raises ValueError: not a status of seven joints with finite values."""
    m = _decoded(lcmt_panda_status, data)
    if m.num_joints != 7:
        raise ValueError(f"it has {m.num_joints} joints, not 7")
    return ArmStatus(
        utime=m.utime,
        q=_seven(m.joint_position),
        v=_seven(m.joint_velocity),
        # The driver reports what the arm does to the world.
        torque_external=-_seven(m.joint_torque_external),
        robot_mode=m.robot_mode,
    )


def arm_status_message(
    q: Array, v: Array, torque_external: Array, robot_mode: int, utime: int
) -> bytes:
    """Returns what the arm's driver sends; the arguments are as in ``ArmStatus``."""
    m = lcmt_panda_status()
    m.utime = m.robot_utime = utime
    m.num_joints = 7
    zeros = [0.0] * 7
    m.joint_position = m.joint_position_desired = [float(a) for a in q]
    m.joint_velocity = m.joint_velocity_desired = [float(a) for a in v]
    m.joint_acceleration_desired = m.joint_torque = m.joint_torque_desired = zeros
    m.joint_torque_external = [-float(a) for a in torque_external]
    m.control_command_success_rate = 1.0
    m.robot_mode = robot_mode
    m.control_mode = 0  # the real driver never sets it
    data: bytes = m.encode()
    return data


def arm_command_message(q: Array, utime: int) -> bytes:
    """Returns the command to be at ``q`` (7,) [rad], in position mode."""
    m = lcmt_panda_command()
    m.utime = utime
    m.num_joint_position = 7
    m.joint_position = [float(a) for a in q]
    m.num_joint_velocity = m.num_joint_torque = 0
    m.joint_velocity = m.joint_torque = []
    m.control_mode_expected = POSITION_MODE
    data: bytes = m.encode()
    return data


def read_hand_status(data: bytes) -> HandStatus:
    """Raises ValueError: not a status with finite values."""
    m = _decoded(lcmt_schunk_wsg_status, data)
    opening, rate, force = (
        _finite(a, _FAR)
        for a in (m.actual_position_mm / 1e3, m.actual_speed_mm_per_s / 1e3, m.actual_force)
    )
    return HandStatus(m.utime, opening, rate, force)


def hand_status_message(opening: float, rate: float, utime: int) -> bytes:
    """Returns what the hand's driver sends; the arguments are as in ``HandStatus``."""
    m = lcmt_schunk_wsg_status()
    m.utime = utime
    m.actual_position_mm = 1e3 * opening
    m.actual_speed_mm_per_s = 1e3 * rate
    m.actual_force = 0.0
    data: bytes = m.encode()
    return data


def hand_command_message(opening: float, force: float, utime: int) -> bytes:
    """Returns the command to go to ``opening`` [m], pressing with ``force`` [N]."""
    m = lcmt_schunk_wsg_command()
    m.utime = utime
    m.target_position_mm = 1e3 * min(max(opening, 0.0), MAX_OPENING)
    m.force = force
    data: bytes = m.encode()
    return data


def read_images(data: bytes) -> ImagePair:
    """Raises ValueError: not one colour image (RGB or RGBA) and one depth image of the same size.

    Depth is 32-bit floats in metres, or 16-bit integers in millimetres.
    """
    m = _decoded(lcmt_image_array, data)
    if not 2 <= m.num_images <= _MOST_IMAGES:
        raise ValueError(f"it holds {m.num_images} images, not colour and depth")
    images = {image.pixel_format: image for image in m.images}
    depth = images.get(lcmt_image.PIXEL_FORMAT_DEPTH)
    color = images.get(lcmt_image.PIXEL_FORMAT_RGBA, images.get(lcmt_image.PIXEL_FORMAT_RGB))
    if depth is None or color is None:
        raise ValueError(f"it holds images of the formats {sorted(images)}, not colour and depth")
    if (depth.width, depth.height) != (color.width, color.height):
        raise ValueError(
            f"colour is {color.width}x{color.height} and depth {depth.width}x{depth.height}"
        )
    channels = 4 if color.pixel_format == lcmt_image.PIXEL_FORMAT_RGBA else 3
    rgb = _pixels(color, np.dtype(np.uint8), channels)[..., :3]
    if depth.channel_type == lcmt_image.CHANNEL_TYPE_UINT16:
        metres = _pixels(depth, np.dtype("<u2"), 1)[..., 0].astype(np.float32) / 1e3
    elif depth.channel_type == lcmt_image.CHANNEL_TYPE_FLOAT32:
        metres = _pixels(depth, np.dtype("<f4"), 1)[..., 0]
    else:
        raise ValueError(f"depth has channels of type {depth.channel_type}; valid: 3 and 6")
    return ImagePair(m.header.utime, rgb.copy(), metres)


def images_message(rgb: np.ndarray, depth: np.ndarray, utime: int) -> bytes:
    """Returns a colour image (H, W, 3) uint8 and its depth (H, W) float32 [m] as one message.

    Compressed: what Drake writes uncompressed of float depth is read wrong by Drake itself.
    """
    array = lcmt_image_array()
    array.header = _header(utime, "camera")
    array.images = [
        _image(rgb, lcmt_image.PIXEL_FORMAT_RGB, lcmt_image.CHANNEL_TYPE_UINT8, utime),
        _image(
            depth.astype("<f4"),
            lcmt_image.PIXEL_FORMAT_DEPTH,
            lcmt_image.CHANNEL_TYPE_FLOAT32,
            utime,
        ),
    ]
    array.num_images = 2
    data: bytes = array.encode()
    return data


def _header(utime: int, frame: str) -> Any:
    header = lcmt_header()
    header.utime, header.frame_name, header.seq = utime, frame, 0
    return header


def _image(pixels: np.ndarray, pixel_format: int, channel_type: int, utime: int) -> Any:
    image = lcmt_image()
    image.header = _header(utime, "camera")
    image.height, image.width = pixels.shape[:2]
    image.row_stride = pixels[0].nbytes
    image.data = zlib.compress(np.ascontiguousarray(pixels).tobytes(), level=1)
    image.size = len(image.data)
    image.bigendian = False
    image.pixel_format, image.channel_type = pixel_format, channel_type
    image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
    return image


def _pixels(image: Any, kind: np.dtype[Any], channels: int) -> np.ndarray:
    """Returns (H, W, channels) of an image, whatever its message claims."""
    height, width = image.height, image.width
    if not (height > 0 and width > 0 and height * width <= _MOST_PIXELS):
        raise ValueError(f"it is {width}x{height} pixels large")
    size = height * width * channels * kind.itemsize
    data = bytes(image.data)
    if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, size + 1)
        except zlib.error as error:
            raise ValueError(f"an image cannot be unpacked: {error}") from error
    elif image.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
        raise ValueError(
            f"an image is compressed by method {image.compression_method}; valid: 0 and 1 (zlib)"
        )
    if len(data) != size or image.bigendian:
        raise ValueError(f"an image of {width}x{height} has {len(data)} bytes, not {size}")
    return np.frombuffer(data, kind).reshape(height, width, channels)


def _decoded(message_type: Any, data: bytes) -> Any:
    try:
        return message_type.decode(data)
    except Exception as error:  # of struct, of numbers, of text: LCM's own code does not say
        raise ValueError(f"it is no {message_type.__name__}") from error


def _seven(values: Any) -> Array:
    array = np.asarray(values, dtype=float)
    if array.shape != (7,) or not np.all(np.abs(array) < _FAR):  # NaN is not, either
        raise ValueError(f"{array.tolist()} are not seven finite values")
    return array


def _finite(value: float, most: float) -> float:
    if not abs(value) < most:
        raise ValueError(f"{value} is not a finite value below {most:g}")
    return float(value)
