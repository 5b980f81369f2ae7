"""A vision-language model made of classical vision: it answers by looking at what it is sent.

It stands where a provider would, behind ``vlm_server``, and checks that what a selector sends can
be understood: it gets the text and the pictures of a question and knows neither the simulation nor
how the marks are drawn. It knows hammers (a yellow handle with a black grip, a grey head), names
of colours, digits, and what tasks ask for. What it cannot make out it says in words, which is no
answer.
"""

import json
import re
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # (H, W, 3) RGB
Mask = NDArray[np.bool_]  # (H, W)

# Hue [degree], saturation and value, least and greatest, of what people call by these names.
COLORS: Mapping[str, tuple[tuple[int, int], tuple[float, float], tuple[float, float]]] = {
    "red": ((345, 12), (0.65, 1.0), (0.6, 1.0)),
    "orange": ((15, 40), (0.8, 1.0), (0.85, 1.0)),
    "brown": ((15, 40), (0.6, 1.0), (0.35, 0.7)),
    "yellow": ((49, 64), (0.6, 1.0), (0.9, 1.0)),
    "lime": ((68, 100), (0.5, 1.0), (0.85, 1.0)),
    "green": ((105, 160), (0.5, 1.0), (0.5, 0.9)),
    "cyan": ((170, 198), (0.5, 1.0), (0.7, 1.0)),
    "blue": ((205, 245), (0.5, 1.0), (0.6, 1.0)),
    "purple": ((260, 288), (0.5, 1.0), (0.4, 0.85)),
    "magenta": ((290, 325), (0.65, 1.0), (0.7, 1.0)),
    "pink": ((315, 360), (0.15, 0.6), (0.85, 1.0)),
}
FAMILIES = {
    # Order and scale of a point (None: pixels), how it is written, and what the question must say.
    "pixels": ("xy", None, '{{"x": {0}, "y": {1}, "label": "{role}"}}', r"in pixels of it, x to"),
    "gemini": ("yx", 1000, '{{"point": [{0}, {1}], "label": "{role}"}}', r"\[y, x\] .* 0-1000"),
    "qwen3-vl": ("xy", 1000, '{{"point_2d": [{0}, {1}], "label": "{role}"}}', r"from 0 to 1000, x"),
    "molmo": ("xy", 100, '<point x="{0}" y="{1}" alt="{role}">{role}</point>', r"Point to"),
    "molmo2": ("xy", 1000, '<points coords="1 1 {0:03d} {1:03d}">{role}</points>', r"Point to"),
}
INK = 12  # [pixel] of one flat colour at least make a mark
LEAST_PART = 50  # [pixel]
CHANGED = 20  # of a channel, where a mark was drawn over the reference
RIM = 8  # [pixel] around the flat colour of a mark
GAP = 12  # [pixel] a line goes on after being crossed by others


class CannotSee(Exception):
    """What was asked is not in the pictures, or not to be made out."""


def see_and_answer(text: str, images: Sequence[Image], family: str = "pixels") -> str:
    """Returns the answer to a question, in the form that the question asks for.

    Args:
        text: of the question, all of it.
        images: of the question, in their order.
        family: how this model tells points, one of ``FAMILIES``.
    """
    try:
        if not images:
            raise CannotSee("I was sent no picture.")
        held, free = parts_of_task(text)
        if "exactly one of:" not in text:
            parts = find_parts(images[-1])
            places = {"grasp": middle(parts[held], parts[free])}
            if '"avoid"' in text:
                places["avoid"] = middle(parts[free], parts[held])
            return point_out(text, images[-1], places, family)
        label = choose_mark(text, images, held, free)
    except CannotSee as problem:
        return f"I cannot answer this. {problem}"
    reason = f"The task wants the {held} of the hammer to be held and the {free} to stay free."
    if '"choice"' in text:
        return json.dumps({"reasoning": reason, "choice": label})
    return f"{reason}\nFinal answer: {label}"


def parts_of_task(text: str) -> tuple[str, str]:
    """Returns the part to be held and the one to be left free, from the task in quotes."""
    for task in re.findall(r'"((?:[^"\\]|\\.)*)"', text):
        words = task.lower()
        if re.search(r"\b(hand|give|pass)\b.*\b(me|over)\b", words):
            return "head", "handle"
        if re.search(r"\b(use|drive|hit|pound)\b", words):
            return "handle", "head"
    raise CannotSee("There is no task in quotes that says what the hammer is for.")


def middle(part: Mask, other: Mask) -> tuple[int, int]:
    """Returns the pixel (u, v) deepest inside a part, in the half that is farther from the other.

    So the place is clearly on the part, not where the two meet.
    """
    depth, away = _depth(part), _depth(~other)
    v, u = np.unravel_index(np.argmax(depth * (away >= np.median(away[part]))), depth.shape)
    return int(u), int(v)


def point_out(text: str, image: Image, places: dict[str, tuple[int, int]], family: str) -> str:
    """Writes pixels of an image as a family does."""
    order, scale, form, said = FAMILIES[family]
    if not re.search(said, text):
        raise CannotSee(f"The question does not say what I take for granted: {said}")
    height, width = image.shape[:2]
    if scale is None and f"{width} pixels wide and {height} pixels high" not in text:
        raise CannotSee("The question tells another size than that of the picture I was sent.")
    written = []
    for role, (u, v) in places.items():
        x, y = (u, v) if scale is None else ((u + 0.5) / width, (v + 0.5) / height)
        if scale is not None:
            x, y = (round(a * scale, 1) if scale == 100 else round(a * scale) for a in (x, y))
        written.append(form.format(*((y, x) if order == "yx" else (x, y)), role=role))
    if form.startswith("<"):
        return " ".join(written)
    points = f"[{', '.join(written)}]"
    reasoned = f'{{"reasoning": "The middle of the part.", "points": {points}}}'
    return reasoned if '"reasoning"' in text else f"```json\n{points}\n```"


def choose_mark(text: str, images: Sequence[Image], held: str, free: str) -> str:
    """Returns the label of the mark that is on the part to be held."""
    labels = re.findall(r"exactly one of: (.+?)\.", text)[-1].split(", ")
    names = re.findall(r"Image (\w+):", text)
    clean = without_ink(images[0])
    if clean is images[0]:  # a reference: nothing is drawn on it
        images = images[1:]
    elif len(images) > 2:  # what most of them show has no marks
        clean = np.median(images, axis=0).astype(np.uint8)
    parts = find_parts(clean)
    fit: dict[str, tuple[float, float]] = {}
    for i, image in enumerate(images):
        for color, ink in marks_on(image, clean).items():
            mark, disc = without_disc(ink)
            name = names[i] if names else color
            label = name if disc is None else read_number(image, ink, disc, labels)
            if label not in labels or label in fit or (names and label != name):
                raise CannotSee(f"The mark {label} is one too many, or in the wrong picture.")
            fit[label] = how_well(mark, parts[held], parts[free])
    unseen = set(labels) - set(fit)
    if unseen:
        raise CannotSee(f"The marks {sorted(unseen)} are not to be seen.")
    return max(fit, key=lambda label: fit[label])


# What is in a picture


def marks_on(image: Image, clean: Image) -> dict[str, Mask]:
    """Returns the flat colours in which a picture differs from the one without marks."""
    if image.shape != clean.shape:
        raise CannotSee("The pictures with and without marks have different sizes.")
    drawn = cv2.absdiff(image, clean).max(axis=2) > CHANGED
    inks = find_ink(image, drawn)
    if not inks:
        raise CannotSee("No mark is to be seen.")
    stray = drawn & ~_grown(np.any(list(inks.values()), axis=0), RIM)
    if stray.sum() > 0.1 * drawn.sum():
        raise CannotSee("The pictures with and without marks do not show the same.")
    return inks


def find_parts(image: Image) -> dict[str, Mask]:
    """Finds the hammer: returns where its handle, yellow with a black grip, and its grey head are.

    What is dark and not the grip is the head's in shadow.
    """
    h, s, v = _hsv(image)
    yellow = (h > 38) & (h < 49) & (s > 0.7) & (v > 0.3)
    grey = (s < 0.2) & (v > 0.22) & (v < 0.95)
    dark = v <= 0.22
    whole = cv2.morphologyEx((yellow | grey | dark).astype(np.uint8), cv2.MORPH_CLOSE, _round(2))
    hammer = _largest(whole > 0, by=yellow)
    handle = _largest(yellow & hammer) | _largest(_opened(dark & hammer, 2))
    head = _opened(hammer & ~_grown(handle, 3), 1)
    parts = {"handle": handle, "head": _largest(head, by=grey)}
    for part, mask in parts.items():
        if mask.sum() < LEAST_PART:
            raise CannotSee(f"I see no {part} of a hammer in the picture.")
        if mask[[0, -1]].any() or mask[:, [0, -1]].any():
            raise CannotSee(f"The {part} of the hammer is cut off by the edge of the picture.")
    return parts


def find_ink(image: Image, drawn: Mask) -> dict[str, Mask]:
    """Returns the flat colours in what was drawn on a picture: by name, where they are.

    A drawn line has one and the same value everywhere but at its rims.
    """
    if not drawn.any():
        return {}
    pixels = image[drawn]
    h, s, v = (channel.ravel() for channel in _hsv(pixels[:, None]))
    value = pixels.astype(np.int32) @ [65536, 256, 1]
    found = {}
    for name, ((h0, h1), (s0, s1), (v0, v1)) in COLORS.items():
        hue = (h0 <= h) & (h <= h1) if h0 <= h1 else (h >= h0) | (h <= h1)
        like = hue & (s0 <= s) & (s <= s1) & (v0 <= v) & (v <= v1)
        values, counts = np.unique(value[like], return_counts=True)
        if len(counts) == 0:
            continue
        ink = np.zeros_like(drawn)
        ink[drawn] = like & (value == values[counts.argmax()])
        wide = cv2.morphologyEx(ink.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2)))
        if wide.sum() >= INK:  # and no mere rim of another line
            found[name] = ink
    return found


def without_ink(image: Image) -> Image:
    """Returns a picture without the marks on it; the picture itself where it has none."""
    ground = np.median(image[::8, ::8].reshape(-1, 3), axis=0)  # most of what is seen is table
    inks = find_ink(image, (image != ground).any(axis=2))
    if not inks:
        return image
    drawn = _grown(np.any(list(inks.values()), axis=0), 4)  # with its dark rim
    return cv2.inpaint(image, drawn.astype(np.uint8), 5, cv2.INPAINT_TELEA)


def without_disc(ink: Mask) -> tuple[Mask, tuple[int, int, int] | None]:
    """Parts a mark from its disc, if it has one, and from the line between them.

    Returns:
        The mark, and the disc's centre and radius [pixel].
    """
    filled = cv2.morphologyEx(ink.astype(np.uint8), cv2.MORPH_CLOSE, _round(4))
    depth = _depth(filled)
    v, u = np.unravel_index(depth.argmax(), depth.shape)
    radius = int(depth.max())
    if radius < 9:
        return ink, None
    rows, columns = np.nonzero(ink)
    away = np.hypot(columns - u, rows - v)
    left = ink.copy()
    left[rows[away < radius + 2], columns[away < radius + 2]] = False
    dot = _dot(left)
    if dot is not None:
        return dot, (int(u), int(v), radius)
    # The line leaves the disc straight outwards; where it ends the mark begins.
    near = (away >= radius + 2) & (away < radius + 14)
    if near.any():
        outwards = np.array([columns[near].mean() - u, rows[near].mean() - v])
        outwards /= max(np.linalg.norm(outwards), 1.0)
        offset = np.stack([columns - u, rows - v], axis=-1)
        along, across = offset @ outwards, np.abs(offset @ [-outwards[1], outwards[0]])
        on_line = (across < 2.5) & (along > 0)
        steps = np.sort(np.append(along[on_line], radius))
        jumps = np.flatnonzero(np.diff(steps) > GAP)
        line = on_line & (along <= steps[jumps[0] if len(jumps) else -1])
        left[rows[line], columns[line]] = False
    return left, (int(u), int(v), radius)


def how_well(mark: Mask, held: Mask, free: Mask) -> tuple[float, float]:
    """Returns how clearly a mark is on the part to be held; the more, the better.

    A hand is judged by what it surrounds; a dot by the part that it is on, and how near it is to
    all of that part.
    """
    dot = _dot(mark)
    if dot is not None:
        center = np.argwhere(dot).mean(axis=0)
        to_held, to_free = (np.linalg.norm(np.argwhere(p) - center, axis=1) for p in (held, free))
        return float(to_held.min() < to_free.min()), -to_held.mean()
    if mark.sum() < INK:
        raise CannotSee("A disc has no mark that it belongs to.")
    outline = cv2.convexHull(np.argwhere(mark)[:, ::-1].astype(np.int32))
    inside = cv2.fillConvexPoly(np.zeros(mark.shape, np.uint8), outline, 1) > 0
    on_held, on_free = int((inside & held).sum()), int((inside & free).sum())
    return (on_held - on_free) / max(on_held + on_free, 1), on_held


def read_number(image: Image, ink: Mask, disc: tuple[int, int, int], labels: Sequence[str]) -> str:
    """Returns which of the labels is written on a disc."""
    u, v, radius = disc
    r = radius - 2
    cut = np.s_[v - r : v + r + 1, u - r : u + r + 1]
    ground = image[ink][0].astype(int)
    contrast = np.abs(image[cut].astype(int) - ground).max(axis=2)
    rows, columns = np.indices(contrast.shape) - r
    written = (contrast > 90) & (np.hypot(rows, columns) < r)
    fonts = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_PLAIN)
    return max(labels, key=lambda label: max(_likeness(written, label, font) for font in fonts))


def _likeness(written: Mask, label: str, font: int) -> float:
    """Returns how much of what is written and of the label agree, from 0 to 1."""
    canvas = np.zeros((120, 60 * len(label) + 60), np.uint8)
    cv2.putText(canvas, label, (10, 100), font, 3.0, 255, 8)
    shapes = []
    for mask in (written, canvas > 0):
        if not mask.any():
            return 0.0
        v, u = np.argwhere(mask).min(axis=0)
        bottom, right = np.argwhere(mask).max(axis=0) + 1
        glyph = mask[v:bottom, u:right].astype(np.float32)
        width = max(1, round(24 * glyph.shape[1] / glyph.shape[0]))
        shape = np.zeros((24, 72), bool)
        shape[:, :width] = (
            cv2.resize(glyph, (width, 24), interpolation=cv2.INTER_AREA)[:, :72] > 0.4
        )
        shapes.append(shape)
    a, b = shapes
    return float((a & b).sum() / (a | b).sum())


def _dot(ink: Mask) -> Mask | None:
    """Returns the largest round blob, if there is one."""
    _, component, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8))
    width, height, area = stats[:, cv2.CC_STAT_WIDTH : cv2.CC_STAT_AREA + 1].T
    round_ = (area >= INK) & (np.abs(width - height) <= 2) & (area > 0.6 * width * height)
    round_[0] = False  # all the rest of the picture
    return component == np.argmax(area * round_) if round_.any() else None


def _hsv(image: Image) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns hue [degree], saturation and value, each (H, W)."""
    h, s, v = cv2.split(cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2HSV))
    return h, s, v


def _largest(mask: Mask, by: Mask | None = None) -> Mask:
    """Returns the connected part of a mask that has most of ``by``; nothing where there is none."""
    _, component = cv2.connectedComponents(mask.astype(np.uint8))
    sizes = np.bincount(component[mask if by is None else mask & by], minlength=1)
    return mask & (component == sizes.argmax()) & (sizes.max(initial=0) > 0)


def _depth(mask: Mask) -> np.ndarray:
    """Returns how far inside a mask every pixel is; 0 outside."""
    return cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)


def _round(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _opened(mask: Mask, radius: int) -> Mask:
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _round(radius)) > 0


def _grown(mask: Mask, radius: int) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), _round(radius)) > 0
