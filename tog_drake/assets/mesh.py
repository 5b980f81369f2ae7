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

from tog_drake.errors import InputError
from tog_drake.values import Array

FORMATS = (".obj", ".gltf", ".glb", ".ply", ".stl")
MAX_FILE_BYTES = 500_000_000
MAX_FACES = 5_000_000
MAX_TEXTURE_PIXELS = 200_000_000
# What a hand of 8 cm may want to grasp, with a wide margin [m]: the longest side.
PLAUSIBLE_EXTENT = (0.01, 2.0)
SLIVER = 8  # faces: a component with no more is debris of the scan (YCB has some of two)

Faces = NDArray[np.int64]


@dataclass(frozen=True)
class ScannedMesh:
    """A mesh as it looks: vertices are split where the texture has a seam."""

    vertices: Array  # (V, 3) [m] in the object's frame, z up
    faces: Faces  # (F, 3) rows of vertices, counter-clockwise seen from outside
    uv: Array | None  # (V, 2) in the texture, its origin at the lower left; None: not textured
    texture: Any  # PIL image, or None
    color: tuple[int, int, int]  # RGB where there is no texture


@dataclass(frozen=True)
class Solid:
    """A mesh as it fills space: vertices merged across seams, debris dropped."""

    vertices: Array  # (V, 3) [m]
    faces: Faces  # (F, 3)
    watertight: bool
    dropped: int  # faces that were degenerate, double or debris
    volume: float  # [m³] of the surface, or of its convex hull where it is not watertight


def read_mesh(path: Path, *, scale: float = 1.0, up: Literal["z", "y"] = "z") -> ScannedMesh:
    """Reads OBJ, glTF, GLB, PLY or STL, with its MTL and textures.

    Args:
        path: the file; what it refers to must lie in its folder.
        scale: metres per unit of the file.
        up: which axis of the file points up; y is turned to z.

    Raises:
        InputError: there is no such file, it holds no surface, or its size makes no sense.
    """
    import trimesh

    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path} is no mesh that is read here; valid: {', '.join(FORMATS)}")
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path} has more than {MAX_FILE_BYTES} bytes; decimate it first")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"--scale must be above 0, not {scale:g}")
    with _understood(path):
        mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or not 0 < len(mesh.faces) <= MAX_FACES:
        raise InputError(f"{path} holds no surface of 1 to {MAX_FACES} triangles")
    vertices = np.asarray(mesh.vertices, np.float64) * scale
    if not np.isfinite(vertices).all():
        raise InputError(f"{path} holds vertices that are not numbers")
    if up == "y":
        vertices = vertices @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    check_extent(path, np.ptp(vertices, axis=0), scale)
    with _understood(path):
        uv, texture, color = _appearance(mesh)
    return ScannedMesh(vertices, np.asarray(mesh.faces, np.int64), uv, texture, color)


@contextmanager
def _understood(path: Path) -> Iterator[None]:
    """Turns whatever a reader of foreign files may raise into what a person understands."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # readers of half a dozen formats raise anything
        raise InputError(f"cannot read {path}: {type(error).__name__}: {error}") from error


def check_extent(path: Path, extent: Array, scale: float) -> None:
    """Raises InputError where the longest side is none of a thing to grasp: the unit is wrong."""
    low, high = PLAUSIBLE_EXTENT
    longest = float(extent.max())
    if low <= longest <= high:
        return
    tries = [s for s in (0.001, 0.01, 0.0254, 1.0, 100.0, 1000.0) if low <= longest * s <= high]
    hint = " or ".join(f"--scale {scale * s:g}" for s in tries) or "give the right --scale"
    raise InputError(
        f"{path} would be {longest:.3g} m long: is it in millimetres, centimetres or inches? "
        f"Try {hint}"
    )


def _appearance(mesh: Any) -> tuple[Array | None, Any, tuple[int, int, int]]:
    """Texture coordinates and image, or one colour."""
    visual = mesh.visual
    material = getattr(visual, "material", None)
    uv = getattr(visual, "uv", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if image is not None and image.size[0] * image.size[1] > MAX_TEXTURE_PIXELS:
        raise InputError(
            f"its texture has {image.size[0]}×{image.size[1]} pixels; that is too many"
        )
    if uv is not None and image is not None and np.isfinite(uv).all():
        return np.asarray(uv, np.float64), image, (255, 255, 255)
    main = np.asarray(getattr(material, "main_color", None) or (160, 160, 160))
    if visual.kind == "vertex":
        main = np.asarray(visual.vertex_colors).mean(axis=0)
    red, green, blue = (int(c) for c in main[:3])
    return None, None, (red, green, blue)


def solid_of(mesh: ScannedMesh) -> Solid:
    """Merges what the texture's seams have split, and drops debris.

    A surface that winds inwards is turned over. Holes are not closed.

    Raises:
        InputError: nothing is left.
    """
    import trimesh

    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    before = len(merged.faces)
    merged.update_faces(merged.nondegenerate_faces() & merged.unique_faces())
    components = trimesh.graph.connected_components(
        merged.face_adjacency, nodes=np.arange(len(merged.faces)), min_len=SLIVER + 1
    )
    if not len(components):
        raise InputError(
            f"the mesh is made of {len(merged.faces)} loose triangles: nothing of it is a surface"
        )
    kept = np.zeros(len(merged.faces), bool)
    kept[np.concatenate(components)] = True
    merged.update_faces(kept)
    merged.remove_unreferenced_vertices()
    if not merged.is_winding_consistent:
        merged.fix_normals()
    if merged.is_watertight and merged.volume < 0:
        merged.invert()
    watertight = bool(merged.is_watertight and merged.is_winding_consistent)
    return Solid(
        np.asarray(merged.vertices, np.float64),
        np.asarray(merged.faces, np.int64),
        watertight,
        before - len(merged.faces),
        float(merged.volume if watertight else merged.convex_hull.volume),
    )
