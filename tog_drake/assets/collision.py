"""The shapes by which a scanned object touches: a surface for the hand, a skin for its like.

The *core* is the whole surface, decimated, as one rigid hydroelastic mesh: it meets pads and table,
which are compliant, with the true shape of the object. Two rigid meshes cannot meet so (Drake would
fall back to points between their convex hulls), hence the *skin*: convex compliant pieces that meet
those of other scanned objects alone (see ``stations.simulation``).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.assets.mesh import Faces, Solid
from tog_drake.errors import InputError
from tog_drake.values import Array

CORE_FACES = 1500
"""Measured: 400 turn a shape by 1-5 mm and let round ones rock, 3000 halve the speed."""
MAX_PIECES = 64  # of a skin; each is tested against each of another object's
INSTALL = "pip install 'tog_drake[assets]'"

Piece = tuple[Array, Faces]  # vertices (V, 3) [m] and triangles (F, 3) of a convex shape


def core_of(solid: Solid, faces: int = CORE_FACES) -> tuple[Array, Faces]:
    """Returns the surface with about ``faces`` triangles, by quadric decimation.

    Raises:
        InputError: ``faces`` is too few for a solid.
    """
    import fast_simplification
    import trimesh

    if faces < 50:
        raise InputError(f"--faces must be at least 50, not {faces}")
    vertices, triangles = solid.vertices, solid.faces
    if len(triangles) > faces:
        # It works in single precision about the origin.
        middle = vertices.mean(axis=0)
        points, triangles = fast_simplification.simplify(
            (vertices - middle).astype(np.float32), triangles.astype(np.int32), target_count=faces
        )
        vertices = points.astype(np.float64) + middle
    core = trimesh.Trimesh(vertices, triangles, process=False)
    core.update_faces(core.nondegenerate_faces() & core.unique_faces())
    core.remove_unreferenced_vertices()
    return np.asarray(core.vertices, np.float64), np.asarray(core.faces, np.int64)


def read_pieces(paths: Sequence[Path], scale: float, turn: Array) -> list[Piece]:
    """Reads the convex pieces that come with a scan: one file each, or all in one file.

    A file's pieces are cut in file order (see ``cut_in_file_order``); of each the hull is taken.

    Args:
        paths: OBJ or STL.
        scale: metres per unit of the files.
        turn: (3, 3) from the files' axes to the object's.

    Raises:
        InputError: a file cannot be read, or holds no closed piece.
    """
    import trimesh

    pieces = []
    for path in paths:
        try:
            mesh = trimesh.load(path, force="mesh", process=False)
            triangles = np.asarray(mesh.triangles, np.float64)
        except Exception as error:  # as in read_mesh
            raise InputError(f"cannot read the collision pieces {path}: {error}") from error
        found = [_hull(piece * scale @ turn.T) for piece in cut_in_file_order(triangles)]
        if not found:
            raise InputError(f"{path} holds no closed collision piece")
        pieces += found
    return _largest(pieces)


def cut_in_file_order(triangles: Array) -> list[Array]:
    """Cuts triangles (T, 3, 3) into closed pieces, in the order in which a file lists them.

    A piece ends where every edge has been met in both directions. Connected components would not
    do: V-HACD's pieces share corners. What is left open at the end is dropped.
    """
    _, corner = np.unique(triangles.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    pieces, start = [], 0
    unmatched: set[tuple[int, int]] = set()
    for i, (a, b, c) in enumerate(corner.reshape(-1, 3).tolist()):
        for edge in ((a, b), (b, c), (c, a)):
            if (edge[1], edge[0]) in unmatched:
                unmatched.remove((edge[1], edge[0]))
            else:
                unmatched.add(edge)
        if not unmatched:
            pieces.append(triangles[start : i + 1].reshape(-1, 3))
            start = i + 1
    return pieces


def decompose(solid: Solid) -> list[Piece]:
    """Cuts a solid into convex pieces with CoACD; it takes seconds to minutes.

    Raises:
        InputError: CoACD is not installed.
    """
    try:
        import coacd
    except ImportError as error:
        raise InputError(f"cutting a mesh into convex pieces needs CoACD: {INSTALL}") from error
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(solid.vertices, solid.faces), threshold=0.1, max_convex_hull=32, seed=0
    )
    return _largest([_hull(np.asarray(vertices)) for vertices, _ in parts])


def _hull(points: Array) -> Piece:
    import trimesh

    hull = trimesh.convex.convex_hull(points)
    return np.asarray(hull.vertices, np.float64), np.asarray(hull.faces, np.int64)


def _largest(pieces: list[Piece]) -> list[Piece]:
    """At most ``MAX_PIECES``, in their order; those that are nearly flat are dropped."""
    volume = np.array([_volume(piece) for piece in pieces])
    solid = volume > 1e-10  # [m³] a cube of half a millimetre
    ranked = np.argsort(-volume, kind="stable")[:MAX_PIECES]
    return [pieces[i] for i in np.sort(ranked) if solid[i]]


def _volume(piece: Piece) -> float:
    import trimesh

    mesh: Any = trimesh.Trimesh(*piece, process=False)
    return abs(float(mesh.volume))
