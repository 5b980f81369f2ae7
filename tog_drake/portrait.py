"""Pictures of single objects, and sheets of such pictures."""

from collections.abc import Sequence

import numpy as np
from pydrake.geometry import ClippingRange, ColorRenderCamera, QueryObject, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from tog_drake.drawing import Image
from tog_drake.values import Array

GROUND, INK, FAINT_INK = (250, 250, 248), (25, 25, 25), (95, 95, 95)
FIELD_OF_VIEW = np.radians(22)  # across the height: about as one sees a thing on a table
AZIMUTH, ELEVATION = np.radians(-62), np.radians(38)  # of the camera, seen from the object
MARGIN = 1.06
SMOOTH = 2  # each pixel is the mean of SMOOTH × SMOOTH rendered ones


def picture(
    query: QueryObject, p_W: Array, size: tuple[int, int], azimuth: float = AZIMUTH
) -> Image:
    """Renders what lies at the points (N, 3), filling an image of ``size``, from three quarters.

    The scene's renderer is called "vtk"; ``azimuth`` [rad] is the camera's, seen from the object.
    """
    import cv2

    width, height = SMOOTH * size[0], SMOOTH * size[1]
    info = CameraInfo(width, height, FIELD_OF_VIEW)
    back = np.array(
        [
            np.cos(ELEVATION) * np.cos(azimuth),
            np.cos(ELEVATION) * np.sin(azimuth),
            np.sin(ELEVATION),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], back) / np.cos(ELEVATION)
    R_WC = np.column_stack([right, np.cross(right, back), -back])
    p_C = p_W @ R_WC
    middle = (p_C.max(axis=0) + p_C.min(axis=0)) / 2
    across = np.abs(p_C - middle) * [info.focal_x() / width * 2, info.focal_y() / height * 2, 0.0]
    # As far as it takes for the widest point, at its own depth, to fit.
    distance = np.max(MARGIN * across.max(axis=1) - (p_C - middle)[:, 2])
    X_WC = RigidTransform(RotationMatrix(R_WC), R_WC @ (middle - [0.0, 0.0, distance]))
    core = RenderCameraCore("vtk", info, ClippingRange(0.01, 10.0), RigidTransform())
    frame = query.inspector().world_frame_id()
    rendered = query.RenderColorImage(ColorRenderCamera(core), frame, X_WC).data[..., :3]
    return np.asarray(cv2.resize(rendered, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def in_rows(tiles: Sequence[Image], columns: int) -> Image:
    """Returns a sheet of tiles, which all have one size."""
    height, width = tiles[0].shape[:2]
    full = [*tiles, *[blank((width, height))] * (-len(tiles) % columns)]
    rows = [np.hstack(full[i : i + columns]) for i in range(0, len(full), columns)]
    return np.vstack(rows)


def blank(size: tuple[int, int]) -> Image:
    """Returns an empty image of ``size``: width and height."""
    return np.full((size[1], size[0], 3), GROUND, dtype=np.uint8)


def write_words(
    image: Image,
    words: str,
    y: int,
    ink: tuple[int, int, int],
    scale: float,
    x: int = 12,
    stroke: int = 1,
) -> None:
    """Writes on ``image`` in place, from (x, y) [pixels], the left end of the base line."""
    import cv2

    cv2.putText(image, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, ink, stroke, cv2.LINE_AA)
