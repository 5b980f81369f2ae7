"""Marks on images: grasps as the outline of the hand, depth as colour.

The hand is drawn as a U with a stem, true to size, as it is when it has closed: the arms of the U
run along the middle of the fingers, half a finger's thickness outside the faces that touch, and end
at the finger tips; the stem ends at the origin of the hand body H. So a finger is seen at either
side of the object. (Along the faces it would lie on the object's edge, and as wide open as the hand
arrives it would reach over things beside the object.)
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tog_drake.panda import FINGER_THICKNESS, FINGERTIP_Z, GRASP_Z, PALM_Z
from tog_drake.pinhole import project
from tog_drake.values import Array, Candidates, Choice, Grasps, View
from tog_drake.visibility import shown_in

Image = NDArray[np.uint8]  # (H, W, 3), RGB

CANDIDATE_COLORS: tuple[tuple[str, tuple[int, int, int]], ...] = (
    ("red", (230, 25, 35)),
    ("green", (30, 185, 60)),
    ("blue", (40, 95, 255)),
    ("yellow", (255, 225, 25)),
    ("cyan", (30, 225, 245)),
    ("magenta", (240, 40, 230)),
    ("orange", (255, 135, 20)),
    ("purple", (135, 40, 190)),
    ("pink", (255, 175, 200)),
    ("lime", (170, 255, 60)),
    ("brown", (150, 90, 45)),
    ("white", (255, 255, 255)),
)
"""Name and RGB of the candidates, in order: what is drawn and what a model is told agree."""

FAINT_COLOR = (235, 235, 235)  # grasps that are not candidates
HOLE_COLOR = (225, 60, 125)  # pixels without depth: viridis has no red
OUTLINE_COLOR = (15, 15, 15)
NEAR = 0.02  # [m] along z of C; lines are cut off here, before they reach the camera


def candidate_color_name(rank: int) -> str:
    """Returns what the colour of candidate ``rank`` is called."""
    return CANDIDATE_COLORS[rank % len(CANDIDATE_COLORS)][0]


def candidate_color(rank: int) -> tuple[int, int, int]:
    """Returns the RGB of candidate ``rank`` (0 is the best); after white it starts over."""
    return CANDIDATE_COLORS[rank % len(CANDIDATE_COLORS)][1]


def choice_color(candidates: Candidates | None, choice: Choice) -> tuple[int, int, int]:
    """Returns the RGB of the candidate that was chosen, or white: any grasp may be chosen."""
    if candidates is None or choice.index not in candidates.index:
        return (255, 255, 255)
    return candidate_color(int(np.flatnonzero(candidates.index == choice.index)[0]))


def hand_wireframe(grasps: Grasps) -> Array:
    """Returns the hands as line segments in W: finger at −y, palm, finger at +y, stem.

    Returns:
        (N, 4, 2, 3) [m]: for each grasp and segment its two ends.
    """
    p_GEnds = np.zeros((len(grasps), 4, 2, 3))
    half = (grasps.width[:, None] + FINGER_THICKNESS) / 2
    p_GEnds[:, 0, :, 1] = -half
    p_GEnds[:, 1, :, 1] = half * [-1, 1]
    p_GEnds[:, 2, :, 1] = half
    p_GEnds[:, :, :, 2] = PALM_Z
    p_GEnds[:, [0, 2], [0, 1], 2] = FINGERTIP_Z
    p_GEnds[:, 3, 1, 2] = -GRASP_Z
    R_WG, p_WG = grasps.X_WG[:, :3, :3], grasps.X_WG[:, :3, 3]
    return np.asarray(np.einsum("nij,nsej->nsei", R_WG, p_GEnds) + p_WG[:, None, None, :])


def project_segments(p_WEnds: Array, view: View) -> Array:
    """Projects line segments into the image; what lies behind the camera is cut off.

    Args:
        p_WEnds: (M, 2, 3) [m] the ends of each segment in W.

    Returns:
        (M, 2, 2) [pixel]: u, v of the ends; NaN for a segment wholly behind the camera.
    """
    R_WC, p_WC = view.X_WC[:3, :3], view.X_WC[:3, 3]
    z = (p_WEnds - p_WC) @ R_WC[:, 2]  # (M, 2) depth of the ends in C
    visible = (z > NEAR).any(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.clip((NEAR - z) / (z[:, ::-1] - z), 0.0, 1.0)  # where each end meets the near plane
    s = np.where(z < NEAR, s, 0.0)[..., None]
    clipped = p_WEnds + np.nan_to_num(s) * (p_WEnds[:, ::-1] - p_WEnds)
    pixels = np.full((len(p_WEnds), 2, 2), np.nan)
    ends = clipped[visible].reshape(-1, 3)
    pixels[visible] = project(ends, view.intrinsics, view.X_WC).reshape(-1, 2, 2)
    return pixels


def mark_scale(width: int, height: int) -> float:
    """Returns by how much marks grow in an image of this size [pixel]: 1 at 640×480 and below."""
    return max(1.0, min(width, height) / 480)


def draw_grasps(
    view: View,
    grasps: Grasps,
    colors: ArrayLike,
    *,
    thickness: float = 2.0,
    opacity: float = 1.0,
    contacts: bool = False,
    hidden_dashed: bool = False,
) -> Image:
    """Draws grasps on the colour image of ``view``, the best on top.

    To draw in layers, give the result back: ``replace(view, rgb=draw_grasps(...))``.

    Args:
        colors: one RGB for all, (3,), or one for each grasp, (N, 3).
        thickness: of a line [pixel] in an image of 640×480; it grows with the image.
        opacity: 0 leaves the image as it is, 1 covers it.
        contacts: whether to mark the contact points with a dot.
        hidden_dashed: whether a hand is dashed where the view sees none of its contacts.

    Returns:
        A new image, (H, W, 3) uint8.
    """
    import cv2

    scale = mark_scale(view.rgb.shape[1], view.rgb.shape[0])
    pixels = project_segments(hand_wireframe(grasps).reshape(-1, 2, 3), view)
    rgb = np.broadcast_to(np.asarray(colors), (len(grasps), 3)).tolist()
    image = np.ascontiguousarray(view.rgb).copy()
    stroke = thickness * scale
    solid = shown_in(grasps, view) if hidden_dashed else np.ones(len(grasps), bool)
    for i, lines in reversed(list(enumerate(pixels.reshape(-1, 4, 2, 2)))):
        if not solid[i]:
            lines = np.concatenate([dashed(line, stroke) for line in lines])
        draw_outlined(image, lines, rgb[i], stroke)
    if contacts and len(grasps):
        dots = np.repeat(grasps.p_WContact[:, None], 2, axis=1)
        for (center, _), color in zip(project_segments(dots, view)[::-1], rgb[::-1], strict=True):
            draw_dot(image, center, color, 2.0 * thickness * scale)
    if opacity == 1.0:
        return image
    return np.asarray(cv2.addWeighted(image, opacity, view.rgb, 1.0 - opacity, 0.0), np.uint8)


def decision_image(
    view: View, candidates: Candidates | None = None, choice: Choice | None = None
) -> Image:
    """Draws what was decided: all grasps faint, candidates in their colours, the choice bold.

    Of candidates and the choice, the hands whose place the view does not show are dashed.

    Where a model pointed there is a cross, an upright one at the place to grasp. What is None,
    because its stage failed, is left out.
    """
    if candidates is not None:
        K = len(candidates)
        colors = np.array([candidate_color(rank) for rank in range(K)]).reshape(K, 3)
        faint = draw_grasps(view, candidates.grasps, FAINT_COLOR, thickness=1.0, opacity=0.15)
        view = replace(view, rgb=faint)
        shown = candidates.grasps.take(candidates.index)
        view = replace(view, rgb=draw_grasps(view, shown, colors, hidden_dashed=True))
    if choice is not None:
        color = choice_color(candidates, choice)
        bold = draw_grasps(
            view, choice.grasp, color, thickness=4.0, contacts=True, hidden_dashed=True
        )
        for role, pixel in choice.pointed.items():
            _draw_cross(bold, np.array(pixel), upright=role == "grasp")
        view = replace(view, rgb=bold)
    return view.rgb


def _draw_cross(image: Image, center: Array, *, upright: bool) -> None:
    """Draws a cross around (2,) [pixel], upright or tilted by 45°; a contact's dot fits into it.

    It is black with a white rim: nothing else here is.
    """
    scale = max(1.0, min(image.shape[1] / 640, image.shape[0] / 480))
    arms = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    if not upright:
        arms = arms @ (np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2.0))
    lines = center + scale * arms[:, None, :] * np.array([10.0, 24.0])[:, None]
    draw_outlined(image, lines, (255, 255, 255), 6.0 * scale)
    draw_outlined(image, lines, OUTLINE_COLOR, scale)


def depth_range(depth: NDArray[np.float32]) -> tuple[float, float] | None:
    """Returns the near and far ends [m] of the colours of ``depth_image``; None if all holes.

    They are the 1st and 99th percentile, so that a few stray pixels do not flatten the picture.
    """
    seen = depth[np.isfinite(depth) & (depth > 0)]
    if not len(seen):
        return None
    near, far = np.percentile(seen, [1, 99])
    return float(near), float(far)


def depth_image(depth: NDArray[np.float32]) -> Image:
    """Shows depth as colour: near is bright, far is dark (viridis), holes are ``HOLE_COLOR``.

    Args:
        depth: (H, W) [m]; 0, NaN and inf are holes.

    Returns:
        (H, W, 3) uint8.
    """
    import cv2

    hole = ~(np.isfinite(depth) & (depth > 0))
    near, far = depth_range(depth) or (0.0, 1.0)
    share = (far - np.where(hole, far, depth)) / max(far - near, 1e-6)
    gray = (255 * np.clip(share, 0.0, 1.0)).round().astype(np.uint8)
    image = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)
    image[hole] = HOLE_COLOR
    return np.asarray(image, dtype=np.uint8)


def encode_png(rgb: Image, *, compression: int = 1) -> bytes:
    """Returns the image as a PNG file; ``compression`` is from 1, fast, to 9, small."""
    import cv2

    options = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes()


def encode_jpg(rgb: Image) -> bytes:
    """Returns the image as a JPEG file."""
    import cv2

    return cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


_SHIFT = 4  # cv2 takes pixels as integers in units of 2^-4: lines keep their subpixel place


def draw_outlined(image: Image, lines: Array, color: Sequence[int], thickness: float) -> None:
    """Draws (S, 2, 2) lines [pixel] into ``image``, over a dark rim that sets them off.

    Lines with an end that is NaN are left out.
    """
    import cv2

    lines = lines[np.isfinite(lines).all(axis=(1, 2))]
    ends = np.round(lines * 2**_SHIFT).astype(np.int32)
    rim = max(1.0, 0.4 * thickness)
    for stroke, ink in ((thickness + 2 * rim, OUTLINE_COLOR), (thickness, color)):
        cv2.polylines(image, ends, False, ink, max(1, round(stroke)), cv2.LINE_AA, _SHIFT)


def dashed(line: Array, thickness: float) -> Array:
    """Cuts a line (2, 2) [pixel] into dashes (D, 2, 2) with gaps as long, a dash at either end."""
    if not np.isfinite(line).all():
        return np.zeros((0, 2, 2))
    length = float(np.linalg.norm(line[1] - line[0]))
    count = max(2, round(length / (7 * thickness)))
    ends = (2 * np.arange(count)[:, None] + [0.1, 0.9]) / (2 * count - 1)  # (D, 2), from 0 to 1
    return np.asarray(line[0] + ends[..., None] * (line[1] - line[0]))


def draw_dot(image: Image, center: Array, color: Sequence[int], radius: float) -> None:
    """Draws a dot at (2,) [pixel] into ``image``, in a white and a dark ring; nothing at NaN."""
    import cv2

    if not np.isfinite(center).all():
        return
    u, v = np.round(center * 2**_SHIFT).astype(int).tolist()
    rings = ((1.0, OUTLINE_COLOR), (0.86, (255, 255, 255)), (0.64, OUTLINE_COLOR), (0.56, color))
    for share, ink in rings:
        size = round(share * radius * 2**_SHIFT)
        cv2.circle(image, (u, v), size, ink, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def draw_ring(image: Image, center: Array, color: Sequence[int], radius: float) -> None:
    """Draws a dashed ring at (2,) [pixel] into ``image``, as large as ``draw_dot``'s dot.

    What is within shows through; nothing is drawn at NaN.
    """
    import cv2

    if not np.isfinite(center).all():
        return
    u, v = np.round(center * 2**_SHIFT).astype(int).tolist()
    size = round(0.85 * radius * 2**_SHIFT)
    thickness = max(2, round(0.3 * radius))
    for stroke, ink in ((thickness + 2, OUTLINE_COLOR), (thickness, color)):
        for start in range(0, 360, 90):
            arc = (start + 10, start + 60) if ink is color else (start + 6, start + 64)
            cv2.ellipse(image, (u, v), (size, size), 0, *arc, ink, stroke, cv2.LINE_AA, _SHIFT)
