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
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.errors import InputError, NoChoice
from tog_drake.panda import grasps_apart
from tog_drake.pinhole import project
from tog_drake.selectors import prompts
from tog_drake.selectors.marks import (
    Framing,
    Mark,
    Rendering,
    draw_contacts,
    draw_grippers,
    frame_things,
    plain,
    whole_image,
)
from tog_drake.selectors.vlm.question import Answer, Image, Options, Points, Question, Unanswered
from tog_drake.values import Array, Candidates, Grasps, View

MAX_MISS = 15.0
"""[pixel] in a view 640 wide, in proportion in others: a point that misses everything that was
seen by more is on no object. At half a metre from the camera it is about 1 cm."""
MAX_REACH = 0.04
"""[m] A grasp whose contact is farther from the place pointed at does not hold that place. Fingers
touch the sides of a handle and a model points at its top, which may be half a hand's opening
away. The paper has no such limit, nor has its rendering."""
KEEP_OFF = 0.03  # [m] contacts nearer than this to the place to avoid are dropped

ROUNDS = 3  # of pivot
PIVOT_MARKS = 6  # in each of them: more crowd an image
_NARROWING = 4  # each round looks at this fraction of the grasps of the last
_LEVER = 0.05  # [m/rad] a turn counts as much as moving the finger tips by it

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Scene:
    """What a strategy may know."""

    view: View
    points: Array  # (M, 3) [m] of the cloud, in W
    candidates: Candidates
    task: str
    rendering: Rendering
    seed: int  # of the order and the colours of the marks
    permutation: int = 0  # 0 or 1: with 1 every mark has another number and colour than with 0


@dataclass(frozen=True)
class Pick:
    """The grasp that the answers of a model single out."""

    index: int  # row of ``Candidates.grasps``
    reason: str  # for a person
    worth: Array | None = None  # (N,) of each grasp, −∞ where not at all; None: see ``choose``
    pointed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Role -> (u, v) in the view, where the model was asked to point."""


Ask = Callable[[Question], Answer]
"""Asks a model and returns its answer; raises Unanswered where there is none."""
Strategy = Callable[[Scene, Ask], Pick]
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


def cpg(scene: Scene, ask: Ask) -> Pick:
    """Contact point guided: the feasible grasp whose contact is nearest to where it points."""
    pixels, (grasp,) = _seen_points(scene, ask, "cpg", ("grasp",))
    pick = _nearest(scene, grasp, np.ones(len(scene.candidates.grasps), bool))
    return replace(pick, pointed=pixels)


def avoid(scene: Scene, ask: Ask) -> Pick:
    """As cpg, without the grasps that are nearer to the place to avoid, or close to it."""
    pixels, (grasp, avoided) = _seen_points(scene, ask, "avoid", ("grasp", "avoid"))
    contacts = scene.candidates.grasps.p_WContact
    away = np.linalg.norm(contacts - avoided, axis=1)
    allowed = (away > KEEP_OFF) & (away > np.linalg.norm(contacts - grasp, axis=1))
    return replace(_nearest(scene, grasp, allowed), pointed=pixels)


def pivot(scene: Scene, ask: Ask) -> Pick:
    """Rounds of gsi: a sample of all feasible grasps, then of those around the winner."""
    grasps = scene.candidates.grasps
    pool: Rows = np.arange(len(grasps))
    winner = int(np.argmax(grasps.score))
    for round_ in range(1, ROUNDS + 1):
        rows = _spread(grasps, pool, winner)
        winner, label = _ask_marked(
            scene, ask, rows, "pivot", draw_grippers, round=round_, rounds=ROUNDS
        )
        if len(pool) <= PIVOT_MARKS:
            break  # all of it has been shown
        apart = _apart(grasps, pool, winner)
        pool = pool[np.argsort(apart, kind="stable")[: -(-len(pool) // _NARROWING)]]
    reason = (
        f"pivot: in round {round_} the model chose {label}, {len(grasps)} feasible grasps at first."
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
PERMUTABLE = ("gsi", "cpsi", "gmi", "cpmi")
"""They mark the same candidates however these are permuted, so two answers can be compared."""


def _pick_marked(scene: Scene, ask: Ask, name: str, draw: _Draw, *, separate: bool) -> Pick:
    index = scene.candidates.index
    row, label = _ask_marked(scene, ask, index, name, draw, separate=separate)
    return Pick(row, f"{name}: the model chose {label} of {len(index)} candidates.")


def _ask_marked(
    scene: Scene,
    ask: Ask,
    rows: Rows,
    name: str,
    draw: _Draw,
    *,
    separate: bool = False,
    **values: int,
) -> tuple[int, str]:
    """Marks some grasps, asks for one of them, and returns its row and its label.

    Args:
        scene: what is seen, and how marks are drawn.
        ask: asks the model.
        rows: of ``Candidates.grasps``, to be marked.
        name: of the prompt.
        draw: what a mark is.
        separate: whether each has a picture of its own.
        values: what the prompt says besides.
    """
    grasps = scene.candidates.grasps
    rows, marks = _shuffled(scene, rows, separate)
    framing = _framing(scene, grasps.take(rows))
    reference = [plain(scene.view, framing)] if scene.rendering == "marked" else []
    parts: list[str | Image] = list(reference)
    if separate:
        for row, mark in zip(rows, marks, strict=True):
            one = grasps.take(np.array([row]))
            parts += [
                f"Image {mark.label}:", draw(scene.view, framing, one, [mark], scene.rendering)
            ]  # fmt: skip
    else:
        parts.append(draw(scene.view, framing, grasps.take(rows), marks, scene.rendering))
    labels = tuple(mark.label for mark in marks)
    prompt = prompts.load(name)
    text = prompt.render(
        task=scene.task, rendering=scene.rendering, labels=labels, count=len(labels), **values
    )
    label = ask(
        Question(
            prompt=prompt.version,
            parts=(*parts, text),
            expects=Options(labels),
            marks={label: int(row) for label, row in zip(labels, rows, strict=True)},
        )
    )
    assert isinstance(label, str)
    return int(rows[labels.index(label)]), label


def _shuffled(scene: Scene, rows: Rows, separate: bool) -> tuple[Rows, list[Mark]]:
    """Returns the rows in the order in which they are shown, and the mark of each.

    Models prefer first and last places and certain colours (arXiv 2410.16983, 2512.17875), so both
    are drawn by the scene's seed. In the other permutation every row has moved by half of all.
    """
    count, most = len(rows), len(CANDIDATE_COLORS)
    if count > most:
        raise InputError(
            f"{count} candidates are to be marked, and {most} colours tell them apart: set "
            f"candidates.k to at most {most}"
        )
    rng = np.random.default_rng(scene.seed)
    order, colors = rng.permutation(count), rng.permutation(count)
    if scene.permutation:
        order = np.roll(order, max(count // 2, 1))
    by_color = scene.rendering == "paper" and not separate
    marks = []
    for place, i in enumerate(colors):
        color, rgb = CANDIDATE_COLORS[i]
        marks.append(Mark(label=color if by_color else str(place + 1), color=rgb))
    return rows[order], marks


def _framing(scene: Scene, marked: Grasps) -> Framing:
    """The part of the view that is sent, and at which size."""
    if scene.rendering == "paper":
        return whole_image(scene.view)
    return frame_things(scene.view, scene.points, marked)


def _seen_points(
    scene: Scene, ask: Ask, name: str, roles: tuple[str, ...]
) -> tuple[dict[str, tuple[float, float]], list[Array]]:
    """Asks for a point in the picture for each role; returns their pixels in the view by role, and
    the points in W that are seen there."""
    framing = _framing(scene, scene.candidates.grasps)
    prompt = prompts.load(name)
    answer = ask(
        Question(
            prompt=prompt.version,
            parts=(plain(scene.view, framing), prompt.render(task=scene.task)),
            expects=Points(roles, framing.size),
        )
    )
    assert isinstance(answer, dict)
    pixels = {role: framing.to_view(answer[role]) for role in roles}
    points = [_seen_point(scene, pixel, role) for role, pixel in pixels.items()]
    return {role: (float(u), float(v)) for role, (u, v) in pixels.items()}, points


def _seen_point(scene: Scene, pixel: Array, role: str) -> Array:
    """Returns the point of the cloud, (3,) in W, that is seen nearest to a pixel (2,) of the view.

    Raises Unanswered where the pixel is outside the view, or on nothing that was seen.
    """
    camera = scene.view.intrinsics
    u, v = pixel
    where = f"the point to {role}, ({u:.0f}, {v:.0f}) in the view,"
    if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
        raise Unanswered(
            "off_image", f"{where} is outside the view of {camera.width}×{camera.height}"
        )
    miss = np.linalg.norm(project(scene.points, camera, scene.view.X_WC) - pixel, axis=1)
    miss = np.where(np.isfinite(miss), miss, np.inf)
    nearest = int(np.argmin(miss))
    limit = MAX_MISS * max(camera.width, camera.height) / 640
    if miss[nearest] > limit:
        raise Unanswered(
            "off_object",
            f"{where} is on no object: the nearest is {miss[nearest]:.0f} pixels away, and "
            f"{limit:.0f} would do",
        )
    return np.asarray(scene.points[nearest])


def _nearest(scene: Scene, point: Array, allowed: NDArray[np.bool_]) -> Pick:
    """Returns the allowed grasp whose contact is nearest to a point, (3,) in W."""
    distance = np.linalg.norm(scene.candidates.grasps.p_WContact - point, axis=1)
    reach = np.inf if scene.rendering == "paper" else MAX_REACH
    fits = allowed & (distance <= reach)
    if not fits.any():
        raise NoChoice(_why_none(distance, allowed), status="no_grasp_on_part")
    worth = np.where(fits, -distance, -np.inf)
    index = int(np.argmax(worth))
    reason = (
        f"The contact nearest to where the model points, {1e3 * distance[index]:.0f} mm away, "
        f"of {fits.sum()} grasps there."
    )
    return Pick(index, reason, worth)


def _why_none(distance: Array, allowed: NDArray[np.bool_]) -> str:
    if not allowed.any():
        return (
            f"All {len(allowed)} feasible grasps are nearer to the place to avoid than to the "
            f"place to hold, or within {100 * KEEP_OFF:.0f} cm of it."
        )
    dropped = f" {(~allowed).sum()} others are at the place to avoid." if not allowed.all() else ""
    return (
        f"No feasible grasp holds the place that the model points at: the nearest of "
        f"{allowed.sum()} contacts is {100 * distance[allowed].min():.1f} cm away, and at most "
        f"{100 * MAX_REACH:.0f} cm are allowed.{dropped}"
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
