"""Finds the parts of one thing by its shape alone.

Each kind of thing has one idea of where its parts are:

- tool: a long thing with a wide and a thin portion, told apart along its axis;
- vessel: a round body and what sticks out of it, the handle;
- bottle: what is above its neck, the top, and its body;
- drill: two bulky portions and the bridge between them, the handle;
- animal: a thick middle, a low tapering end, the tail, and a high blunt end, the head.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from tog_drake.lexicon import LEXICON, Kind, Rule
from tog_drake.selectors.shapes import (
    MIN_POINTS,
    PROTRUSION,
    Frame,
    Mask,
    Profile,
    best_split,
    disc,
    end_mean,
    neck,
    profile_of,
    protrusion,
    round_body,
    silhouette,
)
from tog_drake.values import Array

MIN_CONTRAST = np.log(1.25)  # the wide portion of a tool is 1.25 times as wide as the thin one
MIN_ELONGATION = 1.8  # of a tool without a noun: length over width
RIM = 0.025  # [m] from the top of a vessel
MIN_BULK = 0.10  # of a drill's silhouette is in each of its two bulky portions
MIN_DIFFERENCE = 0.15  # between the two ends of an animal, in relative width and height
TAIL_ROOT = 2  # bins behind the thick middle that still belong to the rump

# Words for the end of a tool that does the work; the handle is the other one.
_WORKING_WORDS = {"head", "blade", "bowl", "bristles", "body", "claw", "tip", "rim", "base"}
_THIN_WORDS = {"shaft", "neck"}  # the working end where that is thin, else the handle


class PartNotFound(Exception):
    """The shape does not show the part; the message says why. It never leaves the selector."""


@dataclass(frozen=True)
class Region:
    """Where a part is."""

    mask: Mask  # (N,) of the thing's points
    how: str  # how it was told, for a person


def rule_of(nouns: tuple[str, ...], points: Array) -> tuple[Rule, str]:
    """Returns the rule of the first noun known, else that of the shape, and how it was told."""
    for noun in nouns:
        if noun in LEXICON.rules:
            return LEXICON.rules[noun], f"read as {_called(LEXICON.rules[noun])}"
    frame = Frame(points)
    circle = round_body(points)
    if circle is not None and protrusion(points, circle) is not None:
        return Rule("vessel"), "round with something sticking out, so a vessel"
    if frame.upright:
        return Rule("bottle", "cap"), "upright, so a bottle"
    if frame.length > MIN_ELONGATION * frame.width:
        return Rule("tool", "head"), "long and lying, so a tool"
    raise PartNotFound("its shape is neither long, nor round with a handle, nor upright")


def _called(rule: Rule) -> str:
    return LEXICON.kinds[rule.kind].called


def likeness(points: Array, kind: Kind) -> float:
    """How much (0..1) the shape could be of the kind, to tell a thing from its neighbours."""
    frame = Frame(points)
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
    """Returns the region of ``part`` (a name of the lexicon).

    Args:
        points: (N, 3) [m] of one thing, in a frame with z up and the table at z = 0.

    Raises PartNotFound where the shape does not show it.
    """
    if len(points) < MIN_POINTS:
        raise PartNotFound(f"only {len(points)} points of the object are seen")
    find = {
        "tool": _tool_part,
        "vessel": _vessel_part,
        "bottle": _bottle_part,
        "drill": _drill_part,
        "animal": _animal_part,
    }[rule.kind]
    region = _level(points, part) or find(points, part, rule)
    if region is None:
        raise PartNotFound(f"{_called(rule)} shows no {part}")
    if region.mask.sum() < MIN_POINTS:
        raise PartNotFound(f"its {part} is hidden or too small: {region.mask.sum()} points seen")
    return region


def _level(points: Array, part: str) -> Region | None:
    """Parts that any thing has: its upper quarter, the middle of its length."""
    if part == "top":
        return Region(points[:, 2] > 0.75 * points[:, 2].max(), "its upper quarter")
    if part == "middle":
        frame = Frame(points)
        return Region(np.abs(frame.s) < frame.length / 6, "the middle third of its length")
    return None


def _tool_part(points: Array, part: str, rule: Rule) -> Region | None:
    frame = Frame(points)
    profile = profile_of(points, frame)
    values, measure = profile.width, "wide"
    split, contrast = best_split(np.log(values))
    if contrast < MIN_CONTRAST and not frame.upright:  # a knife: as wide as its blade, but thicker
        values, measure = profile.height, "high"
        split, contrast = best_split(np.log(values))
    if contrast < MIN_CONTRAST:
        raise PartNotFound(f"it is {profile.length * 100:.0f} cm long and alike all along")
    first = profile.bin < split
    wide = first if values[:split].mean() > values[split:].mean() else ~first
    working = wide if rule.working_end == "wide" else ~wide
    if part in _THIN_WORDS:
        mask = ~wide
    elif part == "handle":
        mask = ~working
    elif part in _WORKING_WORDS:
        mask = working
    else:
        return None
    ends = [100 * np.median(values[np.unique(profile.bin[m])]) for m in (wide, ~wide)]
    size = f"{profile.length * 100:.0f} cm long, {ends[0]:.1f} cm {measure} at one end and "
    chosen = measure if np.array_equal(mask, wide) else {"wide": "thin", "high": "low"}[measure]
    return Region(mask, f"{size}{ends[1]:.1f} cm at the other; its {chosen} portion is the {part}")


def _vessel_likeness(points: Array, frame: Frame) -> float:
    """Round, best also hollow and with a handle: what is seen within the rim lies below it."""
    circle = round_body(points)
    if circle is None or frame.height < 0.04 or frame.width < 0.55 * frame.length:
        return 0.0
    inner = circle.distance(points) < 0.75 * circle.radius
    deep = inner & (points[:, 2] < frame.height - 0.02)
    hollow = inner.mean() < 0.05 or deep.sum() > 0.6 * inner.sum()
    return 0.5 * float(hollow) + 0.3 * float(protrusion(points, circle) is not None)


def _vessel_part(points: Array, part: str, rule: Rule) -> Region | None:
    circle = round_body(points)
    if circle is None:
        raise PartNotFound("no round body is seen")
    size = f"a round body of {2 * circle.radius * 100:.0f} cm"
    if part == "handle":
        handle = protrusion(points, circle)
        if handle is None:
            raise PartNotFound(f"{size}, nothing sticks out of it: its handle is hidden")
        return Region(handle, f"{size}; what sticks out of it is the handle")
    inside = circle.distance(points) < circle.radius + PROTRUSION / 2
    if part in {"body", "base"}:
        return Region(inside, f"{size}, without what sticks out of it")
    if part in {"rim", "cap"}:
        high = points[:, 2] > points[inside, 2].max(initial=0.0) - RIM
        return Region(inside & high, f"{size}; its upper {RIM * 100:.1f} cm are the {part}")
    return None


def _bottle_part(points: Array, part: str, rule: Rule) -> Region | None:
    frame = Frame(points)
    profile = profile_of(points, frame)
    ends = [end_mean(profile.width, first=first) for first in (True, False)]
    if not frame.upright and ends[0] < ends[1]:
        profile = profile.reversed()  # the narrow end of what lies is the top: last
    count = len(profile.width)
    begin = neck(profile.width)
    how = f"{'upright' if frame.upright else 'lying'}, {profile.length * 100:.0f} cm long; "
    if begin is None:
        begin = count * 3 // 4
        how += f"no neck seen, so its {'upper' if frame.upright else 'narrow'} quarter is the top"
    else:
        how += (
            f"the {(1 - begin / count) * profile.length * 100:.0f} cm beyond its neck are the top"
        )
    top = profile.bin >= begin
    if part in {"cap", "neck", "spout", "head"}:
        return Region(top, how)
    if part in {"body", "handle", "base"}:
        return Region(~top, f"{how}; the rest is the {part}")
    return None


def _drill_part(points: Array, part: str, rule: Rule) -> Region | None:
    """What joins the two bulky portions is the handle.

    The picture is opened with ever larger discs, which leaves ever thicker portions. The largest
    disc that still leaves two is taken, so that the bridge is seen at full length.
    """
    picture, pixel = silhouette(points)
    found = None
    for radius in np.arange(2.0, 12.0, 0.5):
        label, count = ndimage.label(ndimage.binary_opening(picture, disc(radius)))
        area = np.bincount(label.ravel(), minlength=count + 1)
        big = [i for i in range(1, count + 1) if area[i] > MIN_BULK * picture.sum()]
        if len(big) >= 2:
            found = label, sorted(big, key=lambda i: -int(area[i]))
    if found is None:
        raise PartNotFound("no two bulky portions with a bridge between them are seen")
    label, big = found
    if part == "handle":
        bridge = _bridge(picture, label, set(big))
        how = "the bridge between its two bulky portions is the handle"
        return Region(bridge[tuple(pixel.T)], how)
    if part in {"body", "head", "chuck"}:
        return Region((label == big[0])[tuple(pixel.T)], f"its bulkiest portion is the {part}")
    if part == "base":
        return Region((label == big[-1])[tuple(pixel.T)], "its smaller bulk is the base")
    return None


def _bridge(picture: Mask, label: Array, big: set[int]) -> Mask:
    """What of the picture touches at least two of the big portions."""
    rest, rests = ndimage.label(picture & ~np.isin(label, list(big)))
    bridge = np.zeros_like(picture)
    for i in range(1, rests + 1):
        if len(set(label[ndimage.binary_dilation(rest == i, disc(2))]) & big) >= 2:
            bridge |= rest == i
    # A disc does not fill the corners at the ends of the bridge: these are the bridge's too.
    return np.asarray(ndimage.binary_dilation(bridge, disc(2)) & picture)


def _animal_part(points: Array, part: str, rule: Rule) -> Region | None:
    frame = Frame(points)
    profile = _head_first(profile_of(points, frame))
    width, height = profile.width, profile.height
    z = points[:, 2]
    low = z < 0.3 * z.max()
    # The middle reaches over all that is thick and over all legs.
    leg_bins = np.unique(profile.bin[low])
    leg_bins = leg_bins[height[leg_bins] > 0.5 * height.max()]
    middle = np.union1d(np.flatnonzero(width > 0.8 * width.max()), leg_bins)
    begin, end = int(middle.min()), int(middle.max()) + 1
    before = profile.bin < begin
    back = float(np.median(height[begin:end]))
    raised = height[:begin].max(initial=0.0)
    if raised > 1.15 * back:
        head = before & (z > (back + raised) / 2)
    else:
        head = profile.bin < max(3, len(width) // 5)
    masks = {
        "tail": (profile.bin >= end + TAIL_ROOT, "its low, tapering end"),
        "leg": (low & ~before & (profile.bin < end), "what is low under its middle"),
        "head": (head, "its high, blunt end"),
        "horn": (head, "its high, blunt end"),
        "neck": (before & ~head & ~low, "what is between its head and its middle"),
        "body": (~before & (profile.bin < end) & ~low & ~head, "its thick middle"),
    }
    if part not in masks:
        return None
    mask, told = masks[part]
    return Region(mask, f"{profile.length * 100:.0f} cm long; {told} is the {part}")


def _head_first(profile: Profile) -> Profile:
    """The head is held high and is blunt; the tail is low and tapers."""
    width, height = profile.width, profile.height
    first, last = (
        end_mean(width, first=f) / width.max() + end_mean(height, first=f) / height.max()
        for f in (True, False)
    )
    if abs(first - last) < MIN_DIFFERENCE:
        raise PartNotFound("its two ends are alike: head and tail cannot be told apart")
    return profile if first > last else profile.reversed()
