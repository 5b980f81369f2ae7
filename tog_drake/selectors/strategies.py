"""How a vision-language model is asked for a grasp: five strategies of the paper, and two more.

Each is a function of the scene and of a way to ask; it raises Unanswered where an answer is no
use, and never takes another grasp instead.

==========  ======================================================================
gsi         one picture with the hands of all candidates; the model names one
cpsi        one picture with the contact points of all candidates; it names one
gmi         a picture for each candidate with its hand; it names a picture
cpmi        a picture for each candidate with its contact point; it names a picture
cpg         it points at the place to hold; of *all* feasible grasps the nearest wins
pivot       gsi in up to three rounds, each with grasps around the winner of the last
            (Nasiriany et al. 2024)
avoid       it points at the place to hold and at one to keep off
==========  ======================================================================

The first five are published in arXiv 2502.04873.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.errors import InputError, Unanswered
from tog_drake.panda import grasps_apart
from tog_drake.selectors import prompts
from tog_drake.selectors.marks import (
    Framing,
    Mark,
    Rendering,
    draw_contacts,
    draw_grippers,
    plain,
)
from tog_drake.selectors.pointed import avoid, cpg
from tog_drake.selectors.scene import Ask, Pick, Scene, Strategy
from tog_drake.selectors.vlm.question import Image, Options, Question
from tog_drake.values import Array, Grasps, View
from tog_drake.visibility import mark_states

DASHED = "\n\nA mark that is dashed is at a place that is hidden in the picture."
ROUNDS = 3  # of pivot
PIVOT_MARKS = 6  # in each of them: more crowd an image
_NARROWING = 4  # each round looks at this fraction of the grasps of the last
_LEVER = 0.05  # [m/rad] a turn counts as much as moving the finger tips by it

Rows = NDArray[np.int64]
_Draw = Callable[[View, Framing, Grasps, Sequence[Mark], Rendering], Image]


def gsi(scene: Scene, ask: Ask) -> Pick:
    """Gripper, single image: the hands of all candidates in one picture."""
    return _pick_marked(scene, ask, "gsi", draw_grippers, separate=False)


def cpsi(scene: Scene, ask: Ask) -> Pick:
    """Contact point, single image: the contact points of all candidates in one picture."""
    return _pick_marked(scene, ask, "cpsi", draw_contacts, separate=False)


def gmi(scene: Scene, ask: Ask) -> Pick:
    """Gripper, multiple images: one picture for the hand of each candidate."""
    return _pick_marked(scene, ask, "gmi", draw_grippers, separate=True)


def cpmi(scene: Scene, ask: Ask) -> Pick:
    """Contact point, multiple images: one picture for the contact point of each candidate."""
    return _pick_marked(scene, ask, "cpmi", draw_contacts, separate=True)


def pivot(scene: Scene, ask: Ask) -> Pick:
    """Rounds of gsi: a sample of all feasible grasps, then of those around the winner."""
    grasps = scene.candidates.grasps
    pool: Rows = np.arange(len(grasps))
    winner = int(np.argmax(grasps.score))
    for round_ in range(1, ROUNDS + 1):
        rows = _spread(grasps, pool, winner)
        winner, label = _ask_marked(scene, ask, rows, "pivot", draw_grippers, round_=round_)
        if len(pool) <= PIVOT_MARKS:
            break  # all of it has been shown
        apart = _apart(grasps, pool, winner)
        pool = pool[np.argsort(apart, kind="stable")[: -(-len(pool) // _NARROWING)]]
    reason = (
        f"pivot: of {len(grasps)} feasible grasps the model chose, in round {round_}, the one "
        f"marked {label}."
    )
    worth = -_apart(grasps, np.arange(len(grasps)), winner)
    return Pick(winner, reason, worth)


STRATEGIES: dict[str, Strategy] = {
    "gsi": gsi,
    "cpsi": cpsi,
    "gmi": gmi,
    "cpmi": cpmi,
    "cpg": cpg,
    "pivot": pivot,
    "avoid": avoid,
}
POINTING = ("cpg", "avoid")  # in these the model tells places in the picture
CROWDED = ("gsi", "cpsi")
"""They mark all candidates in one picture, where colours must tell them apart."""
PERMUTABLE = ("gsi", "cpsi", "gmi", "cpmi")
"""They mark the same candidates however these are permuted, so two answers can be compared."""


def own_prompt(file: Path, strategy: str, rendering: Rendering) -> prompts.Prompt:
    """Returns the text in a file of one's own by which a strategy is to ask.

    Raises:
        InputError: see ``prompts.read``; it may have the places of the strategy's own text alone.
    """
    values: dict[str, Any] = {"task": "use the hammer"}
    if strategy not in POINTING:
        values |= {"rendering": rendering, "labels": ("1", "2"), "count": 2}
    if strategy == "pivot":
        values |= {"round": 1, "rounds": ROUNDS}
    return prompts.read(file, values)


def _pick_marked(scene: Scene, ask: Ask, name: str, draw: _Draw, *, separate: bool) -> Pick:
    index = scene.candidates.index
    row, label = _ask_marked(scene, ask, index, name, draw, separate=separate)
    return Pick(row, f"{name}: of {len(index)} candidates the model chose the one marked {label}.")


def _ask_marked(
    scene: Scene,
    ask: Ask,
    rows: Rows,
    name: str,
    draw: _Draw,
    *,
    separate: bool = False,
    round_: int = 0,
) -> tuple[int, str]:
    """Marks some grasps, asks for one of them, and returns its row and its label.

    Args:
        scene: what is seen, and how marks are drawn.
        ask: asks the model.
        rows: of ``Candidates.grasps``, to be marked.
        name: of the strategy, and of its prompt.
        draw: what a mark is.
        separate: whether each has a picture of its own.
        round_: of ROUNDS, where there are some.
    """
    states = mark_states(scene.candidates.grasps.take(rows), scene.view, dots=draw is draw_contacts)
    kept = [row for row, state in zip(rows, states, strict=True) if state != "dropped"]
    if not kept:
        raise Unanswered(
            "off_image",
            f"all {len(rows)} grasps are outside the view that is shown: show another one "
            "(--view coverage)",
        )
    rows, marks = _shuffled(scene, np.array(kept), separate=separate, round_=round_)
    labels = tuple(mark.label for mark in marks)
    prompt = scene.prompt or prompts.load(name)
    values = {"round": round_, "rounds": ROUNDS} if round_ else {}
    text = prompt.render(
        task=scene.task, rendering=scene.rendering, labels=labels, count=len(labels), **values
    )
    if "dashed" in states:
        text += DASHED
    label = ask(
        Question(
            prompt=prompt.version,
            parts=(*_pictures(scene, rows, marks, draw, separate=separate), text),
            expects=Options(labels),
            marks={label: int(row) for label, row in zip(labels, rows, strict=True)},
        )
    )
    assert isinstance(label, str)
    return int(rows[labels.index(label)]), label


def _pictures(
    scene: Scene, rows: Rows, marks: Sequence[Mark], draw: _Draw, *, separate: bool
) -> list[str | Image]:
    """Returns the pictures of a question: the things unmarked, if at all, and then the marked."""
    grasps = scene.candidates.grasps
    framing = scene.framing(grasps.take(rows))
    parts: list[str | Image] = []
    if scene.rendering == "marked":
        parts.append(plain(scene.view, framing))
    if not separate:
        return [*parts, draw(scene.view, framing, grasps.take(rows), marks, scene.rendering)]
    for row, mark in zip(rows, marks, strict=True):
        one = grasps.take(np.array([row]))
        picture = draw(scene.view, framing, one, [mark], scene.rendering)
        parts += [f"Image {mark.label}:", picture]
    return parts


def _shuffled(scene: Scene, rows: Rows, *, separate: bool, round_: int) -> tuple[Rows, list[Mark]]:
    """Returns the rows in the order in which they are shown, and the mark of each.

    Models prefer first and last places and certain colours (arXiv 2410.16983, 2512.17875), so both
    are drawn by the scene's seed, and anew in every round: else the winner of a round would have
    the same mark in the next. In the other permutation every row has moved by half of all.
    """
    count = len(rows)
    if not separate:
        check_count(count)
    rng = np.random.default_rng([scene.seed, round_])
    order, colors = rng.permutation(count), rng.permutation(count)
    if scene.permutation:
        order = np.roll(order, max(count // 2, 1))
    by_color = scene.rendering == "paper" and not separate
    marks = []
    for place, i in enumerate(colors):
        color, rgb = CANDIDATE_COLORS[i % len(CANDIDATE_COLORS)]
        marks.append(Mark(label=color if by_color else str(place + 1), color=rgb))
    return rows[order], marks


def check_count(count: int) -> None:
    """Raises InputError where there are no colours for so many candidates in one picture."""
    most = len(CANDIDATE_COLORS)
    if count > most:
        raise InputError(
            f"{count} candidates are to be marked in one picture, and {most} colours tell them "
            f"apart: set candidates.k (--k) to at most {most}, or take a strategy with a picture "
            "for each, gmi or cpmi"
        )


def _spread(grasps: Grasps, pool: Rows, first: int) -> Rows:
    """Returns up to PIVOT_MARKS rows of the pool: ``first``, then always the one farthest from
    those that are taken."""
    picked = [first]
    apart = _apart(grasps, pool, first)
    while len(picked) < PIVOT_MARKS and apart.max() > 0:
        picked.append(int(pool[np.argmax(apart)]))
        apart = np.minimum(apart, _apart(grasps, pool, picked[-1]))
    return np.array(picked)


def _apart(grasps: Grasps, rows: Rows, other: int) -> Array:
    """How far (n,) [m] some grasps are from another one; a turn counts as its lever."""
    place, turn = grasps_apart(grasps.X_WG[rows], grasps.X_WG[other])
    return place + _LEVER * turn
