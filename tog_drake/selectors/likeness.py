"""How much a thing looks like what a noun says, to tell it from other things in view."""

import numpy as np

from tog_drake.lexicon import LEXICON, Kind, Rule
from tog_drake.selectors.parts import PartNotFound, find_part
from tog_drake.selectors.shapes import Frame, best_split, profile_of, protrusion, round_body
from tog_drake.values import Array

SIZE_SPREAD = 0.25  # of the logarithm of a size: things of one noun differ by a quarter
SHARE_SPREAD = 0.12  # of the share of its length that is wide
OTHER_KIND = 0.3  # how much a thing whose shape is not of the noun's kind counts


def likeness(points: Array, rule: Rule) -> float:
    """How much (0..1) a thing could be what the rule says.

    Args:
        points: (N, 3) [m] of one thing, in a frame with z up and the table at z = 0.
    """
    of_kind = kind_likeness(points, rule.kind)
    if rule.looks is None:
        return 0.5 * of_kind  # a noun whose size is not known is never sure
    frame = Frame(points)
    size = np.array([frame.length, frame.width, frame.height])
    off = np.log(np.maximum(size, 1e-3) / rule.looks[:3]) / SIZE_SPREAD
    square = float((off**2).sum())
    if rule.looks[3] > 0:
        square += ((_wide_share(points, frame) - rule.looks[3]) / SHARE_SPREAD) ** 2
    return float(np.exp(-square / 2)) * (OTHER_KIND + (1 - OTHER_KIND) * float(of_kind > 0))


def most_like(points: Array) -> str:
    """The noun that a thing looks most like."""
    known = {noun: rule for noun, rule in LEXICON.rules.items() if rule.looks is not None}
    return max(known, key=lambda noun: likeness(points, known[noun]))


def _wide_share(points: Array, frame: Frame) -> float:
    """The share of its length that is wide."""
    width = profile_of(points, frame).width
    split, _ = best_split(np.log(width))
    if width[:split].mean() > width[split:].mean():
        return split / len(width)
    return 1 - split / len(width)


def kind_likeness(points: Array, kind: Kind) -> float:
    """How much (0..1) the shape could be of the kind."""
    frame = Frame(points)
    if kind == "bottle":
        return float(frame.upright and frame.height > 0.08)
    if kind == "tool":
        long = frame.length > max(0.12, 1.8 * frame.width)
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


def _vessel_likeness(points: Array, frame: Frame) -> float:
    """Round, best also hollow and with a handle: what is seen within the rim lies below it."""
    circle = round_body(points)
    if circle is None or frame.height < 0.04:
        return 0.0
    handle = protrusion(points, circle) is not None
    if not handle and frame.width < 0.55 * frame.length:
        return 0.0
    inner = circle.distance(points) < 0.75 * circle.radius
    deep = inner & (points[:, 2] < frame.height - 0.02)
    hollow = inner.mean() < 0.05 or deep.sum() > 0.6 * inner.sum()
    return 0.2 + 0.5 * float(hollow) + 0.3 * float(handle)
