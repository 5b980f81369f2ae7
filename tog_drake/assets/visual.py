"""Writes a scanned mesh as glTF, which Drake's VTK renderer and Meshcat both show textured."""

from pathlib import Path

import numpy as np

from tog_drake.assets.mesh import ScannedMesh
from tog_drake.files import write_atomically

VISUAL = "visual.gltf"
TEXTURE = 1024  # [pixel] a side at most: more is not seen by a wrist camera, and costs 0.3 s a load
# glTF is y-up; Drake turns it to z-up when it reads it, so it is turned the other way here.
_TO_GLTF = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def write_visual(mesh: ScannedMesh, folder: Path) -> None:
    """Writes ``visual.gltf`` and the buffers that it refers to, with texture and normals."""
    import trimesh
    from PIL import Image

    surface = trimesh.Trimesh(mesh.vertices @ _TO_GLTF.T, mesh.faces, process=False)
    look: dict[str, object] = {"baseColorFactor": [*mesh.color, 255]}
    if mesh.texture is not None:
        image = mesh.texture.convert("RGB")
        image.thumbnail((TEXTURE, TEXTURE), Image.Resampling.LANCZOS)
        look = {"baseColorTexture": image}
    # Drake's renderer wants texture coordinates even where there is no texture.
    uv = mesh.uv if mesh.uv is not None else np.zeros((len(mesh.vertices), 2))
    material = trimesh.visual.material.PBRMaterial(metallicFactor=0.0, roughnessFactor=0.9, **look)
    surface.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    files = trimesh.exchange.gltf.export_gltf(
        trimesh.Scene(surface), include_normals=True, merge_buffers=True
    )
    for name, content in files.items():
        write_atomically(folder / (VISUAL if name.endswith(".gltf") else name), bytes(content))
