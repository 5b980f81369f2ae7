"""Finds the parts of one object by its shape alone.

A table says what kind of thing a noun names and which of its ends does the work; without a noun
the kind is read off the shape. Each kind has one idea of where its parts are:

- tool: a long thing with a wide and a thin portion, told apart along the principal axis;
- vessel: a round body (a circle from above) and what sticks out of it, the handle;
- bottle: its top, a neck narrower than the body, and its body;
- drill: two bulky portions and the bridge between them, the handle;
- animal: a thick middle, a low tapering end, the tail, and a high end, the head.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tog_drake.points import clusters, neighbors
from tog_drake.values import Array

Mask = NDArray[np.bool_]
Kind = Literal["tool", "vessel", "bottle", "drill", "animal"]

BIN = 0.006  # [m] along an axis; two points of a cloud thinned to 3 mm
CELL = 0.004  # [m] of a silhouette from above
MAX_GAP = 0.010  # [m] between the points of one thing
MIN_POINTS = 12  # fewer are no part
MIN_CONTRAST = 1.25  # the wide portion of a tool is this much wider than the thin one
MIN_ELONGATION = 1.8  # of a tool without a noun: length over width
MIN_NECK = 0.25  # a bottle narrows at its neck by this much at least, in logarithms of width
CIRCLE_TOLERANCE = 0.004  # [m]
TAIL_ROOT = 2  # bins behind the thick middle that still belong to the rump
MIN_BULK = 0.10  # of a drill's silhouette is in each of its two bulky portions
PROTRUSION = 0.008  # [m] beyond the circle begins the handle


class PartNotFound(Exception):
    """The shape does not show the part; the message says why. It never leaves the selector."""


@dataclass(frozen=True)
class Rule:
    """What a noun says about shape."""

    kind: Kind
    working: str = "body"  # the part that does the work, and is offered at a handover
    working_end: Literal["wide", "thin"] = "wide"


def _rules() -> dict[str, Rule]:
    nouns = {
        Rule("tool", "head"): "hammer mallet axe racket tool fork whisk wrench plunger",
        Rule("tool", "blade"): "spatula turner cleaver shovel",
        Rule("tool", "bowl"): "spoon ladle scoop pan frypan skillet strainer",
        Rule("tool", "bristles"): "brush broom",
        Rule("tool", "shaft", "thin"): "screwdriver awl soldering",
        Rule("tool", "blade", "thin"): "knife chisel scissors file saw",
        Rule("vessel"): "mug cup pitcher jug teapot kettle pot",
        Rule(
            "bottle", "cap"
        ): "bottle ketchup mustard milk lotion glue cleanser bleach shampoo jar tube "
        "conditioner sauce dressing honey",
        Rule("drill"): "drill",
        Rule("animal"): "toy dinosaur dino brontosaurus triceratops spinosaurus therizinosaurus "
        "animal horse cow bull lion rhino unicorn dog cat elephant giraffe",
    }
    return {noun: rule for rule, words in nouns.items() for noun in words.split()}


RULES = _rules()
HOLD_FOR_USE: dict[Kind, str] = {
    "tool": "handle",
    "vessel": "handle",
    "bottle": "body",
    "drill": "handle",
    "animal": "body",
}
"""Where a thing is held to be used."""
_KIND_PHRASES: dict[Kind, str] = {
    "tool": "a long tool",
    "vessel": "a round vessel",
    "bottle": "a bottle",
    "drill": "a drill",
    "animal": "an animal",
}

# Words for the end of a tool that does the work, and for the end that is held.
_WORKING_WORDS = {"head", "blade", "bowl", "bristles", "body", "claw", "tip", "rim", "base"}
_HELD_WORDS = {"handle"}
_THIN_WORDS = {"shaft", "neck"}  # the working end where that is thin, else the handle


@dataclass(frozen=True)
class Region:
    """Where a part is."""

    mask: Mask  # (N,) of the object's points
    how: str  # how it was told, for a person


def rule_of(nouns: tuple[str, ...], points: Array) -> tuple[Rule, str]:
    """Returns the rule of the first noun known, else that of the shape, and how it was told."""
    for noun in nouns:
        if noun in RULES:
            return RULES[noun], f"read as {_KIND_PHRASES[RULES[noun].kind]}"
    spread = _Frame(points)
    if spread.upright:
        circle = _circle(points)
        if circle is not None and _protrusion(points, circle) is not None:
            return Rule("vessel"), "round with something sticking out: a vessel"
        return Rule("bottle"), "upright: a bottle"
    if spread.length > MIN_ELONGATION * spread.width:
        return Rule("tool", "head"), "long and lying: a tool"
    circle = _circle(points)
    if circle is not None and _protrusion(points, circle) is not None:
        return Rule("vessel"), "round with something sticking out: a vessel"
    raise PartNotFound("its shape is neither long, nor round with a handle, nor upright")


def likeness(points: Array, kind: Kind) -> float:
    """How much (0..1) the shape could be of the kind, to tell a thing from its neighbours."""
    frame = _Frame(points)
    if kind == "bottle":
        return float(frame.upright and frame.height > 0.08)
    if kind == "tool":
        long = frame.length > max(0.12, MIN_ELONGATION * frame.width)
        return float(long and frame.height < 0.07)
    if kind == "animal":
        return float(frame.length > 1.3 * frame.width and frame.height > 0.03 and not frame.upright)
    if kind == "vessel":
        return _vessel_likeness(points, frame)
    try:
        find_part(points, "handle", Rule(kind))
    except PartNotFound:
        return 0.0
    return 1.0


def find_part(points: Array, part: str, rule: Rule) -> Region:
    """Returns the region of ``part`` (a name of ``task_words.PART_WORDS``).

    Args:
        points: (N, 3) [m] of one object, in a frame with z up and the table at z = 0.

    Raises PartNotFound where the shape does not show it.
    """
    if len(points) < MIN_POINTS:
        raise PartNotFound(f"only {len(points)} points of the object are seen")
    if part in {"top", "base", "middle"} and not (rule.kind == "tool" and part == "base"):
        return _level(points, part)
    find = {
        "tool": _tool_part,
        "vessel": _vessel_part,
        "bottle": _bottle_part,
        "drill": _drill_part,
        "animal": _animal_part,
    }[rule.kind]
    region = find(points, part, rule)
    if region.mask.sum() < MIN_POINTS:
        raise PartNotFound(f"its {part} is hidden or too small: {region.mask.sum()} points seen")
    return region


class _Frame:
    """The principal axis of an object in the table plane, and its size along and across it."""

    def __init__(self, points: Array):
        xy = points[:, :2]
        centre = (xy.max(axis=0) + xy.min(axis=0)) / 2
        cells = np.unique(np.floor((xy - centre) / CELL), axis=0) * CELL  # density does not count
        self.centre = cells.mean(axis=0) + centre
        axes = np.linalg.eigh(np.cov((cells - cells.mean(axis=0)).T) + 1e-12 * np.eye(2))[1]
        self.axis, self.side = axes[:, 1], axes[:, 0]
        self.s = (xy - self.centre) @ self.axis  # (N,) [m] along
        self.t = (xy - self.centre) @ self.side  # (N,) [m] across
        self.length, self.width = float(np.ptp(self.s)), float(np.ptp(self.t))
        self.height = float(np.percentile(points[:, 2], 99))

    @property
    def upright(self) -> bool:
        return self.height > 1.1 * self.length


@dataclass(frozen=True)
class _Profile:
    """How wide and high an object is along an axis, bin by bin."""

    bin: NDArray[np.int64]  # (N,) of each point
    width: Array  # (B,) [m]
    height: Array  # (B,) [m]


def _profile(s: Array, t: Array, z: Array) -> _Profile:
    number = np.floor((s - s.min()) / BIN).astype(np.int64)
    count = int(number.max()) + 1
    width, height = np.full(count, np.nan), np.full(count, np.nan)
    for b in range(count):
        here = number == b
        if here.sum() >= 2:
            width[b] = np.ptp(t[here]) + 0.003  # the cloud's points are 3 mm apart
            height[b] = z[here].max()
    seen = np.flatnonzero(np.isfinite(width))
    for values in (width, height):
        values[:] = ndimage.median_filter(
            np.interp(np.arange(count), seen, values[seen]), size=3, mode="nearest"
        )
    return _Profile(number, width, height)


def _tool_part(points: Array, part: str, rule: Rule) -> Region:
    frame = _Frame(points)
    profile = _profile(frame.s, frame.t, points[:, 2])
    trim = 2 if len(profile.width) > 12 else 0  # rounded ends
    split, contrast = _best_split(np.log(profile.width[trim : len(profile.width) - trim]))
    split += trim
    if contrast < np.log(MIN_CONTRAST):
        raise PartNotFound(
            f"it is {frame.length * 100:.0f} cm long and about equally wide all along"
        )
    first = profile.bin < split
    first_is_wide = profile.width[:split].mean() > profile.width[split:].mean()
    wide = first if first_is_wide else ~first
    working = wide if rule.working_end == "wide" else ~wide
    if part in _THIN_WORDS:
        mask = ~wide
    elif part in _HELD_WORDS:
        mask = ~working
    elif part in _WORKING_WORDS:
        mask = working
    else:
        raise PartNotFound(f"a tool shows no {part}")
    word = "wide" if bool((mask == wide).all()) else "thin"
    widths = [float(np.median(profile.width[np.unique(profile.bin[m])])) for m in (wide, ~wide)]
    how = (
        f"{frame.length * 100:.0f} cm long; {widths[0] * 100:.0f} cm wide at one end, "
        f"{widths[1] * 100:.0f} cm at the other; the {word} portion is the {part}"
    )
    return Region(mask, how)


def _best_split(values: Array) -> tuple[int, float]:
    """The index that best cuts a sequence into two levels, and the levels' difference.

    Least squares, so most of the variance lies between the two sides.
    """
    n = len(values)
    if n < 4:
        return 1, 0.0
    left = np.cumsum(values)[:-1] / np.arange(1, n)
    right = (values.sum() - np.cumsum(values)[:-1]) / np.arange(n - 1, 0, -1)
    weight = np.arange(1, n) * np.arange(n - 1, 0, -1)
    split = int(np.argmax(weight * (left - right) ** 2)) + 1
    return split, float(abs(left - right)[split - 1])


def _circle(points: Array) -> tuple[Array, float] | None:
    """The circle (centre (2,), radius) [m] that most of the outline from above lies on.

    Cells of the silhouette vote, not points, so that a wall seen at length does not outvote the
    rim. Three cells make a hypothesis; None where no circle explains enough.
    """
    high = points[points[:, 2] > 0.3 * points[:, 2].max()]
    cells = np.unique(np.floor(high[:, :2] / CELL), axis=0) * CELL + CELL / 2
    if len(cells) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    a, b, c = (cells[rng.integers(len(cells), size=600)] for _ in range(3))
    # Circumcentre of a, b, c, relative to a.
    p, q = b - a, c - a
    cross = 2 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    keep = np.abs(cross) > 1e-5
    a, p, q, cross = a[keep], p[keep], q[keep], cross[keep]
    pp, qq = (p**2).sum(axis=1), (q**2).sum(axis=1)
    offset = np.column_stack([q[:, 1] * pp - p[:, 1] * qq, p[:, 0] * qq - q[:, 0] * pp])
    offset /= cross[:, None]
    radius = np.linalg.norm(offset, axis=1)
    keep = (radius > 0.02) & (radius < 0.10)
    if not keep.any():
        return None
    centre, radius = (a + offset)[keep], radius[keep]
    distance = np.linalg.norm(cells[None] - centre[:, None], axis=2) - radius[:, None]
    on = (np.abs(distance) < CIRCLE_TOLERANCE).sum(axis=1)
    best = int(np.argmax(on))
    arc = on[best] * CELL / (2 * np.pi * radius[best])
    if arc < 0.4 or (distance[best] < CIRCLE_TOLERANCE).mean() < 0.5:
        return None
    return centre[best], float(radius[best])


def _protrusion(points: Array, circle: tuple[Array, float]) -> Mask | None:
    """The largest connected thing outside the circle; None where there is none."""
    centre, radius = circle
    outside = np.linalg.norm(points[:, :2] - centre, axis=1) > radius + PROTRUSION
    outside &= points[:, 2] > 0.1 * points[:, 2].max()
    if outside.sum() < MIN_POINTS:
        return None
    rows = np.flatnonzero(outside)
    label = clusters(neighbors(points[rows], 16), MAX_GAP)
    count = np.bincount(label)
    mask = np.zeros(len(points), dtype=bool)
    mask[rows[label == count.argmax()]] = True
    return mask if count.max() >= MIN_POINTS else None


def _vessel_likeness(points: Array, frame: _Frame) -> float:
    """Round, best also hollow and with a handle: what is seen within the rim lies below it."""
    circle = _circle(points)
    if circle is None or frame.height < 0.04 or frame.width < 0.55 * frame.length:
        return 0.0
    inner = np.linalg.norm(points[:, :2] - circle[0], axis=1) < 0.75 * circle[1]
    deep = inner & (points[:, 2] < frame.height - 0.02)
    hollow = inner.mean() < 0.05 or deep.sum() > 0.6 * inner.sum()
    return 0.5 * float(hollow) + 0.3 * float(_protrusion(points, circle) is not None)


def _vessel_part(points: Array, part: str, rule: Rule) -> Region:
    circle = _circle(points)
    if circle is None:
        raise PartNotFound("no round body is seen")
    handle = _protrusion(points, circle)
    size = f"round body of {2 * circle[1] * 100:.0f} cm"
    if part == "handle":
        if handle is None:
            raise PartNotFound(f"{size}, nothing sticks out of it: its handle is hidden")
        return Region(handle, f"{size}; what sticks out of it is the handle")
    inside = np.linalg.norm(points[:, :2] - circle[0], axis=1) < circle[1] + PROTRUSION / 2
    if part == "body":
        return Region(inside, f"{size}, without what sticks out of it")
    if part in {"rim", "cap"}:
        high = points[:, 2] > points[inside, 2].max() - 0.025
        return Region(inside & high, f"{size}; its upper 2.5 cm are the {part}")
    raise PartNotFound(f"a vessel shows no {part}")


def _bottle_part(points: Array, part: str, rule: Rule) -> Region:
    frame = _Frame(points)
    if frame.upright:
        s, t = points[:, 2], frame.s
        where = "upright"
    else:
        s, t = frame.s, frame.t
        where = "lying"
    profile = _profile(s, t, points[:, 2])
    width = profile.width
    if not frame.upright and _end(width, first=True) < _end(width, first=False):
        profile = _Profile(len(width) - 1 - profile.bin, width[::-1], profile.height[::-1])
        width = profile.width  # the narrow end is the top: last
    neck = _neck(width)
    if neck is None:
        neck = len(width) * 3 // 4
        told = f"no neck seen, so its {'upper' if frame.upright else 'narrower'} quarter is the top"
    else:
        told = f"above its neck are {(len(width) - neck) * BIN * 100:.0f} cm, the top"
    length = len(width) * BIN
    top = profile.bin >= neck
    how = f"{where}, {length * 100:.0f} cm long; {told}"
    if part in {"cap", "neck", "spout", "head"}:
        return Region(top, how)
    if part in {"body", "handle", "base"}:
        return Region(~top, f"{how}; the rest is the {part}")
    raise PartNotFound(f"a bottle shows no {part}")


def _neck(width: Array) -> int | None:
    """The bin in the upper half at which a bottle narrows most steeply; None if it does not."""
    n = len(width)
    rows = np.arange(max(2, n // 2), n - 2)
    if len(rows) == 0:
        return None
    below = np.log(width[rows - 2] + width[rows - 1])
    above = np.log(width[rows] + width[rows + 1])
    best = int(np.argmax(below - above))
    return int(rows[best]) if below[best] - above[best] > MIN_NECK else None


def _end(values: Array, *, first: bool) -> float:
    n = max(2, len(values) // 5)
    return float(values[:n].mean() if first else values[-n:].mean())


def _silhouette(points: Array) -> tuple[Mask, NDArray[np.int64]]:
    """The object along its thinnest direction as a filled picture, and the pixel of each point."""
    cells = np.unique(np.floor(points / CELL), axis=0)
    axes = np.linalg.eigh(np.cov((cells - cells.mean(axis=0)).T))[1]
    cell = np.floor(points @ axes[:, 1:] / CELL).astype(np.int64)
    cell -= cell.min(axis=0) - 12
    picture = np.zeros(cell.max(axis=0) + 13, dtype=bool)
    picture[tuple(cell.T)] = True
    return ndimage.binary_fill_holes(ndimage.binary_closing(picture, _disc(2))), cell


def _disc(radius: float) -> Mask:
    r = int(np.ceil(radius))
    y, x = np.mgrid[-r : r + 1, -r : r + 1]
    return np.asarray(x**2 + y**2 <= radius**2)


def _drill_part(points: Array, part: str, rule: Rule) -> Region:
    """What joins the two bulky portions is the handle.

    The picture is opened with ever larger discs, which leaves ever thicker portions. The largest
    disc that still leaves two is taken, so that the bridge is seen at full length.
    """
    picture, cell = _silhouette(points)
    found = None
    for radius in np.arange(2.0, 12.0, 0.5):
        label, count = ndimage.label(ndimage.binary_opening(picture, _disc(radius)))
        area = np.bincount(label.ravel(), minlength=count + 1)
        big = [i for i in range(1, count + 1) if area[i] > MIN_BULK * picture.sum()]
        if len(big) >= 2:
            found = label, area, big
    if found is None:
        raise PartNotFound("no two bulky portions with a bridge between them are seen")
    label, area, big = found
    rest, rests = ndimage.label(picture & ~np.isin(label, big))
    bridge = np.zeros_like(picture)
    for i in range(1, rests + 1):
        near = set(label[ndimage.binary_dilation(rest == i, _disc(2))]) & set(big)
        if len(near) >= 2:
            bridge |= rest == i
    # A disc does not fill the corners at the ends of the bridge: these are the bridge's too.
    here = (ndimage.binary_dilation(bridge, _disc(2)) & picture)[tuple(cell.T)]
    if part == "handle":
        return Region(here, "the bridge between its two bulky portions is the handle")
    if part in {"body", "head", "chuck"}:
        biggest = max(big, key=lambda i: int(area[i]))
        return Region((label == biggest)[tuple(cell.T)], f"its bulkiest portion is the {part}")
    if part == "base":
        smaller = min(big, key=lambda i: int(area[i]))
        return Region((label == smaller)[tuple(cell.T)], "the smaller bulky portion is the base")
    raise PartNotFound(f"a drill shows no {part}")


def _animal_part(points: Array, part: str, rule: Rule) -> Region:
    frame = _Frame(points)
    profile = _profile(frame.s, frame.t, points[:, 2])
    width, height = profile.width, profile.height
    # The head is held high and is blunt; the tail is low and tapers.
    first, last = (
        _end(width, first=f) / width.max() + _end(height, first=f) / height.max()
        for f in (True, False)
    )
    if abs(first - last) < 0.15:
        raise PartNotFound("its two ends are alike: head and tail cannot be told apart")
    if first < last:
        profile = _Profile(len(width) - 1 - profile.bin, width[::-1], height[::-1])
        width, height = profile.width, profile.height  # now the head comes first
    thick = np.flatnonzero(width > 0.8 * width.max())
    begin, end = int(thick.min()), int(thick.max()) + 1
    z = points[:, 2]
    neck_height = (np.median(height[begin:end]) + height[:begin].max(initial=0.0)) / 2
    if height[:begin].max(initial=0.0) > 1.15 * np.median(height[begin:end]):
        head = (profile.bin < begin) & (z > neck_height)
        told = "what it holds high at its blunt end"
    else:
        head = profile.bin < max(3, len(width) // 5)
        told = "its blunt end"
    low = z < 0.3 * z.max()
    trunk = (profile.bin >= begin) & (profile.bin < end)
    masks = {
        "tail": (profile.bin >= end + TAIL_ROOT, "its low, tapering end"),
        "leg": (low & (profile.bin < end), "what is low under its middle"),
        "head": (head, told),
        "horn": (head, told),
        "neck": ((profile.bin < begin) & ~head & ~low, "what is between its head and its middle"),
        "body": (trunk & ~low & ~head, "its thick middle"),
    }
    if part not in masks:
        raise PartNotFound(f"an animal shows no {part}")
    mask, told = masks[part]
    return Region(mask, f"{frame.length * 100:.0f} cm long; {told} is the {part}")


def _level(points: Array, part: str) -> Region:
    """The upper or lower quarter of what stands, or the middle of what lies."""
    z = points[:, 2]
    if part == "top":
        return Region(z > 0.75 * z.max(), "its upper quarter")
    if part == "base":
        return Region(z < 0.25 * z.max(), "its lower quarter")
    frame = _Frame(points)
    return Region(np.abs(frame.s) < frame.length / 6, "the middle third of its length")
