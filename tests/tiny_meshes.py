"""Tiny meshes, written as scans are, and ways to see what became of them."""

from pathlib import Path

import numpy as np
import trimesh


def box(*size, at=(0, 0, 0)):
    """A closed box of ``size`` [m] with its middle ``at``."""
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))


def l_shape(height=0.03):
    """A closed surface that is not convex: an L of 9 cm."""
    corners = np.array([[0, 0], [0.09, 0], [0.09, 0.03], [0.03, 0.03], [0.03, 0.09], [0, 0.09]])
    n = len(corners)
    fan = np.array([[3, 4, 5], [3, 5, 0], [3, 0, 1], [3, 1, 2]])
    vertices = np.vstack([np.column_stack([corners, np.full(n, z)]) for z in (0.0, height)])
    sides = [f for i in range(n) for j in [(i + 1) % n] for f in ((i, j, n + j), (i, n + j, n + i))]
    return trimesh.Trimesh(vertices, [*fan[:, ::-1], *(fan + n), *sides], process=False)


def write_box_obj(path: Path, *, texture: str | None = None, mtl: str = "box.mtl", size=0.05):
    """A box of quads without normals, with texture coordinates; its material names a texture."""
    corners = [(x, y, z) for z in (0, size) for y in (0, size) for x in (0, size)]
    quads = [(1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6)]
    lines = [f"mtllib {mtl}", *(f"v {x} {y} {z}" for x, y, z in corners)]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl paint"]
    lines += ["f " + " ".join(f"{v}/{i + 1}" for i, v in enumerate(quad)) for quad in quads]
    path.write_text("\n".join(lines) + "\n")
    if texture is not None:
        (path.parent / "box.mtl").write_text(f"newmtl paint\nKd 1 1 1\nmap_Kd {texture}\n")
    return path
