"""Reads a scanned mesh from a file, checks what it says, and makes a solid of it.

Scans come with seams in their texture, slivers, holes, no normals and in any unit. What can be
mended is mended and told; what can only be guessed, such as the unit, is asked.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tog_drake.assets.foreign import load_meshes
from tog_drake.assets.look import look_of, one_mesh
from tog_drake.errors import InputError
from tog_drake.values import Array

GLTF = (".gltf", ".glb")
FORMATS = (".obj", *GLTF, ".ply", ".stl")
# What a hand of 8 cm may want to grasp, with a wide margin [m]: the longest side.
PLAUSIBLE_EXTENT = (0.01, 2.0)
MIN_THICKNESS = 0.0002  # [m] what is thinner is a picture of a thing
FINEST = 100_000  # faces of a solid: what is finer than a third of a millimetre is not felt
SLIVER = 8  # faces: a component with no more is debris of the scan (YCB has some of two)

Faces = NDArray[np.int64]
Axis = Literal["z", "y"]


@dataclass(frozen=True)
class ScannedMesh:
    """A mesh as it looks: vertices are split where the texture has a seam."""

    vertices: Array  # (V, 3) [m] in the object's frame, z up
    faces: Faces  # (F, 3) rows of vertices, counter-clockwise seen from outside
    uv: Array | None  # (V, 2) in the texture, its origin at the lower left; None: not textured
    texture: Any  # PIL image, or None
    color: tuple[int, int, int]  # RGB where there is neither texture nor colors
    colors: NDArray[np.uint8] | None = None  # (V, 3) RGB of each vertex, where there is no texture
    notes: tuple[str, ...] = ()  # what is to be said of the file


@dataclass(frozen=True)
class Solid:
    """A mesh as it fills space: vertices merged across seams, debris dropped."""

    vertices: Array  # (V, 3) [m]
    faces: Faces  # (F, 3)
    watertight: bool
    dropped: int  # faces that were degenerate, double or debris
    volume: float  # [m³] of the surface, or of its convex hull where it is not watertight
    turned: bool = False  # triangles of the file wound the other way


def up_axis(path: Path) -> Axis:
    """Returns which axis points up where nobody says: glTF is y-up by its standard."""
    return "y" if path.suffix.lower() in GLTF else "z"


def turn_from(up: Axis) -> Array:
    """Returns the rotation (3, 3) from axes of a file to those of an object, whose z is up."""
    return np.eye(3) if up == "z" else np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_mesh(path: Path, *, scale: float = 1.0, up: Axis | None = None) -> ScannedMesh:
    """Reads OBJ, glTF, GLB, PLY or STL, with its MTL and textures.

    Args:
        path: the file; what it refers to must lie in its folder.
        scale: metres per unit of the file.
        up: which axis of the file points up, y is turned to z; None: see ``up_axis``.

    Raises:
        InputError: there is no such file, it holds no surface, or its size makes no sense.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; name a mesh in it, or use `tog assets add-dir`")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path} is no mesh that is read here; valid: {', '.join(FORMATS)}")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"--scale must be above 0, not {scale:g}")
    with _understood(path):
        meshes, missing = load_meshes(path)
        if not meshes:
            raise InputError("it holds no surface")
        mesh = one_mesh(meshes, linear=path.suffix.lower() in GLTF)
        vertices = np.asarray(mesh.vertices, np.float64) * scale
        faces = np.asarray(mesh.faces, np.int64)
        if not np.isfinite(vertices).all():
            raise InputError("it holds vertices that are not numbers")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError("it holds triangles of vertices that are not there")
        look = look_of(mesh)
    check_extent(path, np.ptp(vertices, axis=0), scale)
    notes = tuple(
        f"{name!r:.200} is not in its folder: what it shows is left out; to have it, put that file "
        f"beside {path.name} and import it again"
        for name in missing
    )
    return ScannedMesh(vertices @ turn_from(up or up_axis(path)).T, faces, *look, notes)


@contextmanager
def _understood(path: Path) -> Iterator[None]:
    """Turns whatever a reader of foreign files may raise into what a person understands."""
    try:
        yield
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"cannot read {path}: {error}") from error
    except MemoryError as error:
        raise InputError(
            f"cannot read {path}: it asks for more memory than there is; decimate it first"
        ) from error
    except Exception as error:  # readers of half a dozen formats raise anything
        raise InputError(
            f"cannot read {path}: {type(error).__name__}: {error}; export it again"
        ) from error


def check_extent(path: Path, extent: Array, scale: float) -> None:
    """Raises InputError where the longest side is none of a thing to grasp: the unit is wrong."""
    low, high = PLAUSIBLE_EXTENT
    longest = float(extent.max())
    if low <= longest <= high:
        return
    tries = [s for s in (0.001, 0.01, 0.0254, 100.0, 1000.0) if low <= longest * s <= high]
    hint = " or ".join(f"--scale {scale * s:g}" for s in tries) or "give the right --scale"
    raise InputError(
        f"{path} would be {longest:.3g} m long: is it in millimetres, centimetres or inches? "
        f"Try {hint}"
    )


def solid_of(mesh: ScannedMesh) -> Solid:
    """Merges what the texture's seams have split, and drops debris.

    A surface that winds inwards is turned over. Holes are not closed. One of more than ``FINEST``
    faces is decimated.

    Raises:
        InputError: nothing is left, or it is flat.
    """
    import trimesh

    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    before = len(merged.faces)
    merged.update_faces(merged.nondegenerate_faces() & merged.unique_faces())
    merged.update_faces(_without_debris(merged))
    merged.remove_unreferenced_vertices()
    thickness = _thickness(np.asarray(merged.vertices))
    if thickness < MIN_THICKNESS:
        raise InputError(
            f"the mesh is flat ({1000 * thickness:.2g} mm thick), which fills no space; give it "
            f"a thickness of {1000 * MIN_THICKNESS:g} mm or more"
        )
    turned = not merged.is_winding_consistent
    if turned:
        merged.fix_normals()
    if merged.is_watertight and merged.volume < 0:
        turned = True
        merged.invert()
    hull = float(merged.convex_hull.volume)
    watertight = bool(
        merged.is_watertight and merged.is_winding_consistent and 0 < merged.volume <= 1.001 * hull
    )
    volume, dropped = float(merged.volume) if watertight else hull, before - len(merged.faces)
    return Solid(*_decimated(merged), watertight, dropped, volume, turned)


def _decimated(merged: Any) -> tuple[Array, Faces]:
    """The vertices and faces of a surface, at most ``FINEST`` of these."""
    vertices = np.asarray(merged.vertices, np.float64)
    faces = np.asarray(merged.faces, np.int64)
    if len(faces) <= FINEST:
        return vertices, faces
    import fast_simplification

    middle = vertices.mean(axis=0)  # it works in single precision about the origin
    fewer, faces = fast_simplification.simplify(
        (vertices - middle).astype(np.float32), faces.astype(np.int32), target_count=FINEST
    )
    return fewer.astype(np.float64) + middle, faces.astype(np.int64)


def _without_debris(merged: Any) -> NDArray[np.bool_]:
    """(F,) the faces of connected pieces that are no slivers; the largest piece is none."""
    import trimesh

    piece = trimesh.graph.connected_component_labels(
        merged.face_adjacency, node_count=len(merged.faces)
    )
    size = np.bincount(piece, minlength=1)
    largest = int(size.max())
    if largest < 2:
        raise InputError(
            f"the mesh is made of {len(piece)} loose triangles: nothing of it is a surface"
        )
    kept: NDArray[np.bool_] = size[piece] >= min(SLIVER + 1, largest)
    return kept


def _thickness(vertices: Array) -> float:
    """[m] along the direction in which the vertices (V, 3) spread least."""
    spread = vertices - vertices.mean(axis=0)
    thinnest = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    return float(np.ptp(spread @ thinnest))
