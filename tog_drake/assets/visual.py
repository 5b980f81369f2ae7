"""Writes a scanned mesh as glTF, which Drake's VTK renderer and Meshcat both show textured."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.assets.look import linear_of
from tog_drake.assets.mesh import FINEST, Faces, ScannedMesh, Solid, turn_from
from tog_drake.files import write_atomically
from tog_drake.values import Array

VISUAL = "visual.gltf"
TEXTURE = 1024  # [pixel] a side at most: more is not seen by a wrist camera, and costs 0.3 s a load


def write_visual(mesh: ScannedMesh, solid: Solid, folder: Path) -> None:
    """Writes ``visual.gltf`` and the buffers that it refers to, with texture and normals.

    Args:
        mesh: what is to be seen.
        solid: the same surface: which side of it is outside, and how it looks with fewer faces.
        folder: of the object.
    """
    import trimesh

    if len(mesh.faces) > FINEST:
        mesh = _coarser(mesh, solid)
    elif solid.turned:
        mesh = replace(mesh, faces=_turned(mesh, solid))
    # glTF is y-up; Drake turns it to z-up when it reads it, so it is turned the other way here.
    surface = trimesh.Trimesh(mesh.vertices @ turn_from("y"), mesh.faces, process=False)
    surface.visual = _look(mesh)
    files = trimesh.exchange.gltf.export_gltf(
        trimesh.Scene(surface), include_normals=True, merge_buffers=True
    )
    for name, content in files.items():
        write_atomically(folder / (VISUAL if name.endswith(".gltf") else name), bytes(content))


def _look(mesh: ScannedMesh) -> Any:
    if mesh.texture is not None:
        from PIL import Image

        image = mesh.texture.copy()
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

    material = trimesh.visual.material.PBRMaterial(
        metallicFactor=0.0, roughnessFactor=0.9, doubleSided=True, **look
    )
    return trimesh.visual.TextureVisuals(uv=uv, material=material)


def _linear(colors: Any) -> Any:
    """(N, 3) sRGB to (N, 4) linear RGB and opacity: so glTF has all colours but of textures."""
    linear = (255 * linear_of(colors / 255.0)).round().astype(np.uint8)
    return np.column_stack([linear, np.full(len(linear), 255, np.uint8)])


def _coarser(mesh: ScannedMesh, solid: Solid) -> ScannedMesh:
    """The faces of the solid, with what the mesh shows there as colours of vertices."""
    import trimesh
    from scipy.spatial import cKDTree

    colors = mesh.colors
    if mesh.texture is not None:
        colors = trimesh.visual.color.uv_to_color(mesh.uv, mesh.texture)[:, :3]
    if colors is not None:
        colors = colors[cKDTree(mesh.vertices).query(solid.vertices)[1]]
    return ScannedMesh(solid.vertices, solid.faces, None, None, mesh.color, colors)


def _turned(mesh: ScannedMesh, solid: Solid) -> Faces:
    """The faces of the mesh, all of them wound as those of the solid at the same place."""
    import trimesh
    from scipy.spatial import cKDTree

    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    outside = trimesh.Trimesh(solid.vertices, solid.faces, process=False).vertex_normals
    there = outside[cKDTree(solid.vertices).query(surface.vertices)[1]]
    a, b, c = (surface.triangles[:, i] for i in range(3))
    inwards = (np.cross(b - a, c - a) * there[mesh.faces].sum(axis=1)).sum(axis=1) < 0
    return np.where(inwards[:, None], mesh.faces[:, ::-1], mesh.faces)
