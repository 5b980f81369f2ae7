"""Finds the parts of one thing by its shape alone.

Each kind of thing has one idea of where its parts are:

- tool: a long thing with a wide and a thin portion, told apart along its axis;
- vessel: a round body and what sticks out of it, the handle;
- bottle: what is above its neck, the top, and its body;
- drill: two bulky portions and the bridge between them, the handle;
- animal: a head that is held high, a trunk before it, a thick middle on legs, a thin rear end.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from tog_drake.lexicon import LEXICON, Rule
from tog_drake.selectors.shapes import (
    BIN,
    MAX_SHOULDER,
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
    slope,
)
from tog_drake.values import Array

MIN_CONTRAST = np.log(1.25)  # the wide portion of a tool is 1.25 times as wide as the thin one
MIN_ELONGATION = 1.8  # of a tool without a noun: length over width
MIN_THIN = 0.045  # [m] the thin portion of a tool is at least this long
MIN_TOP = 0.024  # [m] of a bottle: less cannot be held
RIM = 0.025  # [m] from the top of a vessel
MIN_BULK = 0.10  # of a drill's silhouette is in each of its two bulky portions
MIN_DIFFERENCE = 0.15  # between the two ends of an animal, in relative width and height
RAISED = 1.1  # a head that is held high is this much higher than half of the animal
TAIL_ROOT = 2  # bins behind the thick middle that still belong to the rump

# Words for the end of a tool that does the work; the handle is the other one.
_HANDLE_WORDS = {"handle", "ring"}
_WORKING_WORDS = {"head", "blade", "bowl", "bristles", "body", "claw", "rim", "base"}
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
    # What is thin must be long enough to be held or to work with, unlike the tip of an umbrella.
    low = round(MIN_THIN / BIN)
    cuts = {
        measure: (values, *best_split(np.log(values), low=low))
        for measure, values in _measures(profile, rule, upright=frame.upright).items()
    }
    measure = next((m for m, (_, _, contrast) in cuts.items() if contrast > MIN_CONTRAST), None)
    if measure is None:
        raise PartNotFound(f"it is {profile.length * 100:.0f} cm long and alike all along")
    values, split, _ = cuts[measure]
    if values[:split].mean() > values[split:].mean():  # the thin portion first
        profile, values, split = profile.reversed(), values[::-1], len(values) - split
    waist, shoulder = slope(values, split)  # what is between them is neither
    thin, wide = profile.bin < waist, profile.bin >= shoulder
    working_first = rule.working_end != "wide"
    working = thin if working_first else wide
    if part in _THIN_WORDS:
        mask = thin
    elif part in _HANDLE_WORDS:
        mask = wide if working_first else thin
    elif part == "tip":
        mask = working & _outer_end(profile, split, at_end=not working_first)
    elif part in _WORKING_WORDS:
        mask = working
    else:
        return None
    ends = [100 * np.median(values[np.unique(profile.bin[m])]) for m in (wide, thin)]
    size = f"{profile.length * 100:.0f} cm long, {ends[0]:.1f} cm {measure} at one end and "
    chosen = measure if mask[wide].any() else {"wide": "thin", "high": "low"}[measure]
    return Region(mask, f"{size}{ends[1]:.1f} cm at the other; its {chosen} portion is the {part}")


def _measures(profile: Profile, rule: Rule, *, upright: bool) -> dict[str, Array]:
    """What tells the portions of a tool apart, first what does it best.

    A knife is as wide as its blade, but thicker, and so may be other tools.
    """
    if upright:
        return {"wide": profile.width}
    measures = {"wide": profile.width, "high": profile.height}
    return dict(reversed(measures.items())) if rule.working_end == "flat" else measures


def _outer_end(profile: Profile, split: int, *, at_end: bool) -> Mask:
    """The outer end of a portion: what is far narrower than it, else its outer quarter."""
    width = profile.width[split:] if at_end else profile.width[:split][::-1]
    wide = np.flatnonzero(width > 0.5 * np.median(width))
    begin = int(wide.max()) + 1
    if len(width) - begin < 2:
        begin = len(width) - max(2, len(width) // 4)
    return np.asarray(profile.bin >= split + begin if at_end else profile.bin < split - begin)


def _vessel_part(points: Array, part: str, rule: Rule) -> Region | None:
    circle = round_body(points)
    if circle is None:
        raise PartNotFound("no round body is seen")
    size = f"a round body of {2 * circle.radius * 100:.0f} cm"
    if part in {"handle", "ear", "ring"}:
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
        foot = count - slope(profile.width[::-1], count - begin)[0]
        begin = max(begin, min(foot, begin + MAX_SHOULDER, count - round(MIN_TOP / BIN)))
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
    profile, head_end = _head_first(profile_of(points, Frame(points)))
    width, height, z = profile.width, profile.height, points[:, 2]
    low = z < 0.3 * z.max()
    nose = _trunk_end(profile, head_end)
    # The trunk of the body reaches over all that is thick and over all legs.
    leg_bins = np.unique(profile.bin[low & (profile.bin >= head_end)])
    leg_bins = leg_bins[height[leg_bins] > 0.5 * height.max()]
    thick = np.flatnonzero(width > 0.8 * width[head_end:].max())
    middle = np.union1d(thick[thick >= head_end], leg_bins)
    begin, end = int(middle.min()), int(middle.max()) + 1
    head = (profile.bin >= nose) & (profile.bin < head_end)
    if not nose:  # a head on a neck is what is high
        head &= z > (np.median(height) + height[:head_end].max()) / 2
    behind = profile.bin >= nose
    tail = (profile.bin >= end + TAIL_ROOT) & (width < 0.6 * width[begin:end].max())[profile.bin]
    masks = {
        "tail": (tail, "its thin rear end"),
        "leg": (low & (profile.bin >= begin) & (profile.bin < end), "what is low under its middle"),
        "head": (head, "its high end"),
        "front": (profile.bin < (begin + end) // 2, "what is before the middle of its trunk"),
        "trunk": (profile.bin < nose, "what is low and thin before its head"),
        "neck": (
            behind & (profile.bin < begin) & ~head & ~low,
            "what is between its head and its middle",
        ),
        "body": ((profile.bin >= begin) & (profile.bin < end) & ~low & ~head, "its thick middle"),
    }
    name = {"horn": "head", "ear": "head"}.get(part, part)
    if name not in masks:
        return None
    mask, told = masks[name]
    return Region(mask, f"{profile.length * 100:.0f} cm long; {told} is the {part}")


def _head_first(profile: Profile) -> tuple[Profile, int]:
    """The profile from the head on, and the bin at which the head ends.

    The head is held high, else it is the end that is high and blunt: the tail is low and tapers.
    """
    height, count = profile.height, len(profile.height)
    high = height > (np.median(height) + height.max()) / 2
    runs, _ = ndimage.label(high)
    raised = np.flatnonzero(runs == runs[int(np.argmax(height))])
    place = (raised[0] + raised[-1] + 1) / 2 / count
    if height.max() > RAISED * np.median(height) and abs(place - 0.5) > 0.03:
        if place < 0.5:
            return profile, int(raised[-1]) + 1
        return profile.reversed(), count - int(raised[0])
    first, last = (
        end_mean(profile.width, first=f) / profile.width.max()
        + end_mean(height, first=f) / height.max()
        for f in (True, False)
    )
    if abs(first - last) < MIN_DIFFERENCE:
        raise PartNotFound("its two ends are alike: head and tail cannot be told apart")
    return (profile if first > last else profile.reversed()), max(3, count // 5)


def _trunk_end(profile: Profile, head_end: int) -> int:
    """The bin before which is a trunk, low and thin before the head; 0 for none."""
    split, contrast = best_split(np.log(profile.width[:head_end]))
    thin = profile.width[:split].mean() < profile.width[split:head_end].mean()
    low = np.median(profile.height[:split]) < 0.7 * profile.height.max()
    return split if contrast > MIN_CONTRAST and thin and low else 0
