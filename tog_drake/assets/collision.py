"""The shapes by which a scanned object touches: a surface for the hand, a skin for its like.

The *core* is the whole surface, decimated, as one rigid hydroelastic mesh: it meets pads and table,
which are compliant, with the true shape of the object. Two rigid meshes cannot meet so (Drake would
fall back to points between their convex hulls), hence the *skin*: convex compliant pieces that meet
those of other scanned objects alone (see ``stations.simulation``).
"""

from collections.abc import Mapping, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.assets.foreign import check_size
from tog_drake.assets.mesh import Faces, Solid
from tog_drake.errors import InputError
from tog_drake.values import Array

CORE_FACES = (600, 1500)
"""Of a core at least and at most. Measured: 400 turn a shape by 1-5 mm and let round ones rock,
3000 halve the speed."""
FINE_FACES = 3000  # where it does not lie still otherwise
FACE = 4e-5
"""[m²] of a core, on average: a finger's pad meets eight or more. Each face is a contact point or
two, which costs 20 µs a step, and 1500 of them on a spoon put 140 into the hand."""
FACES_RANGE = (50, 20_000)  # of a core: below it is no solid, above it is a day's simulation
# fast_simplification's ``agg``: the more, the sooner it takes an edge that is not the best. At 3
# surfaces are off by a third to two thirds of what they are at its default, 7; it may end early.
_HASTE = (3, 5, 7)
MAX_PIECES = 64  # of those that come with a scan; the largest are taken
SKIN_PIECES = 12
"""Of a skin, where that many fill the object. Every step Drake looks which of all pieces are near
each other, those of one object too."""
ROOM = 1.2  # the most that the pieces of a skin may fill, of what those fill that it is made of
MAX_PIECE_FILES = 1000
_PIECES = ("collision/*.obj", "*_vhacd.stl", "*_col.obj")  # where scans keep them
INSTALL = "pip install 'tog_drake[assets]'"

Piece = tuple[Array, Faces]  # vertices (V, 3) [m] and triangles (F, 3) of a convex shape


def core_faces(solid: Solid) -> int:
    """Returns how many faces the core of a solid is to have: as its surface is large."""
    import trimesh

    area = trimesh.triangles.area(solid.vertices[solid.faces]).sum()
    return int(np.clip(area / FACE, *CORE_FACES))


def core_of(solid: Solid, faces: int) -> tuple[Array, Faces]:
    """Returns the surface with about ``faces`` triangles.

    A finer one is decimated by quadrics; a much coarser one, such as a box of twelve, is
    subdivided: Drake puts one contact point on each triangle, and would let it tip over two.

    Raises:
        InputError: ``faces`` is outside ``FACES_RANGE``.
    """
    import fast_simplification
    import trimesh

    low, high = FACES_RANGE
    if not low <= faces <= high:
        raise InputError(f"--faces must be from {low} to {high}, not {faces}")
    vertices, triangles = solid.vertices, solid.faces
    if 2 * len(triangles) < faces:
        edge = 2 * np.sqrt(trimesh.triangles.area(vertices[triangles]).sum() / faces)
        vertices, triangles = trimesh.remesh.subdivide_to_size(
            vertices, triangles, max_edge=edge, max_iter=30
        )  # of long thin triangles it makes far too many
    # It works in single precision about the origin.
    middle = vertices.mean(axis=0)
    points, triangles = (vertices - middle).astype(np.float32), triangles.astype(np.int32)
    for haste in _HASTE:
        if len(triangles) > faces:
            points, triangles = fast_simplification.simplify(
                points, triangles, target_count=faces, agg=haste
            )
    vertices = points.astype(np.float64) + middle
    core = trimesh.Trimesh(vertices, triangles, process=False)
    core.update_faces(core.nondegenerate_faces() & core.unique_faces())
    core.remove_unreferenced_vertices()
    return np.asarray(core.vertices, np.float64), np.asarray(core.faces, np.int64)


def find_pieces(mesh: Path) -> list[Path]:
    """Returns the files of convex pieces that lie beside a mesh, where scans keep them."""
    folder = mesh.parent.resolve()
    for pattern in _PIECES:
        found = (path for path in folder.glob(pattern) if path.name != mesh.name)
        inside = (path for path in found if path.resolve().is_relative_to(folder))
        files = sorted(islice(inside, MAX_PIECE_FILES + 1))
        if files:
            return files
    return []


def read_pieces(paths: Sequence[Path], scale: float, turn: Array) -> list[Piece]:
    """Reads the convex pieces that come with a scan: one file each, or all in one file.

    A file's pieces are cut in file order (see ``cut_in_file_order``); of each the hull is taken.

    Args:
        paths: OBJ or STL.
        scale: metres per unit of the files.
        turn: (3, 3) from the files' axes to the object's.

    Raises:
        InputError: there are too many files, one cannot be read, or holds no closed piece.
    """
    if len(paths) > MAX_PIECE_FILES:
        raise InputError(
            f"{paths[0].parent} holds more than {MAX_PIECE_FILES} collision pieces; merge or "
            "remove some"
        )
    pieces = []
    for path in paths:
        check_size(path)
        try:
            triangles = _obj_triangles(path) if path.suffix == ".obj" else _stl_triangles(path)
            found = [_hull(piece * scale @ turn.T) for piece in cut_in_file_order(triangles)]
        except Exception as error:  # as in read_mesh
            raise InputError(f"cannot read the collision pieces {path}: {error}") from error
        if not found:
            raise InputError(f"{path} holds no closed collision piece")
        pieces += [piece for piece in found if piece is not None]
    return _largest(pieces)


def _stl_triangles(path: Path) -> Array:
    import trimesh

    with path.open("rb") as file:
        mesh: Any = trimesh.load(file, file_type="stl", force="mesh", process=False)
    return np.asarray(mesh.triangles, np.float64)


def _obj_triangles(path: Path) -> Array:
    """(T, 3, 3) in the order of the file.

    trimesh would put the second halves of all quads behind all first ones, and no piece would be
    closed before the last.
    """
    vertices: list[list[float]] = []
    corners: list[int] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            word, *rest = line.split() or [""]
            if word == "v":
                vertices.append([float(number) for number in rest[:3]])
            elif word == "f":
                rows = [int(corner.split("/")[0]) for corner in rest]
                rows = [row - 1 if row > 0 else len(vertices) + row for row in rows]
                for second, third in pairwise(rows[1:]):
                    corners += [rows[0], second, third]
    return np.array(vertices, np.float64).reshape(-1, 3)[corners].reshape(-1, 3, 3)


def fits(pieces: Sequence[Piece], solid: Solid) -> bool:
    """Whether pieces fill the same box as a solid, to a twelfth of its diagonal or 5 mm."""
    if not pieces:
        return False
    points = np.vstack([vertices for vertices, _ in pieces])
    off = max(
        np.abs(points.min(axis=0) - solid.vertices.min(axis=0)).max(),
        np.abs(points.max(axis=0) - solid.vertices.max(axis=0)).max(),
    )
    return bool(off <= max(0.005, 0.08 * np.linalg.norm(np.ptp(solid.vertices, axis=0))))


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
    hulls = [_hull(np.asarray(vertices)) for vertices, _ in parts]
    return _largest([hull for hull in hulls if hull is not None])


def merged(pieces: Sequence[Piece]) -> list[Piece]:
    """Returns fewer convex pieces that fill about the same space, for a skin.

    Two become their hull, those first that gain least volume by it, until ``SKIN_PIECES`` are left
    or they would fill ``ROOM`` times the space: hollow things need more pieces than others.
    """
    found = dict(enumerate(pieces))
    volume = {i: _volume(piece) for i, piece in found.items()}
    room = ROOM * sum(volume.values())
    gain = {(i, j): _gain(found, volume, i, j) for i in found for j in found if i < j}
    while len(found) > SKIN_PIECES:
        i, j = min(gain, key=lambda pair: gain[pair])
        if sum(volume.values()) + gain[i, j] > room:
            break
        hull = _hull(np.vstack([found[i][0], found.pop(j)[0]]))
        assert hull is not None
        found[i], volume[i] = hull, _volume(hull)
        del volume[j]
        gain = {pair: more for pair, more in gain.items() if not {i, j} & {*pair}}
        gain |= {(i, k): _gain(found, volume, i, k) for k in found if k != i}
    return list(found.values())


def _gain(pieces: Mapping[int, Piece], volume: Mapping[int, float], i: int, j: int) -> float:
    """By how much the hull of two pieces is larger than they are [m³]."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(np.vstack([pieces[i][0], pieces[j][0]]))
    return float(hull.volume) - volume[i] - volume[j]


def _hull(points: Array) -> Piece | None:
    """The convex hull of points (N, 3); None where they fill no space."""
    import trimesh
    from scipy.spatial import QhullError

    if not np.isfinite(points).all():
        raise InputError("it holds vertices that are not numbers")
    try:
        hull = trimesh.convex.convex_hull(points)
    except QhullError:
        return None
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
