"""Numbered discs: where they go, beside what they name and hiding nothing that matters, and how
they look.

A disc never overlaps another and never leaves the picture. As far as there is room it hides no
finger, no contact point and no leader line, and rather lies beside the things than on them. Every
place of a grid is weighed, disc after disc, so the same picture always gets the same discs.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tog_drake.drawing import OUTLINE_COLOR, Image, draw_outlined
from tog_drake.errors import InputError
from tog_drake.values import Array

Color = tuple[int, int, int]

RADIUS = 18  # [pixel] of a disc, rings included: its number can be read at the size of the picture
TEXT = 0.8  # height of a disc's number in units of cv2, where it fits
LEADER = 1.5  # [pixel] thickness of the line from a disc to what it names

STEP = 4  # [pixel] of the grid of places: each cell of a mask is one of them
GAP = 4  # [pixel] between a disc and another, or a line
# What a place costs, in pixels of distance from what the disc names.
_ON_LINE = 10_000.0  # it hides a line that must be seen, or its leader crosses one
_ON_THINGS = 250.0  # all of it lies on the things
_ON_STEMS = 120.0  # all of it, or of its leader, lies on the stems of others
_LATER = 8.0  # it names the last of the points given, not the first
_TRIED = 400  # cheapest places whose leader line is looked at
_THING_SIZE = 11  # [pixel] of a point of the things: they are a few apart

Mask = NDArray[np.uint8]  # 1 where something is drawn: a cell is STEP pixels wide


def place_discs(
    size: tuple[int, int],
    anchors: Array,
    *,
    lines: Array,
    stems: Array | None,
    things: Array,
    thickness: float,
) -> tuple[Array, Array]:
    """Returns the discs' centres and the points that they name, each (N, 2) [pixel].

    Args:
        size: width and height of the picture [pixel].
        anchors: (N, A, 2) [pixel] points that each disc may name, the first preferred; see
            ``_within`` for those that are NaN or out of the picture.
        lines: (M, 2, 2) [pixel] what must be seen, ``thickness`` [pixel] wide.
        stems: (N, 2, 2) [pixel] lines that only the disc of the same row may hide, if any.
        things: (P, 2) [pixel] points that should be seen.

    Raises:
        InputError: there is no room for so many discs.
    """
    cells = _cells(size)
    places = (STEP * cells).astype(np.float64)
    seen = _drawn(size, lines, thickness)
    on_things = _ON_THINGS * _share(_drawn(size, _dots(things), _THING_SIZE), cells)
    stems = np.zeros((0, 2, 2)) if stems is None else stems
    free = np.ones(len(places), dtype=bool)
    centers, targets = np.zeros((2, len(anchors), 2))
    for i, anchor in enumerate(anchors):
        if not free.any():
            raise _no_room(len(anchors), size, i)
        others = _drawn(size, stems[np.arange(len(stems)) != i], thickness)
        distance, named = _nearest(places, _within(anchor, size))
        cost = np.where(free, distance + on_things, np.inf)
        best = _cheapest(cost, cells, places, named, seen=seen, others=others)
        centers[i], targets[i] = places[best], named[best]
        free &= np.hypot(*(places - centers[i]).T) >= 2 * RADIUS + GAP
        seen |= _drawn(size, np.stack([centers[i], targets[i]])[None], 1.0)
        seen |= _drawn(size, _dots(centers[i : i + 1]), 2 * RADIUS)
    return centers, targets


def _no_room(count: int, size: tuple[int, int], most: int) -> InputError:
    return InputError(
        f"{count} marks do not fit into a picture of {size[0]}x{size[1]} pixels; {most} do: ask "
        "for fewer candidates (k)"
    )


def _cells(size: tuple[int, int]) -> NDArray[np.int64]:
    """The cells (C, 2) of the grid where a disc has room."""
    cells = np.stack(np.meshgrid(*(np.arange(side // STEP) for side in size)), axis=-1)
    cells = cells.reshape(-1, 2)
    inside = np.all((cells * STEP >= RADIUS) & (cells * STEP < np.array(size) - RADIUS), axis=1)
    return np.asarray(cells[inside])


def _cheapest(
    cost: Array,
    cells: NDArray[np.int64],
    places: Array,
    named: Array,
    *,
    seen: Mask,
    others: Mask,
) -> int:
    """The best place, by what it costs (C,) and by what disc and leader would hide there."""
    cost = cost + _ON_STEMS * _share(others, cells)
    cost += _ON_LINE * (_clearance(seen, cells) < RADIUS + GAP)
    tried = np.argsort(cost, kind="stable")[:_TRIED]
    crossed = _ON_LINE * _crossed(seen, places[tried], named[tried])
    crossed += _ON_STEMS * _crossed(others, places[tried], named[tried])
    return int(tried[np.argmin(cost[tried] + crossed)])


def _within(anchor: Array, size: tuple[int, int]) -> Array:
    """Returns which points of ``anchor`` (A, 2) a disc may name: those in the picture.

    If none is, the point of the picture's edge that is nearest to any of them. If all are NaN,
    none: the disc then names its own place, and its leader has no length.
    """
    edge = np.array(size) - 1.0
    inside = np.all((anchor >= 0) & (anchor <= edge), axis=1)  # False where NaN
    if inside.any():
        return anchor[inside]
    known = anchor[np.isfinite(anchor).all(axis=1)]
    at_edge = np.clip(known, 0.0, edge)
    off = np.linalg.norm(known - at_edge, axis=1)
    return np.asarray(at_edge[off == off.min(initial=np.inf)][:1])


def _nearest(places: Array, anchor: Array) -> tuple[Array, Array]:
    """How far each place (C, 2) is from the anchor's nearest point, (C,), and that point (C, 2)."""
    if len(anchor) == 0:
        return np.zeros(len(places)), places
    later = _LATER * np.arange(len(anchor)) / max(1, len(anchor) - 1)
    u, v = np.ascontiguousarray(places.T)
    distance = np.hypot(u - anchor[:, :1], v - anchor[:, 1:]) + later[:, None]  # (A, C)
    nearest = np.argmin(distance, axis=0)
    return distance[nearest, np.arange(len(places))], anchor[nearest]


def _dots(points: Array) -> Array:
    """Lines (N, 2, 2) that end where they begin."""
    return np.repeat(points[:, None], 2, axis=1)


def _drawn(size: tuple[int, int], lines: Array, thickness: float) -> Mask:
    import cv2

    mask = np.zeros((size[1] // STEP, size[0] // STEP), np.uint8)
    ends = np.rint(np.clip(lines[np.isfinite(lines).all(axis=(1, 2))] / STEP, -1e4, 1e4))
    cv2.polylines(mask, list(ends.astype(np.int32)), False, 1, int(np.ceil(thickness / STEP)))
    return mask


def _share(mask: Mask, cells: NDArray[np.int64]) -> Array:
    """How much of a disc at each cell lies on what is drawn in the mask, (C,) from 0 to 1."""
    import cv2

    side = 2 * (RADIUS // STEP) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.float32)
    blurred = cv2.filter2D(
        mask.astype(np.float32), -1, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(blurred[cells[:, 1], cells[:, 0]], np.float64)


def _clearance(mask: Mask, cells: NDArray[np.int64]) -> Array:
    """How far each cell is from what is drawn in the mask, (C,) [pixel]."""
    import cv2

    distance = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(STEP * distance[cells[:, 1], cells[:, 0]], np.float64)


def _crossed(mask: Mask, places: Array, named: Array) -> Array:
    """Which share of the leader lines from the places to what they name is drawn upon, (C,)."""
    along = np.linspace(0.0, 1.0, 40)[:, None]
    length = np.linalg.norm(places - named, axis=1)
    points = (named + along[..., None] * (places - named)) / STEP  # (40, C, 2)
    column, row = np.rint(points).astype(int).transpose(2, 0, 1)
    row, column = np.minimum(row, mask.shape[0] - 1), np.minimum(column, mask.shape[1] - 1)
    between = (along * length > RADIUS) & ((1 - along) * length > RADIUS)
    return np.asarray(((mask[row, column] > 0) & between).mean(axis=0))


def draw_leaders(image: Image, centers: Array, targets: Array, colors: Sequence[Color]) -> None:
    """Draws a line from each disc to what it names; the disc, drawn later, covers its beginning."""
    for center, target, color in zip(centers, targets, colors, strict=True):
        draw_outlined(image, np.stack([center, target])[None], color, LEADER)


def draw_disc(image: Image, center: Array, label: str, color: Color) -> None:
    """Draws one disc: a dark ring, a white ring, the colour, and the label on it."""
    import cv2

    u, v = np.rint(center).astype(int).tolist()
    for inset, ink in ((0, OUTLINE_COLOR), (2, (255, 255, 255)), (4, color)):
        cv2.circle(image, (u, v), RADIUS - inset, ink, cv2.FILLED, cv2.LINE_AA)
    font = cv2.FONT_HERSHEY_DUPLEX
    room = 2 * (RADIUS - 4) - 6  # [pixel] for the width of the label
    (width, _), _ = cv2.getTextSize(label, font, TEXT, 1)
    scale = TEXT * min(1.0, room / max(width, 1))
    (width, height), _ = cv2.getTextSize(label, font, scale, 1)
    origin = (round(u - width / 2), round(v + height / 2))
    cv2.putText(image, label, origin, font, scale, text_color(color), 1, cv2.LINE_AA)


def text_color(ground: Color) -> Color:
    """Returns black or white, whichever is better read on ``ground``."""
    black, white = (0, 0, 0), (255, 255, 255)
    return max((black, white), key=lambda ink: contrast(ink, ground))


def contrast(a: Color, b: Color) -> float:
    """Returns the contrast ratio of two colours, from 1 to 21 (WCAG 2.2, 1.4.3)."""
    brighter, darker = sorted((_luminance(a), _luminance(b)), reverse=True)
    return (brighter + 0.05) / (darker + 0.05)


def _luminance(color: Color) -> float:
    """The relative luminance of an sRGB colour, from 0 to 1 (WCAG 2.2)."""
    c = np.array(color) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
