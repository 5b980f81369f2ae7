"""The geometric selector: words and shape, no model and no ground truth.

It reads which object, which part and which intent the task names, cuts the cloud into things,
finds the one that is meant by its colour and shape, finds the part by shape, and takes the best
grasp there. What it cannot resolve it says; it never guesses silently.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.errors import InputError, NoChoice, NoGrasp
from tog_drake.lexicon import LEXICON, Rule
from tog_drake.panda import FINGERTIP_Z, PAD_WIDTH
from tog_drake.selector import choose
from tog_drake.selectors.parts import PartNotFound, Region, find_part, rule_of
from tog_drake.selectors.segmentation import Mask
from tog_drake.selectors.targets import find_target
from tog_drake.task import TaskReading, read_task
from tog_drake.values import Array, Candidates, Choice, ChoiceStatus, Grasps, View, Workspace

REACH = 0.012  # [m] a contact farther from the target's points than this is not on it


@dataclass
class Geometric:
    """Reads words and shape; needs neither a model nor the network."""

    min_on_part: float = 0.5
    """A grasp is on a part when at least this share of the points between the pads is."""
    unresolved: str = "fail"
    """What to do where the words are not understood, or the part that they name is not seen or has
    no grasp on it: "fail" raises NoChoice, "top-score" takes the best grasp on the object that
    is not on a part to be avoided, and says so in the choice's status. A part to be avoided that
    is not seen raises NoChoice either way."""
    margin: float = 0.03
    """[m] A grasp this far inside its part is as good as any; nearer its edge it counts less."""


@dataclass(frozen=True)
class _Wanted:
    """Where on the target to grasp, and where not."""

    mask: Mask  # (M,) of the target's points
    avoided: Mask  # (M,)
    part: str | None
    status: ChoiceStatus
    how: str


class GeometricSelector:
    """Chooses by the words of the task and the shape of the cloud."""

    def __init__(self, config: Geometric, workspace: Workspace):
        if config.unresolved not in ("fail", "top-score"):
            raise InputError(
                f"!Geometric: unresolved: {config.unresolved!r}; valid: fail, top-score"
            )
        self._config = config
        self._table = workspace.table_height

    def select(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Choice:
        """Returns the best grasp on the part that the task asks for.

        Raises:
            NoChoice: it cannot tell which object is meant, the task says to leave things alone,
                every grasp is on a part to be avoided or that part is not found, or, where
                ``unresolved`` is "fail", the part to hold cannot be told or had.
            NoGrasp: no grasp is on the object.
            InputError: the task is empty.
        """
        reading = read_task(task)
        if reading.forbidden:
            raise NoChoice(f"The task {task!r} says to leave things alone; so does the robot.")
        grasps = candidates.grasps
        if len(grasps) == 0:
            raise NoGrasp("There is no feasible grasp to choose from; move the object nearer.")
        points = np.asarray(cloud.xyzs().T, dtype=np.float64) - [0.0, 0.0, self._table]
        rgb = np.asarray(cloud.rgbs().T, dtype=np.uint8)
        normals = np.asarray(cloud.normals().T, dtype=np.float64)
        target = find_target(reading, points, normals, rgb, view.rgb)
        grasps = _lowered(grasps, self._table)
        on_target = _on_target(grasps, points, target.mask)
        if not on_target.any():
            raise NoGrasp(
                f"{target.how}; none of {len(grasps)} feasible grasps is on it. Turn it, or "
                "clear what is around it."
            )
        wanted = _wanted(reading, points[target.mask])
        held = _Held(grasps, points[target.mask])
        fits = on_target & held.on(wanted.mask, self._config.min_on_part)
        status, part, how = wanted.status, wanted.part, wanted.how
        if not fits.any():
            fits = on_target & ~held.on(wanted.avoided, 1.0 - self._config.min_on_part)
            if not fits.any():
                avoided = " and ".join(reading.avoid)
                raise NoChoice(f"{target.how}; every grasp on it is on its {avoided}.")
            if status == "ok":
                status, part = "no_grasp_on_part", None
                how += f"; none of {on_target.sum()} grasps on the object is there"
        if status != "ok":
            if self._config.unresolved == "fail":
                raise NoChoice(f"{target.how}; {how}. {_advice(status)}")
            how += "; any grasp on the object instead"
        worth = np.where(fits, held.value(wanted.mask, self._config.margin), -np.inf)
        index = int(np.argmax(worth))
        reason = f"{target.how}; {how}; best of {fits.sum()} grasps."
        return choose(index, view, candidates, reason, status=status, part=part, worth=worth)


def _advice(status: ChoiceStatus) -> str:
    """What to do where the part cannot be told or had."""
    if status == "unresolved":
        return (
            "Understood are: " + ", ".join(sorted(set(LEXICON.parts.values()))) + " as parts, "
            "and 'use', 'hand me', 'pick up' or a verb such as pour, cut, stir as purpose."
        )
    return "Show it from another side, name another part, or set unresolved: top-score."


class _Held:
    """What of a thing each grasp holds."""

    def __init__(self, grasps: Grasps, thing: Array):
        self._grasps = grasps
        self._thing = thing
        self._between = _between(grasps, thing)
        self._contact = cKDTree(thing).query(grasps.p_WContact)[1]  # (N,) row of the thing

    def share(self, part: Mask) -> Array:
        """The share (N,) of the points between the pads that are of the part."""
        count = self._between.sum(axis=1)
        of_part = (self._between & part).sum(axis=1)
        share = np.where(count > 0, of_part / np.maximum(count, 1), part[self._contact])
        return np.asarray(share, dtype=np.float64)

    def on(self, part: Mask, min_share: float) -> Mask:
        """Whether (N,) at least ``min_share`` of what each grasp holds is on the part."""
        return np.asarray(self.share(part) >= min_share)

    def value(self, part: Mask, margin: float) -> Array:
        """The worth (N,) of each grasp: its confidence, more where it is well within the part."""
        inside, touches = np.ones(len(self._grasps)), np.ones(len(self._grasps))
        if part.any() and not part.all():
            rest = cKDTree(self._thing[~part])
            inside = np.minimum(rest.query(self._grasps.X_WG[:, :3, 3])[0] / margin, 1.0)
            # A pad reaches half its width beyond the contact.
            touches = np.minimum(rest.query(self._grasps.p_WContact)[0] / (PAD_WIDTH / 2), 1.0)
        on_part = (0.1 + self.share(part) ** 2) * (0.3 + 0.7 * inside) * (0.4 + 0.6 * touches)
        return np.asarray(self._grasps.score**2 * on_part)


def _lowered(grasps: Grasps, table: float) -> Grasps:
    """The grasps in a frame with the table at z = 0."""
    X = grasps.X_WG.copy()
    X[:, 2, 3] -= table
    return Grasps(X, grasps.width, grasps.score, grasps.p_WContact - [0.0, 0.0, table])


def _on_target(grasps: Grasps, points: Array, target: Mask) -> Mask:
    """Whether (N,) the contact of each grasp is on the target, and nothing else nearer to it."""
    contact = grasps.p_WContact
    near = cKDTree(points[target]).query(contact)[0]
    on = near < REACH
    if not target.all():
        on &= near <= cKDTree(points[~target]).query(contact)[0]
    return np.asarray(on)


def _between(grasps: Grasps, points: Array) -> Mask:
    """Which points (N, M) lie between the pads of each grasp, or just in front of the palm."""
    R = grasps.X_WG[:, :3, :3].astype(np.float32)
    origin = np.einsum("nji,nj->ni", grasps.X_WG[:, :3, :3], grasps.X_WG[:, :3, 3])
    p_G = np.tensordot(R, points.astype(np.float32), axes=(1, 1))  # (N, 3, M)
    p_G -= origin.astype(np.float32)[:, :, None]
    half = (grasps.width.astype(np.float32) / 2 + 0.006)[:, None]
    x, y, z = p_G[:, 0], p_G[:, 1], p_G[:, 2]
    inside = (np.abs(x) < PAD_WIDTH / 2) & (np.abs(y) < half)
    return np.asarray(inside & (z > -0.015) & (z < FINGERTIP_Z + 0.003))


def _wanted(reading: TaskReading, thing: Array) -> _Wanted:
    """Where the task asks to grasp the target; all but what it says to avoid where it does not say.

    Raises NoChoice where a part to be avoided is not found.
    """
    avoided = _avoided(reading, thing)
    away = "".join(f"; away from its {name}" for name in reading.avoid)
    if reading.unknown:
        how = "not understood: " + ", ".join(map(repr, reading.unknown)) + away
        return _Wanted(~avoided, avoided, None, "unresolved", how)
    if not (reading.parts or reading.avoid or reading.intent in {"use", "handover"}):
        if reading.intent == "hold":
            how = "the task names no part, so any will do"
            return _Wanted(~avoided, avoided, None, "ok", how)
        how = "the task says neither part nor purpose"
        return _Wanted(~avoided, avoided, None, "unresolved", how)
    try:
        rule, how = rule_of(reading.objects, thing)
    except PartNotFound as not_found:
        return _Wanted(~avoided, avoided, None, "part_not_found", str(not_found))
    names = _names(reading, rule)
    regions, missing = _find(thing, names, rule)
    how = "; ".join([how, *(region.how for region in regions.values()), *missing]) + away
    mask = ~avoided
    if regions:
        mask &= np.any([region.mask for region in regions.values()], axis=0)
    status: ChoiceStatus = "part_not_found" if names and not regions else "ok"
    return _Wanted(mask, avoided, " or ".join(regions) or None, status, how)


def _avoided(reading: TaskReading, thing: Array) -> Mask:
    """What of the thing (M,) the task says to keep off.

    Where a part of it is not found, no grasp is known to be off it: NoChoice, whatever the policy.
    """
    if not reading.avoid:
        return np.zeros(len(thing), dtype=bool)
    try:
        rule, _ = rule_of(reading.objects, thing)
        masks = [find_part(thing, name, rule).mask for name in reading.avoid]
    except PartNotFound as not_found:
        raise NoChoice(
            f"The task says to keep off the {' and the '.join(reading.avoid)}, and where that is "
            f"cannot be told: {not_found}. Show the object from another side, or say which part "
            "to hold instead."
        ) from not_found
    return np.asarray(np.any(masks, axis=0))


def _find(thing: Array, names: tuple[str, ...], rule: Rule) -> tuple[dict[str, Region], list[str]]:
    """The regions of those parts that are found, and why the others are not."""
    regions, missing = {}, []
    for name in names:
        try:
            regions[name] = find_part(thing, name, rule)
        except PartNotFound as not_found:
            missing.append(str(not_found))
    return regions, missing


def _names(reading: TaskReading, rule: Rule) -> tuple[str, ...]:
    """The parts to hold: those named, else that of the intent unless it is to be avoided."""
    if reading.parts:
        return reading.parts
    by_intent = {"use": LEXICON.kinds[rule.kind].use, "handover": rule.working}
    part = by_intent.get(reading.intent or "")
    return (part,) if part is not None and part not in reading.avoid else ()
