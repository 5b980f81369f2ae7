"""Finds the thing that a task means among the things on the table, by colour and by shape."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from tog_drake.errors import NoChoice
from tog_drake.selectors.colour import fit
from tog_drake.selectors.parts import RULES, Mask, fits_kind
from tog_drake.selectors.segmentation import Labels
from tog_drake.task import COLOUR_WORDS, TaskReading
from tog_drake.values import Array

MIN_FIT = 0.10  # of a colour name, averaged over a thing: less is another colour
CLEAR = 0.6  # what fits less than this share as well as the best is another thing
TOUCHING = 0.008  # [m] between pieces of one thing
APART = 0.12  # [m] between two pieces of the named colour with a third between them


@dataclass(frozen=True)
class Target:
    """The thing that is meant."""

    mask: Mask  # (N,) of the cloud's points
    how: str  # how it was told, for a person


def find_target(
    reading: TaskReading, points: Array, rgb: NDArray[np.uint8], label: Labels
) -> Target:
    """Returns the thing that the task means.

    Args:
        points: (N, 3) [m] of the cloud, z up, the table at z = 0.
        rgb: (N, 3) their colours.
        label: (N,) the thing each belongs to, −1 for specks.

    Raises NoChoice where nothing, or more than one thing, answers to the words.
    """
    count = int(label.max(initial=-1)) + 1
    if count == 0:
        raise NoChoice("Nothing that stands on the table is large enough to be an object.")
    things = [label == i for i in range(count)]
    if reading.colour is not None:
        return _by_colour(reading, reading.colour, points, rgb, things)
    if count == 1:
        return Target(things[0], "there is one object")
    shaped = _shaped(reading, points, things)
    if len(shaped) == 1:
        return Target(
            shaped[0], f"the one of {count} objects that has the shape of a {_noun(reading)}"
        )
    raise NoChoice(
        f"{count} objects are in view and the task does not tell them apart"
        + (f": {len(shaped)} could be a {_noun(reading)}" if _noun(reading) else "")
        + ". Name its colour, such as 'the red one'."
    )


def _by_colour(
    reading: TaskReading, colour: str, points: Array, rgb: NDArray[np.uint8], things: list[Mask]
) -> Target:
    fits = fit(rgb, colour)
    things = _grouped(points, fits, things)
    mean = np.array([fits[thing].mean() for thing in things])
    best = mean.max()
    if best < MIN_FIT:
        seen = sorted({_colour_of(rgb[thing]) for thing in things})
        raise NoChoice(f"Nothing in view is {colour}; what is there is {', '.join(seen)}.")
    near = [thing for thing, m in zip(things, mean, strict=True) if m > CLEAR * best]
    told = f"the {colour} object"
    if len(near) > 1:
        shaped = _shaped(reading, points, near)
        if len(shaped) == 1:
            return Target(shaped[0], f"{told} that has the shape of a {_noun(reading)}")
        raise NoChoice(
            f"{len(near)} objects in view are {colour}, and their shape does not tell which is "
            f"meant. Leave only one in view, or name the object."
        )
    others = f" of {len(things)}" if len(things) > 1 else ""
    return Target(near[0], f"{told}{others} ({colour} fits it to {best:.0%})")


def _grouped(points: Array, fits: Array, things: list[Mask]) -> list[Mask]:
    """Joins pieces of a cut heap: those of the named colour, with what lies between them.

    A black grip between the orange body and the orange battery is part of the orange drill.
    """
    mean = np.array([fits[thing].mean() for thing in things])
    coloured = [
        i for i in np.argsort(-mean, kind="stable") if mean[i] > max(MIN_FIT, 0.5 * mean.max())
    ]
    trees = [cKDTree(points[thing]) for thing in things]

    def gap(i: int, j: int) -> float:
        return float(trees[i].query(points[things[j]])[0].min())

    group = np.arange(len(things))
    for n, i in enumerate(coloured):
        for j in coloured[n + 1 :]:
            if group[i] == group[j] or gap(i, j) > APART:
                continue
            if gap(i, j) < TOUCHING:
                between = []
            else:
                inside = _hull(points, things[i] | things[j])
                between = [k for k in range(len(things)) if k != i and k != j and inside(things[k])]
                if not any(gap(i, k) < TOUCHING and gap(j, k) < TOUCHING for k in between):
                    continue
            for k in [j, *between]:
                group[group == group[k]] = group[i]
    return [
        np.any([things[k] for k in np.flatnonzero(group == g)], axis=0) for g in np.unique(group)
    ]


def _hull(points: Array, corners: Mask) -> Callable[[Mask], bool]:
    """Whether, seen from above, most of a thing lies within the convex hull of ``corners``."""
    try:
        xy = points[corners, :2]
        hull = Delaunay(xy[ConvexHull(xy).vertices])
    except QhullError:  # all on a line
        return lambda thing: False
    return lambda thing: bool((hull.find_simplex(points[thing, :2]) >= 0).mean() > 0.7)


def _shaped(reading: TaskReading, points: Array, things: list[Mask]) -> list[Mask]:
    """The things that have the shape of the first noun that is known."""
    noun = _noun(reading)
    return [t for t in things if noun and fits_kind(points[t], RULES[noun].kind)]


def _noun(reading: TaskReading) -> str:
    return next((noun for noun in reading.objects if noun in RULES), "")


def _colour_of(rgb: NDArray[np.uint8]) -> str:
    names = sorted(set(COLOUR_WORDS.values()))
    return max(names, key=lambda name: float(fit(rgb, name).mean()))
