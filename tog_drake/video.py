"""Films a recorded episode: 1280×720, 30 frames a second, from a fixed place, by Drake's VTK."""

import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    RenderCameraCore,
    Rgba,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from tog_drake.drawing import Image
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.recording import Recording
from tog_drake.rendering import make_render_engine
from tog_drake.replay import FRAME_RATE, Stage, set_stage

if TYPE_CHECKING:
    import cv2

WIDTH, HEIGHT = 1280, 720  # [pixel]
EYE, TARGET = (1.55, -0.95, 0.9), (0.3, 0.0, 0.31)  # [m] in W: where the camera is and looks
FIELD_OF_VIEW = 0.71  # [rad] upright
BACKGROUND = Rgba(0.93, 0.94, 0.95, 1.0)
LIGHTS = [
    LightParameter(type="directional", frame="world", direction=[-0.35, 0.5, -1.0], intensity=2.2),
    LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=1.3),
]
CODECS = {"avc1": "H.264", "vp09": "VP9"}
"""Codes and names of what is tried, in order. Browsers play both, and other programs rather the
first. PyPI's builds of OpenCV can only decode H.264, for its licence, but write VP9."""
_LEVEL = "OPENCV_FFMPEG_LOGLEVEL"  # what FFmpeg says is set in no other way


def film(stage: Stage) -> Iterator[Image]:
    """Yields an image, (HEIGHT, WIDTH, 3), of each frame of an episode.

    Raises:
        InputError: this machine cannot render.
    """
    scene = stage.station.scene_graph
    engine = make_render_engine(BACKGROUND, LIGHTS)
    scene.AddRenderer(
        stage.station.GetMutableSubsystemContext(scene, stage.context), "film", engine
    )
    camera, X_WC = _camera()
    port = stage.station.GetOutputPort("cheat.query_object")
    for context in stage.frames():
        image = port.Eval(context).RenderColorImage(camera, scene.world_frame_id(), X_WC)
        yield image.data[..., :3]


def write_video(
    path: Path, recording: Recording, progress: Callable[[int, int], None] = lambda done, of: None
) -> str:
    """Writes the film of an episode to ``path`` (MP4), whole or not at all.

    Args:
        path: the file.
        recording: of the episode.
        progress: told how many frames are done, and of how many.

    Returns:
        The name of the codec: H.264 where this OpenCV can encode it, else VP9.

    Raises:
        InputError: as ``set_stage`` and ``film``, or OpenCV can encode neither.
    """
    stage = set_stage(recording)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "film.mp4"
        writer, codec = _open(file)
        try:
            for number, image in enumerate(film(stage), 1):
                writer.write(np.ascontiguousarray(image[..., ::-1]))
                progress(number, len(stage.times))
        finally:
            writer.release()
        write_atomically(path, file.read_bytes())
    return codec


def _open(file: Path) -> "tuple[cv2.VideoWriter, str]":
    with _quiet():
        import cv2

        for code, codec in CODECS.items():
            fourcc = cv2.VideoWriter.fourcc(*code)
            writer = cv2.VideoWriter(str(file), fourcc, float(FRAME_RATE), (WIDTH, HEIGHT))
            if writer.isOpened():
                return writer, codec
    raise InputError(
        f"this OpenCV ({cv2.__version__}) encodes neither {' nor '.join(CODECS.values())}; one "
        "from PyPI does: pip install --force-reinstall opencv-python-headless"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps OpenCV, and FFmpeg in it, from complaining of a codec that it has not."""
    import cv2

    level = cv2.utils.logging.getLogLevel()
    before = os.environ.get(_LEVEL)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    os.environ[_LEVEL] = "-8"
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)
        if before is None:
            del os.environ[_LEVEL]
        else:
            os.environ[_LEVEL] = before


def _camera() -> tuple[ColorRenderCamera, RigidTransform]:
    """The camera, and its pose X_WC (z forward, y down)."""
    eye, target = np.array(EYE), np.array(TARGET)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R_WC = RotationMatrix(np.stack([right, np.cross(forward, right), forward], axis=1))
    core = RenderCameraCore(
        "film",
        CameraInfo(WIDTH, HEIGHT, FIELD_OF_VIEW),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    return ColorRenderCamera(core), RigidTransform(R_WC, eye)
