"""Finds the thing that a task means among the things on the table, by colour and by shape."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud

from tog_drake.errors import NoChoice
from tog_drake.lexicon import LEXICON
from tog_drake.selectors.colour import chromaticity, fit, rivals, white_balanced
from tog_drake.selectors.likeness import likeness, most_like
from tog_drake.selectors.segmentation import Labels, Mask, cut_out, is_heap, segment
from tog_drake.task import TaskReading, read_task
from tog_drake.values import Array

MIN_FIT = 0.10  # of a colour name, averaged over a thing: less is another colour
CLEAR = 0.45  # what fits less than this share as well as the best is another thing
MIN_LIKENESS = 0.01  # to what a noun says
SIMILAR = 0.6  # what is less like the noun than this share of the best is another thing
RIVAL = 0.5  # a neighbouring colour may fit better, up to 1 / RIVAL times


@dataclass(frozen=True)
class Target:
    """The thing that is meant."""

    mask: Mask  # (N,) of the cloud's points
    how: str  # how it was told, for a person


def find_target(
    reading: TaskReading,
    points: Array,
    normals: Array,
    rgb: NDArray[np.uint8],
    image: NDArray[np.uint8],
) -> Target:
    """Returns the thing that the task means.

    Args:
        points: (N, 3) [m] of the cloud, z up, the table at z = 0.
        normals: (N, 3).
        rgb: (N, 3) their colours.
        image: (H, W, 3) that the cloud was seen in; it tells the colour of the light.

    Raises NoChoice where nothing, or more than one thing, answers to the words.
    """
    chroma = chromaticity(rgb)
    things = _masks(segment(points, chroma))
    if not things:
        raise NoChoice("Nothing that stands on the table is large enough to be an object.")
    noun = next((noun for noun in reading.objects if noun in LEXICON.rules), "")
    if reading.colour is not None:
        rgb = white_balanced(rgb, image)
        fits = fit(rgb, reading.colour)
        things = [
            piece for thing in things for piece in _pieces(thing, points, normals, chroma, fits)
        ]
        return _by_colour(reading.colour, noun, points, rgb, things)
    if len(things) == 1:
        # Shape alone cannot tell that it is not what the task names, so the reason says it.
        taken = f", taken for the {noun}" if noun else ""
        return Target(things[0], f"There is one object{taken}")
    shaped = _shaped(noun, points, things)
    if len(shaped) == 1:
        return Target(shaped[0], f"Of {len(things)} objects the one with the shape of a {noun}")
    alike = f"{len(shaped)} could be a {noun}" if shaped else f"none has the shape of a {noun}"
    if not noun:
        alike = "the task names none of them"
        if reading.objects:
            alike = f"no shape of {reading.objects[0]!r} is known"
    raise NoChoice(
        f"{len(things)} objects are in view and the task does not tell them apart: {alike}. They "
        f"look like {_looks_of(points, things)}. Name its colour, such as 'the red one'."
    )


def target_or_all(
    cloud: PointCloud, words: str, image: NDArray[np.uint8], table_height: float
) -> Target:
    """Returns the thing that words such as "red mug" mean; all things, where none is told.

    Args:
        cloud: of the things on the table, in W, with normals and colours.
        words: of the target; "" where nobody says which it is.
        image: (H, W, 3) that the cloud was seen in.
        table_height: [m] z of the table top in W.
    """
    points = np.asarray(cloud.xyzs().T, np.float64)
    try:
        return find_target(
            read_task(f"take the {words}"),
            points - [0.0, 0.0, table_height],
            np.asarray(cloud.normals().T, np.float64),
            np.asarray(cloud.rgbs().T, np.uint8),
            image,
        )
    except NoChoice:
        return Target(np.ones(len(points), bool), "All things, as none is known to be meant")


def _looks_of(points: Array, things: list[Mask]) -> str:
    return ", ".join(sorted(most_like(points[thing]) for thing in things))


def _masks(label: Labels) -> list[Mask]:
    return [label == i for i in range(int(label.max(initial=-1)) + 1)]


def _pieces(thing: Mask, points: Array, normals: Array, chroma: Array, fits: Array) -> list[Mask]:
    """The thing itself, or, if it is a heap of things, those in it that the colour fits."""
    if not is_heap(points[thing]):
        return [thing]
    pieces = _masks(cut_out(points[thing], normals[thing], chroma[thing], fits[thing]))
    masks = np.zeros((len(pieces), len(points)), dtype=bool)
    for mask, piece in zip(masks, pieces, strict=True):
        mask[thing] = piece
    return list(masks)


def _by_colour(
    colour: str, noun: str, points: Array, rgb: NDArray[np.uint8], things: list[Mask]
) -> Target:
    mean = np.array([_mean_fit(rgb[thing], colour) for thing in things])
    best = mean.max(initial=0.0)
    if best < MIN_FIT:
        seen = ", ".join(sorted({_colour_of(rgb[thing]) for thing in things})) or "something else"
        raise NoChoice(f"Nothing in view is {colour}; what is there is {seen}.")
    near = [thing for thing, m in zip(things, mean, strict=True) if m > CLEAR * best]
    if len(near) == 1:
        return Target(near[0], f"The {colour} object ({colour} fits it to {best:.0%})")
    shaped = _shaped(noun, points, near)
    if len(shaped) == 1:
        return Target(shaped[0], f"The {colour} object with the shape of a {noun}")
    raise NoChoice(
        f"{len(near)} objects in view are {colour}, and their shape does not tell which is meant. "
        "Leave only one in view, or name the object."
    )


def _mean_fit(rgb: NDArray[np.uint8], colour: str) -> float:
    """How well a colour fits a thing; 0 where a neighbouring one fits it far better."""
    mean = float(fit(rgb, colour).mean())
    rival = max((float(fit(rgb, other).mean()) for other in rivals(colour)), default=0.0)
    return mean if mean > RIVAL * rival else 0.0


def _shaped(noun: str, points: Array, things: list[Mask]) -> list[Mask]:
    """The things most like the noun; none where it is not known or nothing is like it."""
    if not noun:
        return []
    like = np.array([likeness(points[thing], LEXICON.rules[noun]) for thing in things])
    if like.max(initial=0.0) < MIN_LIKENESS:
        return []
    return [things[i] for i in np.flatnonzero(like > SIMILAR * like.max())]


def _colour_of(rgb: NDArray[np.uint8]) -> str:
    names = sorted(set(LEXICON.colours.values()))
    return max(names, key=lambda name: float(fit(rgb, name).mean()))
