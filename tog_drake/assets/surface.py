"""The surface by which an imported object touches, as points."""

from pathlib import Path

import numpy as np
from pydrake.geometry import ReadObjToTriangleSurfaceMesh

from tog_drake.assets.mesh import Faces
from tog_drake.errors import InputError
from tog_drake.values import Array

_SPACING = 0.002  # [m] between points: half of what is told apart from a cloud
_MAX_POINTS = 60_000  # of a pitcher; what is larger gets them farther apart
# Steps of the R2 sequence (Roberts 2018), which fills a square evenly.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


def read_core(path: Path) -> tuple[Array, Faces]:
    """Returns the vertices (V, 3) [m] and triangles (F, 3) of a core, an OBJ.

    Raises:
        InputError: it cannot be read.
    """
    try:
        mesh = ReadObjToTriangleSurfaceMesh(str(path))
    except RuntimeError as error:
        raise InputError(f"cannot read the surface {path}: {error}; import it again") from error
    triangles = [[t.vertex(i) for i in range(3)] for t in mesh.triangles()]
    return np.array(mesh.vertices(), float), np.array(triangles, np.int64)


def face_areas(vertices: Array, faces: Faces) -> Array:
    """Returns the area of each triangle (F,) [m²]."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas: Array = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return areas


def surface_points(vertices: Array, faces: Faces) -> Array:
    """Returns points (N, 3) [m] spread evenly over a surface, always the same ones."""
    area = np.cumsum(face_areas(vertices, faces))
    count = int(np.clip(area[-1] / _SPACING**2, 1, _MAX_POINTS))
    at = (np.arange(count) + 0.5) / count * area[-1]
    face = np.minimum(np.searchsorted(area, at), len(faces) - 1)
    u, v = ((0.5 + np.arange(1, count + 1)[:, None] * _R2) % 1.0).T
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = (vertices[faces[face, i]] for i in range(3))
    points: Array = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points
