"""An Intel RealSense camera at this computer. Needs the extra ``[realsense]`` (pyrealsense2).

Depth is aligned to colour by the camera's own factory calibration and comes in metres by the depth
scale that the camera reports. Where its lens distorts, both images are straightened.
"""

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.lcm import DrakeLcm
from pydrake.systems.sensors import CameraConfig

from tog_drake.errors import InputError
from tog_drake.stations.lcm_bus import ImagePair
from tog_drake.values import Intrinsics

INSTALL = "pip install 'tog_drake[realsense]'"
_L515 = (
    "an L515 needs librealsense 2.54.2 or older, with which its support ended: "
    "pip install pyrealsense2==2.54.2.5684"
)
_RATE = 30  # [Hz] of both streams
_WAIT = 500  # [ms] for the next frames, before it is looked whether to go on


@dataclass
class RealSense:
    """A RealSense camera at this computer's USB: `!RealSense {serial: "012345678901"}`."""

    serial: str = ""
    """Which one; "" is the only one that is connected."""
    preset: str = ""
    """A visual preset of the camera, by its name, such as `High Accuracy`; "" is the usual one."""

    def open(self, lcm: DrakeLcm | None, setup: CameraConfig) -> "RealSenseFeed":
        """Starts the camera, at the resolution of ``setup``, the camera as the scenario has it.

        Raises:
            InputError: pyrealsense2 is missing, or there is no such camera, preset or resolution.
        """
        rs = require_pyrealsense2()
        device = self._device(rs)
        serial = device.get_info(rs.camera_info.serial_number)
        sensor = device.first_depth_sensor()
        _apply_preset(rs, sensor, self.preset)
        config = rs.config()
        config.enable_device(serial)
        size = (setup.width, setup.height)
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, _RATE)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, _RATE)
        pipeline = rs.pipeline()
        try:
            profile = pipeline.start(config)
        except RuntimeError as error:
            raise InputError(
                f"RealSense {serial} does not start with depth and colour of {size[0]}x{size[1]} "
                f"at {_RATE} Hz: {error}; use a USB 3 port, close other programs that use the "
                "camera, or give another resolution in the scenario's cameras"
            ) from error
        color = profile.get_stream(rs.stream.color).as_video_stream_profile()
        return RealSenseFeed(pipeline, pipeline.stop, color.get_intrinsics())

    def _device(self, rs: Any) -> Any:
        """The camera meant; asked for first, since a start without one fails only after 15 s."""
        found = {d.get_info(rs.camera_info.serial_number): d for d in rs.context().query_devices()}
        if not found:
            raise InputError(
                "no RealSense camera is connected; plug it into a USB 3 port and see whether "
                f"rs-enumerate-devices lists it (this is librealsense {rs.__version__}; {_L515})"
            )
        if self.serial in found:
            return found[self.serial]
        if self.serial or len(found) > 1:
            raise InputError(
                f"no RealSense camera {self.serial!r}; connected, give one as serial: "
                + ", ".join(f'"{serial}"' for serial in found)
            )
        return next(iter(found.values()))


def require_pyrealsense2() -> Any:
    """Returns the module. Raises InputError with the command that installs it."""
    try:
        import pyrealsense2
    except ImportError as error:
        raise InputError(f"a RealSense camera needs pyrealsense2: {INSTALL}") from error
    return pyrealsense2


def _apply_preset(rs: Any, sensor: Any, name: str) -> None:
    if not name:
        return
    option = rs.option.visual_preset
    presets: dict[str, float] = {}
    if sensor.supports(option):
        limits = sensor.get_option_range(option)
        values = np.arange(limits.min, limits.max + limits.step / 2, limits.step)
        names = ((sensor.get_option_value_description(option, float(v)), v) for v in values)
        presets = {text: float(value) for text, value in names if text}
    if name not in presets:
        valid = ", ".join(presets) or 'none, leave it ""'
        raise InputError(f"this camera has no preset {name!r}; valid: {valid}")
    sensor.set_option(option, presets[name])


class RealSenseFeed:
    """Takes images in a thread of its own.

    Args:
        source: a pipeline or a syncer: has ``wait_for_frames(milliseconds)``.
        stop: ends that.
        color: factory intrinsics of the colour stream (pyrealsense2).
    """

    def __init__(self, source: Any, stop: Any, color: Any):
        rs = require_pyrealsense2()
        self.intrinsics = Intrinsics(
            color.width, color.height, color.fx, color.fy, color.ppx, color.ppy
        )
        self._straighten = _straightening(rs, color)
        self._global = (rs.timestamp_domain.global_time, rs.timestamp_domain.system_time)
        self._align = rs.align(rs.stream.color)
        self._source, self._stop = source, stop
        self._lock = threading.Lock()
        self._newest: ImagePair | None = None
        self._problem = ""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="RealSense", daemon=True)
        self._thread.start()

    def newest(self) -> ImagePair | None:
        with self._lock:
            return self._newest

    def problem(self) -> str:
        with self._lock:
            return self._problem

    def close(self) -> None:
        self._closed.set()
        self._thread.join(timeout=5 * _WAIT / 1e3)
        self._stop()

    def _run(self) -> None:
        while not self._closed.is_set():
            images, problem = None, ""
            try:
                images = self._images(self._source.wait_for_frames(_WAIT))
            except RuntimeError as error:  # none came in time, or the camera was unplugged
                problem = str(error)
                self._closed.wait(0.05)  # where it fails at once
            with self._lock:
                self._newest, self._problem = images or self._newest, problem

    def _images(self, frames: Any) -> ImagePair | None:
        """The pair; None where one of the two is missing."""
        if not (frames.get_depth_frame() and frames.get_color_frame()):
            return None
        aligned = self._align.process(frames)
        depth, color = aligned.get_depth_frame(), aligned.get_color_frame()
        # The camera's own clock, unless librealsense translates it, counts from anywhere.
        known = color.get_frame_timestamp_domain() in self._global
        seconds = color.get_timestamp() / 1e3 if known else time.time()
        # Both copies: the frames go back to librealsense.
        rgb = np.asanyarray(color.get_data()).copy()
        metres = np.asanyarray(depth.get_data()) * np.float32(depth.get_units())
        if self._straighten is not None:
            row, column, inside = self._straighten
            rgb = rgb[row, column] * inside[..., None]
            metres = metres[row, column] * inside
        return ImagePair(round(1e6 * seconds), rgb, metres.astype(np.float32))


Straightening = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]


def _straightening(rs: Any, color: Any) -> Straightening | None:
    """Where in the camera's image each pixel of a pinhole's is: rows, columns, whether inside.

    The nearest pixel is taken, of both images, so that depth is never mixed across an edge. None
    where the lens does not distort.
    """
    if not np.any(color.coeffs):
        return None
    u = np.empty((color.height, color.width, 2))
    for v, row in enumerate(u):
        y = (v - color.ppy) / color.fy
        for i in range(color.width):
            x = (i - color.ppx) / color.fx
            row[i] = rs.rs2_project_point_to_pixel(color, [x, y, 1.0])
    column, row_ = np.rint(np.moveaxis(u, -1, 0)).astype(np.int64)
    inside = (column >= 0) & (column < color.width) & (row_ >= 0) & (row_ < color.height)
    return (
        np.clip(row_, 0, color.height - 1),
        np.clip(column, 0, color.width - 1),
        inside.astype(np.uint8),
    )
