"""Where a hand could grasp, and how it could be turned: what the antipodal search starts from."""

from dataclasses import dataclass

import numpy as np
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.points import Rows, clusters, group_means, neighbors, voxel_numbers
from tog_drake.values import Array

FOOTPRINT = 0.004  # [m] squares of the table that a thing is above
SLICE = 0.010  # [m] pieces of its longest extent


@dataclass(frozen=True)
class Surface:
    """A cloud, thinned."""

    point: Array  # (N, 3) [m]
    normal: Array  # (N, 3) unit
    thing: Rows  # (N,) which connected thing each point belongs to
    balance: Array  # (T, 2) [m] x, y of where the centre of mass of each thing may be
    tree: cKDTree


@dataclass(frozen=True)
class Tries:
    """H hands, each with its origin at an anchor, before depth and centre are known."""

    anchor: Rows  # (H,) rows of the surface
    R_WG: Array  # (H, 3, 3)
    per_anchor: int  # the tries of one anchor are consecutive


def thinned_surface(cloud: PointCloud, voxel: float) -> Surface:
    """Returns the cloud at a resolution of ``voxel`` [m], whatever the order of its points."""
    point, normal = cloud.xyzs().T.astype(np.float64), cloud.normals().T.astype(np.float64)
    order = np.lexsort(point.T)  # sums depend on the order of what is summed
    point, normal = point[order], normal[order]
    number = voxel_numbers(point, voxel)
    point, normal = group_means(number, point), group_means(number, normal)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
    thing = clusters(neighbors(point, 12), 2.5 * voxel)
    return Surface(point, normal, thing, _balance(point, thing), cKDTree(point))


def _balance(point: Array, thing: Rows) -> Array:
    """Guesses where the centre of mass of each thing is, as seen from above, (T, 2) [m].

    Things are taken to be as thick as they are wide: a stretch of a thing counts with the square
    of its width across the longest extent. So a guess goes towards the head of a tool, which is
    also where tools are of steel. Tools of 0.1 to 0.4 kg were 16 mm off on average, a hatchet
    28 mm; their centroids 20 mm and 68 mm.
    """
    return np.array([_balance_of(point[thing == t, :2]) for t in range(thing.max() + 1)])


def _balance_of(xy: Array) -> Array:
    middle = group_means(voxel_numbers(np.pad(xy, ((0, 0), (0, 1))), FOOTPRINT), xy)
    spread = middle - middle.mean(axis=0)
    across, along = (spread @ np.linalg.eigh(spread.T @ spread)[1]).T
    slab = np.floor((along - along.min()) / SLICE).astype(np.int64)
    low, high = np.full(slab.max() + 1, np.inf), np.full(slab.max() + 1, -np.inf)
    np.minimum.at(low, slab, across)
    np.maximum.at(high, slab, across)
    width = (high - low)[slab] + FOOTPRINT
    return np.asarray((width[:, None] * middle).sum(axis=0) / width.sum())


def spread_anchors(surface: Surface, spacing: float, count: int, rng: np.random.Generator) -> Rows:
    """Returns the rows of at most ``count`` points to grasp at, about ``spacing`` [m] apart.

    Where there would be more, they are spread by farthest-point sampling, in which distances count
    more where there is little surface around: a shaft or a rim gets more anchors than its area
    would earn.
    """
    cell = voxel_numbers(surface.point + rng.uniform(0, spacing, 3), spacing)
    row: Rows = np.unique(surface.tree.query(group_means(cell, surface.point))[1]).astype(np.int64)
    if len(row) <= count:
        return row
    around = surface.tree.query_ball_point(surface.point[row], 0.02, return_length=True)
    weight = np.sqrt(around.max() / around)
    picked = [int(np.argmax(weight))]
    distance = np.full(len(row), np.inf)
    while len(picked) < count:
        step = np.linalg.norm(surface.point[row] - surface.point[row[picked[-1]]], axis=1)
        distance = np.minimum(distance, step)
        picked.append(int(np.argmax(distance * weight)))
    return np.sort(row[picked])


def hand_tries(surface: Surface, anchor: Rows, yaws: int, tilts: Array) -> Tries:
    """Returns the hands to try at each anchor.

    Args:
        anchor: (A,) rows of the surface.
        yaws: how many closing directions over half a turn. The first lies across the longest
            extent of what is around the anchor.
        tilts: [rad] of the approach away from the vertical, besides none.
    """
    lean = _leans(tilts)  # (L, 3, 3)
    across = np.array([_across(surface, row) for row in anchor])
    yaw = across[:, None] + np.arange(yaws) * np.pi / yaws  # (A, Y)
    c, s, o = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)
    # Columns x, y (closing), z (approach) of a hand that points straight down.
    down = np.stack([np.stack(v, -1) for v in ([-s, c, o], [c, s, o], [o, o, o - 1])], -1)
    R_WG = down[:, :, None] @ lean  # (A, Y, L, 3, 3)
    per_anchor = R_WG.shape[1] * R_WG.shape[2]
    return Tries(np.repeat(anchor, per_anchor), R_WG.reshape(-1, 3, 3), per_anchor)


def _leans(tilts: Array) -> Array:
    """Rotations of the hand away from the vertical, (L, 3, 3).

    About the closing axis y by every tilt, so that both fingers stay level; about x, which lowers
    one finger, by tilts up to 45° only.
    """
    lean = [np.eye(3)]
    for t in np.concatenate([tilts, -tilts]):
        c, s = np.cos(t), np.sin(t)
        lean.append(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
        if abs(t) < np.pi / 4:
            lean.append(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))
    return np.array(lean)


def _across(surface: Surface, row: np.int64) -> float:
    """The horizontal direction [rad] across the longest extent of what is around a point."""
    around = surface.point[surface.tree.query_ball_point(surface.point[row], 0.025)][:, :2]
    spread = around - around.mean(axis=0)
    x, y = np.linalg.eigh(spread.T @ spread)[1][:, 0]
    return float(np.arctan2(y, x))
