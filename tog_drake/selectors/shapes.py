"""Measures the shape of one thing: its axis, profile, round body and silhouette.

Points are (N, 3) [m] in a frame with z up and the table at z = 0.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tog_drake.points import clusters, neighbors
from tog_drake.values import Array

Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

MIN_POINTS = 12  # fewer are no part
BIN = 0.006  # [m] along an axis; two points of a cloud thinned to 3 mm
CELL = 0.004  # [m] of a silhouette
SPACING = 0.003  # [m] between points of a cloud
MAX_GAP = 0.010  # [m] between the points of one part
UPRIGHT = 1.1  # what is this much higher than long stands
MAX_SHOULDER = 2  # bins
SLACK = 0.015  # relative; what narrows by less from bin to bin is alike
MIN_NECK = 0.25  # what has a neck narrows at it by this much, in logarithms of width
CIRCLE_TOLERANCE = 0.004  # [m]
CIRCLE_RADIUS = (0.02, 0.10)  # [m] of a round body
MIN_EXPLAINED = 0.15  # of the silhouette is round: the rest may be a long handle
SECTORS = 24  # of a circle
MIN_SEEN = 0.55  # of the sectors of a round body
HYPOTHESES = 600  # circles tried
PROTRUSION = 0.008  # [m] beyond the circle begins what sticks out of it
MAX_SPAN = np.radians(120)  # of the circle at which one thing sticks out


class Frame:
    """A thing's principal axis in the table plane, and its size."""

    def __init__(self, points: Array):
        xy = points[:, :2]
        centre = (xy.max(axis=0) + xy.min(axis=0)) / 2
        # Cells, not points: a wall seen at length must not outweigh a top seen from above.
        cells = np.unique(np.floor((xy - centre) / CELL), axis=0) * CELL
        spread = cells - cells.mean(axis=0)
        axes = np.linalg.eigh(spread.T @ spread + 1e-12 * np.eye(2))[1]
        local = (xy - centre - cells.mean(axis=0)) @ axes
        self.s = local[:, 1]  # (N,) [m] along
        self.t = local[:, 0]  # (N,) [m] across
        self.length, self.width = float(np.ptp(self.s)), float(np.ptp(self.t))  # [m]
        self.height = float(np.percentile(points[:, 2], 99))  # [m]

    @property
    def upright(self) -> bool:
        return self.height > UPRIGHT * self.length


@dataclass(frozen=True)
class Profile:
    """How wide and high a thing is along its axis, bin by bin.

    The axis is the principal one of what lies, and the vertical of what stands, from below.
    """

    bin: Rows  # (N,) of each point
    width: Array  # (B,) [m]
    height: Array  # (B,) [m] of its highest point

    @property
    def length(self) -> float:
        return len(self.width) * BIN

    def reversed(self) -> "Profile":
        return Profile(len(self.width) - 1 - self.bin, self.width[::-1], self.height[::-1])


def profile_of(points: Array, frame: Frame) -> Profile:
    """Returns the profile of a thing; gaps in it are bridged and single bins smoothed."""
    z = points[:, 2]
    s, t = (z, frame.s) if frame.upright else (frame.s, frame.t)
    number = np.floor((s - s.min()) / BIN).astype(np.int64)
    count = int(number.max()) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    top = np.zeros(count)
    np.minimum.at(low, number, t)
    np.maximum.at(high, number, t)
    np.maximum.at(top, number, z)
    seen = np.flatnonzero(np.bincount(number) >= 2)
    if len(seen) == 0:
        return Profile(number, np.full(count, SPACING), top)
    bins = np.arange(count)
    width = np.interp(bins, seen, high[seen] - low[seen] + SPACING)
    height = np.interp(bins, seen, top[seen])
    width, height = (ndimage.median_filter(x, size=3, mode="nearest") for x in (width, height))
    return Profile(number, width, height)


def best_split(values: Array, *, low: int = 1) -> tuple[int, float]:
    """The index that best cuts a sequence into two levels, and the levels' difference.

    Best by least squares. The two values at either end do not count: ends are rounded.

    Args:
        values: (B,).
        low: the part of lower level has at least so many values.
    """
    trim = 2 if len(values) > 12 else 0
    inner = values[trim : len(values) - trim]
    n = len(inner)
    if n < 4:
        return 1, 0.0
    left = np.cumsum(inner)[:-1] / np.arange(1, n)
    right = (inner.sum() - np.cumsum(inner)[:-1]) / np.arange(n - 1, 0, -1)
    count = np.arange(1, n)
    short = np.where(left < right, count, n - count) + trim < low
    weight = np.where(short, 0, count * (n - count))
    split = int(np.argmax(weight * (left - right) ** 2)) + 1
    return split + trim, float(abs(left - right)[split - 1]) if weight.any() else 0.0


def slope(values: Array, split: int) -> tuple[int, int]:
    """The bins between which a thing changes from its thin portion, first, to its wide one.

    From ``split`` it is followed down to the waist, where it narrows no more, and up to the
    shoulder, though not far: what bulges all along has none.
    """
    low = high = split
    while low > 1 and values[low - 2] < values[low - 1] * (1 - SLACK):
        low -= 1
    end = min(len(values) - 1, split + MAX_SHOULDER)
    while high < end and values[high + 1] > values[high] * (1 + 4 * SLACK):
        high += 1
    return max(1, low - 1), high  # the boundary runs through a bin


def neck(width: Array) -> int | None:
    """The bin in the last half at which a thing narrows most steeply; None if it does not."""
    n = len(width)
    rows = np.arange(max(2, n // 2), n - 2)
    if len(rows) == 0:
        return None
    below = np.log(width[rows - 2] + width[rows - 1])
    above = np.log(width[rows] + width[rows + 1])
    best = int(np.argmax(below - above))
    return int(rows[best]) if below[best] - above[best] > MIN_NECK else None


def end_mean(values: Array, *, first: bool) -> float:
    """Mean over the first or the last fifth."""
    n = max(2, len(values) // 5)
    return float(values[:n].mean() if first else values[-n:].mean())


@dataclass(frozen=True)
class Circle:
    """A circle in the plane of the table: the round body of a thing, from above."""

    centre: Array  # (2,) [m]
    radius: float  # [m]

    def distance(self, points: Array) -> Array:
        """(N,) [m] of points from the axis of the round body."""
        return np.asarray(np.linalg.norm(points[:, :2] - self.centre, axis=1))


def round_body(points: Array) -> Circle | None:
    """The circle that most of the outline from above lies on; None where none explains enough.

    Cells of the silhouette vote, not points, for the reason given in ``Frame``. Three cells make
    a hypothesis.
    """
    high = points[points[:, 2] > 0.3 * points[:, 2].max()]
    cells = np.unique(np.floor(high[:, :2] / CELL), axis=0) * CELL + CELL / 2
    if len(cells) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    centre, radius = _circumcircles(*(cells[rng.integers(len(cells), size=(3, HYPOTHESES))]))
    keep = (radius > CIRCLE_RADIUS[0]) & (radius < CIRCLE_RADIUS[1])
    if not keep.any():
        return None
    centre, radius = centre[keep], radius[keep]
    off = np.linalg.norm(cells[None] - centre[:, None], axis=2) - radius[:, None]
    on = (np.abs(off) < CIRCLE_TOLERANCE).sum(axis=1)
    # A long arc through handle and rim must not outvote a full, smaller circle.
    best = int(np.argmax(on * np.minimum(on * CELL / (2 * np.pi * radius), 1.0)))
    on_best = cells[np.abs(off[best]) < CIRCLE_TOLERANCE] - centre[best]
    sector = np.floor(np.arctan2(on_best[:, 1], on_best[:, 0]) / (2 * np.pi) * SECTORS) % SECTORS
    seen = len(np.unique(sector)) / SECTORS
    explained = (off[best] < CIRCLE_TOLERANCE).mean()
    if seen < MIN_SEEN or seen * explained < MIN_EXPLAINED:
        return None
    return Circle(centre[best], float(radius[best]))


def _circumcircles(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Centres (M, 2) and radii of the circles through three points each; none where on a line."""
    p, q = b - a, c - a
    cross = 2 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    keep = np.abs(cross) > 1e-5
    a, p, q, cross = a[keep], p[keep], q[keep], cross[keep]
    pp, qq = (p**2).sum(axis=1), (q**2).sum(axis=1)
    offset = np.column_stack([q[:, 1] * pp - p[:, 1] * qq, p[:, 0] * qq - q[:, 0] * pp])
    offset /= cross[:, None]
    return a + offset, np.linalg.norm(offset, axis=1)


def protrusion(points: Array, circle: Circle) -> Mask | None:
    """The largest connected thing that sticks out of a round body; None where there is none.

    A skirt all around is none, nor is one of several corners.
    """
    outside = circle.distance(points) > circle.radius + PROTRUSION
    outside &= points[:, 2] > 0.1 * points[:, 2].max()
    rows = np.flatnonzero(outside)
    if len(rows) < MIN_POINTS:
        return None
    label = clusters(neighbors(points[rows], min(16, len(rows))), MAX_GAP)
    count = np.bincount(label)
    if count.max() < 0.5 * len(rows):
        return None
    rows = rows[label == count.argmax()]
    spoke = points[rows, :2] - circle.centre
    middle = spoke.mean(axis=0)
    away = np.arctan2(
        spoke[:, 1] * middle[0] - spoke[:, 0] * middle[1], spoke @ middle
    )  # angle from the middle of what sticks out
    if len(rows) < MIN_POINTS or np.ptp(away) > MAX_SPAN:
        return None
    mask = np.zeros(len(points), dtype=bool)
    mask[rows] = True
    return mask


def silhouette(points: Array) -> tuple[Mask, Rows]:
    """A thing seen along its thinnest direction, filled; and the pixel (N, 2) of each point."""
    cells = np.unique(np.floor(points / CELL), axis=0)
    spread = cells - cells.mean(axis=0)
    axes = np.linalg.eigh(spread.T @ spread)[1]
    pixel = np.floor(points @ axes[:, 1:] / CELL).astype(np.int64)
    pixel -= pixel.min(axis=0) - 12  # a rim wider than any disc
    picture = np.zeros(pixel.max(axis=0) + 13, dtype=bool)
    picture[tuple(pixel.T)] = True
    return ndimage.binary_fill_holes(ndimage.binary_closing(picture, disc(2))), pixel


def disc(radius: float) -> Mask:
    """A disc of ``radius`` cells, as a picture."""
    r = int(np.ceil(radius))
    y, x = np.mgrid[-r : r + 1, -r : r + 1]
    return np.asarray(x**2 + y**2 <= radius**2)
