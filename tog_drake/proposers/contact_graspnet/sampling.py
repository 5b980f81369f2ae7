"""Which points the network looks at: farthest points, neighbours in a ball, three nearest.

All of it depends on coordinates alone, and all of it is exact: the same float32 arithmetic (direct
differences, squares summed in the order x, y, z) as a walk over all points would do, and ties go
to the lowest index. numpy alone; one cloud at a time.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]  # (N, 3) [m]
Rows = NDArray[np.int64]

GROUP = 48  # centres whose distances are computed together: they fit into the cache


def squared_distances(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances [m²] of points (3, ...) that broadcast, squares summed as x, y, z."""
    total: NDArray[np.float32] = a[0] - b[0]
    total *= total
    for axis in (1, 2):
        square = a[axis] - b[axis]
        square *= square
        total += square
    return total


def farthest_points(points: Points, count: int) -> Rows:
    """Picks ``count`` points, each the farthest from those before it; the first is row 0.

    Of equally far points the lowest row is picked; once all points are as good as picked (fewer
    distinct ones than ``count``), that is row 0 again and again.

    Args:
        points: (N, 3) [m], N ≥ 1.

    Returns:
        (count,) rows in the order of picking.
    """
    xyz = np.ascontiguousarray(points.T)
    picked = np.zeros(count, np.int64)
    distance = np.full(len(points), np.inf, np.float32)
    for i in range(1, count):
        last = picked[i - 1]
        np.minimum(distance, squared_distances(xyz, xyz[:, last, None]), out=distance)
        picked[i] = distance.argmax()
    return picked


@dataclass(frozen=True)
class Neighbours:
    """For each of M centres up to K points; where there are fewer, the first one is repeated."""

    index: Rows  # (M, K) rows of the points
    count: Rows  # (M,) how many are not repeats


def ball_query(
    points: Points, centres: Points, radii: Sequence[float], most: Sequence[int]
) -> list[Neighbours]:
    """The points within each radius of each centre, the lowest rows first.

    Not the nearest: which ones are left out depends on the order of the points.

    Args:
        points: (N, 3) [m].
        centres: (M, 3) [m], each of which is one of the points.
        radii: [m]; a point exactly that far belongs to the ball.
        most: how many points are kept for each radius.

    Returns:
        One for each radius.
    """
    index = [np.empty((len(centres), k), np.int64) for k in most]
    count = [np.empty(len(centres), np.int64) for _ in most]
    xyz = np.ascontiguousarray(points.T)
    for group in _groups(centres):
        near, distance = _near(xyz, centres[group], max(radii))
        start = np.arange(len(group) + 1) * len(near)
        for radius, k, index_of, count_of in zip(radii, most, index, count, strict=True):
            hit = np.flatnonzero(distance <= np.float32(radius * radius))  # centre by centre
            first = hit.searchsorted(start)
            hits = np.diff(first)[:, None]
            slot = np.arange(k)
            slot = first[:-1, None] + slot * (slot < hits)
            index_of[group] = near.take(hit.take(slot) - start[:-1, None])
            count_of[group] = np.minimum(hits[:, 0], k)
    return [Neighbours(i, c) for i, c in zip(index, count, strict=True)]


def _near(
    xyz: NDArray[np.float32], centres: Points, reach: float
) -> tuple[Rows, NDArray[np.float32]]:
    """The points (columns of ``xyz``) in the box that holds all within ``reach`` of a centre.

    Returns:
        Their columns, ascending (C,); squared distances [m²] of every centre to them (M, C).
    """
    reach *= 1 + 1e-5  # the box is rounded
    lower, upper = centres.min(axis=0) - reach, centres.max(axis=0) + reach
    near = np.flatnonzero(
        (xyz[0] >= lower[0])
        & (xyz[0] <= upper[0])
        & (xyz[1] >= lower[1])
        & (xyz[1] <= upper[1])
        & (xyz[2] >= lower[2])
        & (xyz[2] <= upper[2])
    )
    return near, squared_distances(centres.T[:, :, None], xyz.take(near, axis=1)[:, None])


def _groups(points: Points) -> list[Rows]:
    """Divides points by halves into groups of at most ``GROUP`` that lie close together."""
    todo, groups = [np.arange(len(points))], []
    while todo:
        rows = todo.pop()
        if len(rows) <= GROUP:
            groups.append(rows)
            continue
        p = points[rows]
        half = len(rows) // 2
        order = rows[p[:, np.ptp(p, axis=0).argmax()].argpartition(half)]
        todo += [order[:half], order[half:]]
    return groups


def three_nearest(points: Points, sources: Points) -> tuple[Rows, NDArray[np.float32]]:
    """The three sources nearest to each point, and how much each weighs there.

    A weight is inverse to the *squared* distance. Of equally near sources the lowest row is taken.

    Args:
        points: (M, 3) [m].
        sources: (S, 3) [m], S ≥ 3.

    Returns:
        Rows of the sources (M, 3), nearest first, and weights (M, 3) that sum to 1.
    """
    distance = squared_distances(points.T[:, :, None], sources.T[:, None])
    every = np.arange(len(points))
    index = np.zeros((len(points), 3), np.int64)
    nearest = np.zeros((len(points), 3), np.float32)
    for k in range(3):
        index[:, k] = distance.argmin(axis=1)
        nearest[:, k] = distance[every, index[:, k]]
        distance[every, index[:, k]] = np.inf
    weight = 1 / (nearest + np.float32(1e-8))
    return index, weight / weight.sum(axis=1, keepdims=True)
