"""Writes a scanned mesh as glTF, which Drake's VTK renderer and Meshcat both show textured."""

from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.assets.mesh import ScannedMesh, turn_from
from tog_drake.files import write_atomically
from tog_drake.values import Array

VISUAL = "visual.gltf"
TEXTURE = 1024  # [pixel] a side at most: more is not seen by a wrist camera, and costs 0.3 s a load
MAX_FACES = 100_000  # of the visual: two megabytes


def write_visual(mesh: ScannedMesh, folder: Path) -> None:
    """Writes ``visual.gltf`` and the buffers that it refers to, with texture and normals."""
    import trimesh

    # glTF is y-up; Drake turns it to z-up when it reads it, so it is turned the other way here.
    surface = trimesh.Trimesh(mesh.vertices @ turn_from("y"), mesh.faces, process=False)
    surface.visual = _look(mesh)
    if len(mesh.faces) > MAX_FACES:
        surface = _decimated(surface, mesh)
    files = trimesh.exchange.gltf.export_gltf(
        trimesh.Scene(surface), include_normals=True, merge_buffers=True
    )
    for name, content in files.items():
        write_atomically(folder / (VISUAL if name.endswith(".gltf") else name), bytes(content))


def _look(mesh: ScannedMesh) -> Any:
    if mesh.texture is not None:
        from PIL import Image

        image = mesh.texture.convert("RGB")
        image.thumbnail((TEXTURE, TEXTURE), Image.Resampling.LANCZOS)
        return _visual(mesh.uv, baseColorTexture=image)
    # Drake's renderer wants texture coordinates even where there is no texture.
    uv = np.zeros((len(mesh.vertices), 2))
    if mesh.colors is not None:
        look = _visual(uv)
        look.vertex_attributes["color"] = _linear(mesh.colors)
        return look
    return _visual(uv, baseColorFactor=_linear(np.array([mesh.color], np.uint8))[0])


def _visual(uv: Array | None, **look: object) -> Any:
    import trimesh

    material = trimesh.visual.material.PBRMaterial(metallicFactor=0.0, roughnessFactor=0.9, **look)
    return trimesh.visual.TextureVisuals(uv=uv, material=material)


def _linear(colors: Any) -> Any:
    """(N, 3) sRGB to (N, 4) linear RGB and opacity: so glTF has all colours but of textures."""
    linear = (255 * (colors / 255.0) ** 2.2).round().astype(np.uint8)
    return np.column_stack([linear, np.full(len(linear), 255, np.uint8)])


def _decimated(surface: Any, mesh: ScannedMesh) -> Any:
    """A surface too fine to draw: decimated, its look kept as colours of vertices."""
    import fast_simplification
    import trimesh
    from scipy.spatial import cKDTree

    colors = mesh.colors
    if mesh.texture is not None:
        colors = np.asarray(surface.visual.to_color().vertex_colors)[:, :3]
    vertices, faces = fast_simplification.simplify(
        np.asarray(surface.vertices, np.float32),
        np.asarray(surface.faces, np.int32),
        target_count=MAX_FACES,
    )
    coarse = trimesh.Trimesh(vertices, faces, process=False)
    nearest = cKDTree(surface.vertices).query(vertices)[1]
    coarse.visual = _look(
        ScannedMesh(
            vertices, faces, None, None, mesh.color, None if colors is None else colors[nearest]
        )
    )
    return coarse
