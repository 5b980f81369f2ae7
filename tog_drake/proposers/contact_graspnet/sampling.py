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


def squared_distances(a: Points, b: Points) -> NDArray[np.float32]:
    """Squared distances [m²] of points (..., 3) that broadcast, squares summed as x, y, z."""
    total: NDArray[np.float32] = np.square(a[..., 0] - b[..., 0])
    total += np.square(a[..., 1] - b[..., 1])
    total += np.square(a[..., 2] - b[..., 2])
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
    picked = np.zeros(count, np.int64)
    distance = np.full(len(points), np.inf, np.float32)
    for i in range(1, count):
        np.minimum(distance, squared_distances(points, points[picked[i - 1]]), out=distance)
        picked[i] = np.argmax(distance)
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
    found = [np.zeros((len(centres), k), np.int64) for k in most]
    counts = [np.zeros(len(centres), np.int64) for _ in most]
    for start in range(0, len(centres), 64):
        chunk = slice(start, start + 64)
        distance = squared_distances(points, centres[chunk, None])
        for radius, k, index, count in zip(radii, most, found, counts, strict=True):
            row, column = np.nonzero(distance <= np.float32(radius * radius))
            first = np.searchsorted(row, np.arange(len(distance)))
            rank = np.arange(len(row)) - first[row]
            kept = rank < k
            index[chunk] = column[first][:, None]
            index[start + row[kept], rank[kept]] = column[kept]
            count[chunk] = np.minimum(np.diff(first, append=len(row)), k)
    return [Neighbours(i, c) for i, c in zip(found, counts, strict=True)]


def three_nearest(points: Points, sources: Points) -> tuple[Rows, NDArray[np.float32]]:
    """The three sources nearest to each point, and how much each weighs there.

    A weight is inverse to the *squared* distance. Of equally near sources the lowest row is taken.

    Args:
        points: (M, 3) [m].
        sources: (S, 3) [m], S ≥ 3.

    Returns:
        Rows of the sources (M, 3), nearest first, and weights (M, 3) that sum to 1.
    """
    distance = squared_distances(points[:, None], sources)
    every = np.arange(len(points))
    index = np.zeros((len(points), 3), np.int64)
    nearest = np.zeros((len(points), 3), np.float32)
    for k in range(3):
        index[:, k] = distance.argmin(axis=1)
        nearest[:, k] = distance[every, index[:, k]]
        distance[every, index[:, k]] = np.inf
    weight = 1 / (nearest + np.float32(1e-8))
    return index, weight / weight.sum(axis=1, keepdims=True)
