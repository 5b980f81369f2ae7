"""A tiny scanned object, made as an import would make it."""

import numpy as np
import trimesh

from tog_drake.assets.mesh import ScannedMesh, solid_of
from tog_drake.assets.model import inertia_of, write_model
from tog_drake.assets.visual import write_visual


def scanned_bar(folder, z=0.0):
    """Writes a bar of 20 × 3 × 3 cm along x, its middle at height ``z``, of 0.1 kg."""
    bar = trimesh.creation.box((0.2, 0.03, 0.03))
    for _ in range(3):
        bar = bar.subdivide()
    bar.apply_translation((0, 0, z))
    vertices, faces = np.asarray(bar.vertices), np.asarray(bar.faces)
    mesh = ScannedMesh(vertices, faces, None, None, (200, 30, 30))
    solid = solid_of(mesh)
    folder.mkdir(parents=True)
    write_visual(mesh, solid, folder)
    hull = bar.convex_hull
    skin = [(np.asarray(hull.vertices), np.asarray(hull.faces))]
    inertia = inertia_of(solid, skin, mass=0.1, density=400.0)
    write_model(folder, core=(solid.vertices, solid.faces), skin=skin, inertia=inertia)
    return folder / "model.sdf"
