"""A RealSense camera without one: librealsense's own software device, real streams and frames."""

import threading
import time

import pyrealsense2 as rs

SCALE = 0.00025  # [m] of a depth unit, as an L515 has it
BASELINE = 0.015  # [m] the colour imager is right of the depth imager


class SoftwareCamera:
    """Gives the same depth and colour at 30 Hz until it is stopped; what a pipeline is made of."""

    def __init__(self, depth, rgb, *, coeffs=(0, 0, 0, 0, 0)):
        self.depth, self.rgb = depth, rgb
        height, width = depth.shape
        self.color = _intrinsics(width, height, 600.0, coeffs)
        self.device = rs.software_device()
        self.sensors = [self.device.add_sensor(name) for name in ("Stereo Module", "RGB Camera")]
        self.sensors[0].add_read_only_option(rs.option.depth_units, SCALE)
        streams = (
            _stream(rs.stream.depth, rs.format.z16, 2, _intrinsics(width, height, 400.0)),
            _stream(rs.stream.color, rs.format.rgb8, 3, self.color),
        )
        self.profiles = [
            sensor.add_video_stream(stream).as_video_stream_profile()
            for sensor, stream in zip(self.sensors, streams, strict=True)
        ]
        between = rs.extrinsics()
        between.rotation, between.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-BASELINE, 0, 0]
        self.profiles[0].register_extrinsics_to(self.profiles[1], between)
        self.device.create_matcher(rs.matchers.dlr_c)
        self.syncer = rs.syncer(10)
        for sensor, profile in zip(self.sensors, self.profiles, strict=True):
            sensor.open(profile)
            sensor.start(self.syncer)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._give)
        self._thread.start()

    def wait_for_frames(self, milliseconds):
        return self.syncer.wait_for_frames(milliseconds)

    def stop(self):
        self._stopped.set()
        self._thread.join()
        for sensor in self.sensors:
            sensor.stop()
            sensor.close()

    def _give(self):
        number = 0
        while not self._stopped.wait(1 / 30):
            number += 1
            now = 1e3 * time.time()
            for i, pixels in enumerate((self.depth, self.rgb)):
                frame = rs.software_video_frame()
                frame.pixels, frame.profile = pixels, self.profiles[i]
                frame.bpp = pixels[0, 0].nbytes
                frame.stride = pixels[0].nbytes
                frame.timestamp, frame.frame_number = now, number
                frame.domain = rs.timestamp_domain.global_time
                if i == 0:
                    frame.depth_units = SCALE
                self.sensors[i].on_video_frame(frame)


def _intrinsics(width, height, focal, coeffs=(0, 0, 0, 0, 0)):
    made = rs.intrinsics()
    made.width, made.height, made.fx, made.fy = width, height, focal, focal
    made.ppx, made.ppy = width / 2 - 0.5, height / 2 - 0.5
    made.coeffs = list(coeffs)
    made.model = rs.distortion.brown_conrady if any(coeffs) else rs.distortion.none
    return made


def _stream(kind, pixel_format, bpp, intrinsics):
    stream = rs.video_stream()
    stream.type, stream.fmt, stream.bpp = kind, pixel_format, bpp
    stream.index, stream.uid, stream.fps = 0, int(kind), 30
    stream.width, stream.height, stream.intrinsics = intrinsics.width, intrinsics.height, intrinsics
    return stream
