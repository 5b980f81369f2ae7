"""What a model is shown: the view or a part of it, with the candidates marked.

Two renderings. ``paper`` is the one published: the whole image at its own size, candidates told
apart by colour alone. ``marked`` shows the part of the image where the things are, enlarged, and
puts a numbered disc in the candidate's colour beside each candidate (see ``discs``).

Hands are drawn as in all pictures here (see ``drawing``): closed, so that the U holds just what the
grasp would hold. Marks that would hide others let them be seen: a finger beneath another hand is
drawn on top once more as dashes, a dot beneath another is larger.

What the view does not show is not drawn as if it did (see ``visibility.mark_states``): the hand of
a grasp whose contacts are hidden is dashed, its dot is a dashed ring, and a mark whose place is
outside the view is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from tog_drake.drawing import (
    Image,
    dashed,
    draw_dot,
    draw_outlined,
    draw_ring,
    hand_wireframe,
    mark_scale,
    project_segments,
)
from tog_drake.pinhole import project
from tog_drake.selectors.discs import Color, draw_disc, draw_leaders, place_discs
from tog_drake.values import Array, Grasps, View
from tog_drake.visibility import MarkState, mark_states

Rendering = Literal["marked", "paper"]

TILE = 224  # [pixel] the sides of a ``marked`` picture are whole multiples of it
CANVASES = ((3, 3), (4, 3), (3, 4), (5, 3), (3, 5), (6, 3), (3, 6))
"""Width and height of a ``marked`` picture in tiles.

Multiples of 224 are multiples of the patches of all models known (28 and 32 pixels); with a short
side of 672 (below the 768 of OpenAI's tiled models) and a long one of at most 1344 (below the 1568
of Claude, whose limit of 1568 patches holds too) no provider resizes them, so that a pixel that a
model names is a pixel of the picture.
"""
MIN_CROP = 48  # [pixel] of the view per tile at least: no pixel is enlarged more than 4.7 times
PADDING = 0.06  # of the things' extent, at each side
BESIDE = (128, 128, 128)  # where the picture reaches beyond the view

LINE = 2.0  # [pixel] thickness of a hand's lines in a picture of 640×480; it grows with the picture
DOT = 8.0  # [pixel] radius of a contact's dot in the same
BENEATH = 2.4  # how much larger a dot is drawn for each that lies on it


@dataclass(frozen=True)
class Mark:
    """How a candidate is told from the others."""

    label: str  # on its disc, where there is one: short, such as "7"
    color: Color  # RGB


@dataclass(frozen=True)
class Framing:
    """Which part of a view a picture shows, and how large. Pixel centres lie at whole numbers."""

    corner: tuple[
        int, int
    ]  # u, v of the view's pixel at the upper left; it may lie beside the view
    crop: tuple[int, int]  # [pixel] width and height of the part of the view
    size: tuple[int, int]  # [pixel] width and height of the picture, in the crop's ratio
    things: Array = field(default_factory=lambda: np.zeros((0, 2)), compare=False, repr=False)
    """(N, 2) pixels of the view in which discs would hide what is looked at."""

    @property
    def scale(self) -> float:
        """How many pixels of the picture a pixel of the view is wide."""
        return self.size[0] / self.crop[0]

    def from_view(self, pixel: ArrayLike) -> Array:
        """Returns where pixels (..., 2) of the view are in the picture."""
        return (np.asarray(pixel, np.float64) - self.corner + 0.5) * self.scale - 0.5

    def to_view(self, pixel: ArrayLike) -> Array:
        """Returns where pixels (..., 2) of the picture are in the view."""
        return (np.asarray(pixel, np.float64) + 0.5) / self.scale - 0.5 + self.corner


def whole_image(view: View) -> Framing:
    """Frames all of the view at its own size: what ``paper`` shows."""
    height, width = view.rgb.shape[:2]
    return Framing((0, 0), (width, height), (width, height))


def frame_things(view: View, p_W: Array, grasps: Grasps) -> Framing:
    """Frames the things and the hands that would grasp them: what ``marked`` shows.

    Stems may be cut off. Hands may reach beyond the view, by half of it at most: a U that is cut
    open tells nothing. The canvas is the one that the rest fills best.

    Args:
        p_W: (N, 3) [m] the cloud.
        grasps: whatever may be drawn.
    """
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    things = project(p_W, view.intrinsics, view.X_WC)
    fingers_and_palm = hand_wireframe(grasps)[:, :3].reshape(-1, 2, 3)
    hands = project_segments(fingers_and_palm, view).reshape(-1, 2)
    contacts = project(grasps.p_WContact, view.intrinsics, view.X_WC)
    hands = np.clip(np.vstack([hands, contacts]), -size / 2, 1.5 * size)
    shown = np.vstack([np.clip(things, -0.5, size - 0.5), hands])
    shown = shown[np.isfinite(shown).all(axis=1)]
    if len(shown) == 0:
        shown = np.array([[-0.5, -0.5], size - 0.5])
    lower, upper = shown.min(axis=0), shown.max(axis=0)
    padding = PADDING * (upper - lower)
    canvas, per_tile = _canvas(upper - lower + 2 * padding, upright=bool(size[1] > size[0]))
    crop = per_tile * np.array(canvas)
    # Centred on all that, but moved into the view as far as it can be without cutting a hand.
    centred = np.rint((lower + upper + 1 - crop) / 2).astype(int)
    corner = np.where(crop < size, np.clip(centred, 0, size - crop), (size - crop) // 2)
    first = np.where(lower < -0.5, lower - padding, lower)
    last = np.where(upper > size - 0.5, upper + padding, upper)
    corner = np.clip(corner, np.ceil(last + 0.5 - crop), np.floor(first + 0.5)).astype(int)
    return Framing(
        corner=(int(corner[0]), int(corner[1])),
        crop=(int(crop[0]), int(crop[1])),
        size=(TILE * canvas[0], TILE * canvas[1]),
        things=things[np.isfinite(things).all(axis=1)],
    )


def _canvas(extent: Array, *, upright: bool) -> tuple[tuple[int, int], int]:
    """Returns the canvas that (2,) [pixel] of the view fill best, and how many of them a tile of it
    must show."""

    def per_tile(canvas: tuple[int, int]) -> int:
        return max(MIN_CROP, int(np.ceil(np.max(extent / canvas))))

    def emptiness(canvas: tuple[int, int]) -> tuple[float, bool]:
        """How much of the view it would show, and then whether it is turned."""
        return per_tile(canvas) ** 2 * canvas[0] * canvas[1], (canvas[1] > canvas[0]) != upright

    best = min(CANVASES, key=emptiness)
    return best, per_tile(best)


def plain(view: View, framing: Framing) -> Image:
    """Returns the picture without marks."""
    import cv2

    height, width = view.rgb.shape[:2]
    (left, top), (across, down) = framing.corner, framing.crop
    inside = view.rgb[max(top, 0) : top + down, max(left, 0) : left + across]
    beyond = (
        max(-top, 0),
        max(top + down - height, 0),
        max(-left, 0),
        max(left + across - width, 0),
    )
    crop = cv2.copyMakeBorder(inside, *beyond, cv2.BORDER_CONSTANT, value=BESIDE)
    if framing.size == framing.crop:
        return np.asarray(crop, np.uint8).copy()
    method = cv2.INTER_CUBIC if framing.scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(crop, framing.size, interpolation=method), np.uint8)


def draw_grippers(
    view: View, framing: Framing, grasps: Grasps, marks: Sequence[Mark], rendering: Rendering
) -> Image:
    """Draws the hands of grasps, the nearest to the camera on top.

    Args:
        framing: as of ``plain``, to which it can be compared pixel by pixel.
        grasps: N of them.
        marks: one for each.
        rendering: ``marked`` adds the discs.

    Raises:
        InputError: there is no room for so many discs.
    """
    grasps, marks, states = _drawn(view, grasps, marks, dots=False)
    segments = project_segments(hand_wireframe(grasps).reshape(-1, 2, 3), view)
    hands = framing.from_view(segments).reshape(-1, 4, 2, 2)
    image = plain(view, framing)
    thickness = LINE * mark_scale(*framing.size)
    centers = np.zeros((0, 2))
    if rendering == "marked":
        centers, named = place_discs(
            framing.size,
            _unmistakable(hands, framing.size, apart=4 * thickness),
            lines=hands[:, :3].reshape(-1, 2, 2),
            stems=hands[:, 3],
            things=framing.from_view(framing.things),
            thickness=2 * thickness,
        )
        draw_leaders(image, centers, named, [mark.color for mark in marks])
    distance = np.linalg.norm(grasps.X_WG[:, :3, 3] - view.X_WC[:3, 3], axis=1)
    order = np.argsort(-distance, kind="stable")
    for i in order:
        lines = hands[i]
        if states[i] == "dashed":
            lines = np.concatenate([dashed(line, thickness) for line in lines])
        draw_outlined(image, lines, marks[i].color, thickness)
    solid = np.array([i for i in order if states[i] == "shown"], np.int64)
    _draw_hidden(image, hands[solid], [marks[i] for i in solid], thickness)
    for center, mark in zip(centers, marks, strict=False):
        draw_disc(image, center, mark.label, mark.color)
    return image


def draw_contacts(
    view: View, framing: Framing, grasps: Grasps, marks: Sequence[Mark], rendering: Rendering
) -> Image:
    """Draws the contact points of grasps as dots; the arguments are those of ``draw_grippers``."""
    grasps, marks, states = _drawn(view, grasps, marks, dots=True)
    contacts = framing.from_view(project(grasps.p_WContact, view.intrinsics, view.X_WC))
    image = plain(view, framing)
    least = DOT * mark_scale(*framing.size)
    apart = np.linalg.norm(contacts[:, None] - contacts, axis=2)
    above = np.count_nonzero(np.tril(apart < least, -1), axis=1)  # dots that lie on each
    radius = least * BENEATH**above
    centers = np.zeros((0, 2))
    if rendering == "marked":
        centers, named = place_discs(
            framing.size,
            contacts[:, None],
            lines=np.repeat(contacts[:, None], 2, axis=1),
            stems=None,
            things=framing.from_view(framing.things),
            thickness=2 * float(radius.max(initial=0.0)),
        )
        draw_leaders(image, centers, named, [mark.color for mark in marks])
    for i in range(len(grasps))[::-1]:
        draw = draw_ring if states[i] == "dashed" else draw_dot
        draw(image, contacts[i], marks[i].color, radius[i])
    for center, mark in zip(centers, marks, strict=False):
        draw_disc(image, center, mark.label, mark.color)
    return image


def _drawn(
    view: View, grasps: Grasps, marks: Sequence[Mark], *, dots: bool
) -> tuple[Grasps, Sequence[Mark], list[MarkState]]:
    """Returns the grasps that are not dropped, their marks and states."""
    states = mark_states(grasps, view, dots=dots)
    rows = [i for i, state in enumerate(states) if state != "dropped"]
    kept = grasps.take(np.array(rows, np.int64))
    return kept, [marks[i] for i in rows], [states[i] for i in rows]


def _unmistakable(hands: Array, size: tuple[int, int], apart: float) -> Array:
    """Returns the points of each hand that its disc may name, (N, A, 2), the best first.

    They lie on the stem, from its end on, and then on the palm; on the fingers only where neither
    is in the picture. Those nearer than ``apart`` [pixel] to another hand are NaN if there are
    others in the picture: a leader there could mean either. Of a hand wholly out of the picture
    all points are returned.
    """
    points = np.concatenate(
        [
            hands[:, segment, :1] + share[:, None] * np.diff(hands[:, segment], axis=1)
            for segment, share in (
                (3, np.linspace(1.0, 0.1, 8)),
                (1, np.array([0.25, 0.75, 0.1, 0.9])),
                (0, np.linspace(0.0, 1.0, 8)),
                (2, np.linspace(0.0, 1.0, 8)),
            )
        ],
        axis=1,
    )
    on_finger = np.arange(points.shape[1]) >= 12
    start, way = hands[:, :, 0], hands[:, :, 1] - hands[:, :, 0]  # (N, 4, 2)
    to_point = points[:, :, None, None] - start  # (N, A, N, 4, 2)
    length = np.maximum(np.sum(way**2, axis=-1), 1e-9)
    share = np.clip(np.sum(to_point * way, axis=-1) / length, 0.0, 1.0)
    distance = np.linalg.norm(to_point - share[..., None] * way, axis=-1).min(axis=3)  # (N, A, N)
    near_another = ((distance < apart) & ~np.eye(len(hands), dtype=bool)[:, None]).any(axis=2)
    inside = np.all((points >= 0) & (points <= np.array(size) - 1), axis=2)
    clear = inside & ~near_another
    kept = np.ones_like(inside)
    for better in (inside, clear, inside & ~on_finger, clear & ~on_finger):
        kept = np.where(better.any(axis=1, keepdims=True), better, kept)
    points[~kept] = np.nan
    return points


def _draw_hidden(image: Image, hands: Array, marks: Sequence[Mark], thickness: float) -> None:
    """Draws the fingers of hands (N, 4, 2, 2) that others hide once more, as dashes."""
    hidden = [
        ([hand[f] for f in (0, 2) if _is_hidden(image, hand[f], mark)], mark.color)
        for hand, mark in zip(hands, marks, strict=True)
    ]
    for n, (fingers, color) in enumerate(pair for pair in hidden if pair[0]):
        for finger in fingers:
            draw_outlined(image, _dashes(finger, thickness, n), color, thickness)


def _is_hidden(image: Image, line: Array, mark: Mark) -> bool:
    """Tells whether less than half of a line (2, 2) that was drawn is still to be seen."""
    points = np.rint(line[0] + np.linspace(0.0, 1.0, 40)[:, None] * (line[1] - line[0]))
    inside = np.all((points >= 0) & (points < image.shape[1::-1]), axis=1)  # False where NaN
    u, v = points[inside].astype(int).T
    seen = np.abs(image[v, u].astype(int) - mark.color).max(axis=1) < 16
    return bool(inside.any() and seen.mean() < 0.5)


def _dashes(line: Array, thickness: float, n: int) -> Array:
    """Cuts a line (2, 2) into dashes (D, 2, 2); those of an odd ``n`` lie between the others."""
    count = max(1, round(float(np.linalg.norm(line[1] - line[0])) / (14 * thickness)))
    start = 0.1 + 0.5 * (n % 2)
    ends = (np.arange(count)[:, None] + [start, start + 0.18]) / count  # (D, 2), from 0 to 1
    return np.asarray(line[0] + ends[..., None] * (line[1] - line[0]))
