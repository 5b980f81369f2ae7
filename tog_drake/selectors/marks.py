"""What a model is shown: the view or a part of it, with the candidates marked.

Two renderings. ``paper`` is the one published: the whole image at its own size, candidates told
apart by colour alone. ``marked`` shows the part of the image where the things are, enlarged, and
puts a numbered disc in the candidate's colour beside each candidate (see ``disc_placement``).

A hand is drawn as in all pictures here (``drawing.hand_wireframe``): its fingers lie where they
touch, so that the U holds just what the grasp would hold.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from tog_drake.drawing import (
    OUTLINE_COLOR,
    Image,
    draw_dot,
    draw_outlined,
    hand_wireframe,
    mark_scale,
    project_segments,
)
from tog_drake.pinhole import project
from tog_drake.selectors.disc_placement import place_discs
from tog_drake.values import Array, Grasps, View

Rendering = Literal["marked", "paper"]
Color = tuple[int, int, int]

TILE = 224  # [pixel] the sides of a ``marked`` picture are whole multiples of it
CANVASES = ((4, 3), (3, 4), (5, 3), (3, 5), (6, 3), (3, 6))
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
DOT = 7.0  # [pixel] radius of a contact's dot in the same
DISC = 18  # [pixel] radius of a disc in a ``marked`` picture, rings included
LEADER = 1.5  # [pixel] thickness of the line from a disc to what it names
TEXT = 0.8  # height of a disc's number in units of cv2, where it fits


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

    What lies beside the image does not count. The canvas is the one that the rest fills best.

    Args:
        p_W: (N, 3) [m] the cloud.
        grasps: whatever may be drawn.
    """
    things = project(p_W, view.intrinsics, view.X_WC)
    hands = project_segments(hand_wireframe(grasps).reshape(-1, 2, 3), view).reshape(-1, 2)
    contacts = project(grasps.p_WContact, view.intrinsics, view.X_WC)
    size = np.array([view.intrinsics.width, view.intrinsics.height])
    shown = np.clip(np.vstack([things, hands, contacts]), -0.5, size - 0.5)
    shown = shown[np.isfinite(shown).all(axis=1)]
    if len(shown) == 0:
        shown = np.array([[-0.5, -0.5], size - 0.5])
    lower, upper = shown.min(axis=0), shown.max(axis=0)
    extent = (1 + 2 * PADDING) * (upper - lower)
    upright = bool(size[1] > size[0])

    def per_tile(canvas: tuple[int, int]) -> int:
        """How many pixels of the view a tile must show."""
        return max(MIN_CROP, int(np.ceil(np.max(extent / canvas))))

    def emptiness(canvas: tuple[int, int]) -> tuple[float, bool]:
        """How much of the view it would show, and then whether it is turned."""
        return per_tile(canvas) ** 2 * canvas[0] * canvas[1], (canvas[1] > canvas[0]) != upright

    canvas = min(CANVASES, key=emptiness)
    crop = per_tile(canvas) * np.array(canvas)
    # Centred on the things, but moved into the image where it can be.
    corner = np.rint((lower + upper + 1 - crop) / 2).astype(int)
    corner = np.where(crop < size, np.clip(corner, 0, size - crop), (size - crop) // 2)
    return Framing(
        corner=(int(corner[0]), int(corner[1])),
        crop=(int(crop[0]), int(crop[1])),
        size=(TILE * canvas[0], TILE * canvas[1]),
        things=things[np.isfinite(things).all(axis=1)],
    )


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
    hands = framing.from_view(
        project_segments(hand_wireframe(grasps).reshape(-1, 2, 3), view)
    ).reshape(-1, 4, 2, 2)
    image = plain(view, framing)
    thickness = LINE * mark_scale(*framing.size)
    discs = None
    if rendering == "marked":
        stem = hands[:, 3, :1] + np.linspace(1, 0, 9)[:, None] * np.diff(hands[:, 3], axis=1)
        discs = _Discs.placed(framing, stem, hands[:, [0, 2]], hands[:, [1, 3]])
        discs.draw_leaders(image, marks)
    distance = np.linalg.norm(grasps.X_WG[:, :3, 3] - view.X_WC[:3, 3], axis=1)
    for i in np.argsort(-distance, kind="stable"):
        draw_outlined(image, hands[i], marks[i].color, thickness)
    if discs is not None:
        discs.draw(image, marks)
    return image


def draw_contacts(
    view: View, framing: Framing, grasps: Grasps, marks: Sequence[Mark], rendering: Rendering
) -> Image:
    """Draws the contact points of grasps as dots; the arguments are those of ``draw_grippers``."""
    contacts = framing.from_view(project(grasps.p_WContact, view.intrinsics, view.X_WC))
    image = plain(view, framing)
    discs = None
    if rendering == "marked":
        dots = np.repeat(contacts[:, None, None], 2, axis=2)
        discs = _Discs.placed(framing, contacts[:, None], dots, np.zeros((0, 2, 2)))
        discs.draw_leaders(image, marks)
    for contact, mark in zip(contacts[::-1], marks[::-1], strict=True):
        draw_dot(image, contact, mark.color, DOT * mark_scale(*framing.size))
    if discs is not None:
        discs.draw(image, marks)
    return image


@dataclass(frozen=True)
class _Discs:
    """The numbered discs of a picture."""

    center: Array  # (N, 2) [pixel]
    named: Array  # (N, 2) [pixel] the point that each leader line leads to

    @staticmethod
    def placed(framing: Framing, anchors: Array, strokes: Array, outlines: Array) -> "_Discs":
        center, named = place_discs(
            framing.size,
            DISC,
            anchors,
            strokes=strokes.reshape(-1, 2, 2),
            outlines=outlines.reshape(-1, 2, 2),
            things=framing.from_view(framing.things),
            thickness=DOT * mark_scale(*framing.size),
        )
        return _Discs(center, named)

    def draw_leaders(self, image: Image, marks: Sequence[Mark]) -> None:
        for center, named, mark in zip(self.center, self.named, marks, strict=True):
            draw_outlined(image, np.stack([center, named])[None], mark.color, LEADER)

    def draw(self, image: Image, marks: Sequence[Mark]) -> None:
        for center, mark in zip(self.center, marks, strict=True):
            _draw_disc(image, center, mark)


def _draw_disc(image: Image, center: Array, mark: Mark) -> None:
    """Draws one disc: dark ring, white ring, the colour, and on it the label."""
    import cv2

    u, v = np.rint(center).astype(int).tolist()
    for inset, ink in ((0, OUTLINE_COLOR), (2, (255, 255, 255)), (4, mark.color)):
        cv2.circle(image, (u, v), DISC - inset, ink, cv2.FILLED, cv2.LINE_AA)
    room = 2 * (DISC - 4) - 6  # [pixel] the width of the text
    scale = TEXT
    (width, height), _ = cv2.getTextSize(mark.label, cv2.FONT_HERSHEY_DUPLEX, scale, 1)
    if width > room:
        scale *= room / width
        (width, height), _ = cv2.getTextSize(mark.label, cv2.FONT_HERSHEY_DUPLEX, scale, 1)
    origin = (round(u - width / 2), round(v + height / 2))
    ink = text_color(mark.color)
    cv2.putText(image, mark.label, origin, cv2.FONT_HERSHEY_DUPLEX, scale, ink, 1, cv2.LINE_AA)


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
