"""Which points the network looks at: farthest points, neighbours in a ball, three nearest.

All of it depends on coordinates alone, and all of it is exact: the same float32 arithmetic (direct
differences, squares summed in the order x, y, z) as a walk over all points would do, and ties go
to the lowest index. numpy alone; one cloud at a time.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float32]  # (N, 3) [m]
Rows = NDArray[np.int64]
Each = Callable[[Callable[[Rows], None], Iterable[Rows]], Iterable[None]]

MANY = 4096  # points; of fewer, a walk over all of them is the fastest way to the farthest
FIRST = 64  # farthest points that are picked by a walk over all
ACTIVE = 400  # points that are walked over afterwards
BLOCKS = 128  # of points that are brought up to date together
DENSE = 4096  # points near a group of centres; of more, so many are looked at first
GROUP = 48  # centres whose distances are computed together: of fewer, threads wait for Python


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
        points: (N, 3) [m], finite, N ≥ 1.

    Returns:
        (count,) rows in the order of picking.
    """
    xyz = np.ascontiguousarray(points.T)
    distance = np.full(len(points), np.inf, np.float32)  # [m²] to the nearest picked point
    few = len(points) < MANY or count <= FIRST
    picked = _walk(xyz, distance, 0, count if few else FIRST)
    if len(picked) == count:
        return np.array(picked)
    # From here on a pick is near to few points. The next picks all lie among those that are
    # farthest now, as long as these stay farther than all others: the distances only fall. So the
    # walk is over these alone, and the others are brought up to date after it.
    blocks = _Blocks(xyz)
    while len(picked) < count:
        least = np.partition(distance, -ACTIVE)[-ACTIVE]
        active = np.flatnonzero(distance >= least)
        their_distance = distance[active]
        found = _walk(
            *(xyz.take(active, axis=1), their_distance, int(their_distance.argmax())),
            *(count - len(picked), least),
        )
        new = active[found]
        blocks.update(distance, xyz.take(new, axis=1))
        picked += new.tolist()
    return np.array(picked)


def _walk(
    xyz: NDArray[np.float32],
    distance: NDArray[np.float32],
    start: int,
    most: int,
    least: float = 0.0,
) -> list[int]:
    """Picks the farthest of N points (3, N), up to ``most``, while it is ``least`` [m²] away.

    ``distance`` (N,) is kept up to date. The first pick is ``start``.
    """
    picked: list[int] = []
    square = np.empty_like(xyz)
    x, y, z = square
    row = start
    while len(picked) < most and distance[row] >= least:
        picked.append(row)
        np.subtract(xyz, xyz[:, row : row + 1], out=square)
        np.multiply(square, square, out=square)
        np.add(x, y, out=x)
        np.add(x, z, out=x)
        np.minimum(distance, x, out=distance)
        row = int(distance.argmax())
    return picked


class _Blocks:
    """N points (3, N) in blocks that lie close together: what is far need not be touched."""

    def __init__(self, xyz: NDArray[np.float32]):
        rows = np.resize(np.arange(xyz.shape[1]), (1, -(-xyz.shape[1] // BLOCKS) * BLOCKS))
        for axis in (0, 1, 2, 0, 1, 2, 0):  # halves, 2⁷ = BLOCKS; a few points are in two blocks
            half = rows.shape[1] // 2
            order = xyz[axis].take(rows).argpartition(half, axis=1)
            rows = np.take_along_axis(rows, order, axis=1).reshape(-1, half)
        self._rows = rows  # (BLOCKS, K)
        self._xyz = xyz.take(rows, axis=1)  # (3, BLOCKS, K)
        self._lower, self._upper = (
            self._xyz.min(axis=2)[..., None],
            self._xyz.max(axis=2)[..., None],
        )

    def update(self, distance: NDArray[np.float32], new: NDArray[np.float32]) -> None:
        """Lowers the squared distances (N,) to those from the new points (3, P) where nearer."""
        now = distance.take(self._rows)
        nearest = np.clip(new[:, None], self._lower, self._upper)  # in each block's box
        to_box = squared_distances(nearest, new[:, None]) * np.float32(1 - 1e-5)  # it is rounded
        block, p = np.nonzero(to_box < now.max(axis=1, keepdims=True))
        if len(block) == 0:
            return
        square = squared_distances(self._xyz.take(block, axis=1), new.take(p, axis=1)[..., None])
        first = np.flatnonzero(np.diff(block, prepend=-1))
        square = np.minimum.reduceat(square, first, axis=0)
        block = block[first]
        distance[self._rows[block]] = np.minimum(now[block], square)


@dataclass(frozen=True)
class Neighbours:
    """For each of M centres up to K points; where there are fewer, the first one is repeated."""

    index: Rows  # (M, K) rows of the points
    count: Rows  # (M,) how many are not repeats


def ball_query(
    points: Points,
    centres: Points,
    radii: Sequence[float],
    most: Sequence[int],
    each: Each = map,
) -> list[Neighbours]:
    """The points within each radius of each centre, the lowest rows first.

    Not the nearest: which ones are left out depends on the order of the points.

    Args:
        points: (N, 3) [m].
        centres: (M, 3) [m], each of which is one of the points.
        radii: [m]; a point exactly that far belongs to the ball.
        most: how many points are kept for each radius.
        each: calls a function for each of many things, as ``map`` does; of a pool of threads it
            may do so at the same time.

    Returns:
        One for each radius.
    """
    xyz = np.ascontiguousarray(points.T)
    balls = [
        _Ball(radius, np.empty((len(centres), k), np.int64), np.empty(len(centres), np.int64))
        for radius, k in zip(radii, most, strict=True)
    ]
    for _ in each(lambda group: _search(xyz, group, centres[group], balls), _groups(centres)):
        pass
    return [Neighbours(ball.index, ball.count) for ball in balls]


@dataclass(frozen=True)
class _Ball:
    """What ``ball_query`` finds for one radius."""

    radius: float  # [m]
    index: Rows  # (M, K)
    count: Rows  # (M,)


def _search(xyz: NDArray[np.float32], group: Rows, centres: Points, balls: Sequence[_Ball]) -> None:
    """Fills in the rows ``group`` of the balls: the points (3, N) that are near those centres.

    In a dense cloud the first points already fill the balls, the large ones before the small.
    """
    for columns in (DENSE, xyz.shape[1]):
        near = _in_box(xyz, centres, max(ball.radius for ball in balls))
        part = near[:columns]
        distance = squared_distances(centres.T[:, :, None], xyz.take(part, axis=1)[:, None])
        distance = distance.ravel()
        hit: Rows | None = None
        start = np.arange(len(centres) + 1) * len(part)
        for ball in sorted(balls, key=lambda ball: -ball.radius):  # the smaller within the larger
            some = distance if hit is None else distance.take(hit)
            inside = np.flatnonzero(some <= np.float32(ball.radius**2))  # centre by centre
            hit = inside if hit is None else hit.take(inside)
            first = hit.searchsorted(start)
            hits = np.diff(first)[:, None]
            most = ball.index.shape[1]
            ball.count[group] = np.minimum(hits[:, 0], most)
            if len(hit) > 0:
                slot = np.arange(most)
                slot = first[:-1, None] + slot * (slot < hits)
                ball.index[group] = part.take(
                    hit.take(slot, mode="clip") - start[:-1, None], mode="clip"
                )
        balls = [ball for ball in balls if ball.count[group].min() < ball.index.shape[1]]
        if len(part) == len(near) or not balls:
            return


def _in_box(xyz: NDArray[np.float32], centres: Points, reach: float) -> Rows:
    """The columns of ``xyz``, ascending, in the box that holds all within ``reach`` of a centre."""
    reach *= 1 + 1e-5  # the box is rounded
    lower, upper = centres.min(axis=0) - reach, centres.max(axis=0) + reach
    inside = (xyz[0] >= lower[0]) & (xyz[0] <= upper[0])
    for axis in (1, 2):
        inside &= xyz[axis] >= lower[axis]
        inside &= xyz[axis] <= upper[axis]
    return np.flatnonzero(inside)


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
    index = np.empty((len(points), 3), np.int64)
    nearest = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), 64):
        chunk = slice(start, start + 64)
        distance = squared_distances(points[chunk].T[..., None], sources.T[:, None])
        every = np.arange(len(distance))
        for k in range(3):
            index[chunk, k] = row = distance.argmin(axis=1)
            nearest[chunk, k] = distance[every, row]
            distance[every, row] = np.inf
    weight = 1 / (nearest + np.float32(1e-8))
    return index, weight / weight.sum(axis=1, keepdims=True)
