"""Where the numbered discs go: beside what they name, hiding nothing that matters.

A disc never overlaps another and never leaves the picture. As far as there is room it hides no
finger, no contact point and no leader line, and rather lies beside the things than on them. Every
place of a grid is weighed, disc after disc, so the same picture always gets the same discs.
"""

import numpy as np
from numpy.typing import NDArray

from tog_drake.errors import InputError
from tog_drake.values import Array

GAP = 4  # [pixel] between a disc and another, or a stroke
STEP = 4  # [pixel] of the grid of places
# What a place costs, in pixels of distance from what the disc names.
_ON_STROKE = 10_000.0  # it hides a stroke that must be seen, or its leader crosses one
_ON_THINGS = 250.0  # all of it lies on the things
_ON_OUTLINE = 120.0  # all of it lies on other strokes
_LATER = 8.0  # it names the last of the points given, not the first
_TRIED = 400  # cheapest places whose leader line is looked at
_THING_SIZE = 11  # [pixel] of a point of the things: they are a few apart

Mask = NDArray[np.uint8]  # (H, W): 1 where something is drawn


def place_discs(
    size: tuple[int, int],
    radius: int,
    anchors: Array,
    *,
    strokes: Array,
    outlines: Array,
    things: Array,
    thickness: float,
) -> tuple[Array, Array]:
    """Returns the discs' centres and the points that they name, each (N, 2) [pixel].

    Args:
        size: width and height of the picture [pixel].
        radius: of a disc [pixel].
        anchors: (N, A, 2) [pixel] points that each disc may name, the first preferred. NaN and
            what lies out of the picture does not count.
        strokes: (M, 2, 2) [pixel] lines that must be seen.
        outlines: (L, 2, 2) [pixel] lines that should be.
        things: (P, 2) [pixel] points that should be.
        thickness: of lines [pixel].

    Raises:
        InputError: there is no room for so many discs.
    """
    u, v = (np.arange(radius, side - radius, STEP) for side in size)
    places = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).astype(np.float64)
    must_be_seen = _drawn(size, strokes, thickness)
    cost = _ON_THINGS * _share(_dotted(size, things), places, radius)
    cost += _ON_OUTLINE * _share(_drawn(size, outlines, thickness), places, radius)
    free = np.ones(len(places), dtype=bool)
    centers, targets = np.zeros((len(anchors), 2)), np.zeros((len(anchors), 2))
    for i, anchor in enumerate(anchors):
        if not free.any():
            raise InputError(
                f"{len(anchors)} marks do not fit into a picture of {size[0]}x{size[1]} pixels; "
                f"{i} do: ask for fewer candidates (k)"
            )
        distance, named = _nearest(places, _inside(anchor, size))
        total = cost + distance + np.where(free, 0.0, np.inf)
        total += _ON_STROKE * (_clearance(must_be_seen, places) < radius + GAP)
        tried = np.argsort(total, kind="stable")[:_TRIED]
        crossed = _crossed(must_be_seen, places[tried], named[tried], radius)
        best = tried[np.argmin(total[tried] + _ON_STROKE * crossed)]
        centers[i], targets[i] = places[best], named[best]
        free &= np.linalg.norm(places - centers[i], axis=1) >= 2 * radius + GAP
        must_be_seen |= _drawn(size, np.stack([centers[i], targets[i]])[None], thickness)
        must_be_seen |= _drawn(size, np.stack([centers[i], centers[i]])[None], 2 * radius)
    return centers, targets


def _inside(anchor: Array, size: tuple[int, int]) -> Array:
    """The points of ``anchor`` (A, 2) in the picture; if there is none, its middle."""
    inside = np.all((anchor >= 0) & (anchor <= np.array(size) - 1), axis=1)  # False where NaN
    return anchor[inside] if inside.any() else np.array([size]) / 2


def _nearest(places: Array, anchor: Array) -> tuple[Array, Array]:
    """How far each place (C, 2) is from the anchor's nearest point, (C,), and that point (C, 2)."""
    later = np.linspace(0.0, _LATER, len(anchor)) if len(anchor) > 1 else np.zeros(1)
    distance = np.linalg.norm(places[:, None] - anchor, axis=2) + later
    nearest = np.argmin(distance, axis=1)
    return distance[np.arange(len(places)), nearest], anchor[nearest]


def _drawn(size: tuple[int, int], lines: Array, thickness: float) -> Mask:
    import cv2

    mask = np.zeros(size[::-1], np.uint8)
    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    ends = np.rint(np.clip(lines, -1e4, 1e4)).astype(np.int32)
    cv2.polylines(mask, list(ends), False, 1, max(1, round(thickness)))
    return mask


def _dotted(size: tuple[int, int], points: Array) -> Mask:
    return _drawn(size, np.repeat(points[:, None], 2, axis=1), _THING_SIZE)


def _share(mask: Mask, places: Array, radius: int) -> Array:
    """How much of a disc at each place lies on what is drawn in the mask, (C,) from 0 to 1."""
    import cv2

    coarse = cv2.resize(mask.astype(np.float32), None, fx=1 / STEP, fy=1 / STEP, interpolation=3)
    side = 2 * (radius // STEP) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.float32)
    blurred = cv2.filter2D(coarse, -1, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT)
    column, row = np.minimum(places // STEP, np.array(blurred.shape[::-1]) - 1).astype(int).T
    return np.asarray(blurred[row, column], np.float64)


def _clearance(mask: Mask, places: Array) -> Array:
    """How far each place is from what is drawn in the mask, (C,) [pixel]."""
    import cv2

    distance = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    column, row = places.astype(int).T
    return np.asarray(distance[row, column], np.float64)


def _crossed(mask: Mask, places: Array, named: Array, radius: int) -> Array:
    """Which share of the leader lines from the places to what they name is drawn upon, (C,)."""
    along = np.linspace(0.0, 1.0, 40)[:, None, None]
    length = np.linalg.norm(places - named, axis=1)
    points = named + along * (places - named)  # (40, C, 2)
    column, row = np.rint(points).astype(int).transpose(2, 0, 1)
    between = (along[..., 0] * length > radius) & ((1 - along[..., 0]) * length > radius)
    return np.asarray(((mask[row, column] > 0) & between).mean(axis=0))
