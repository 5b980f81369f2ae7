"""The record of an episode: the content of ``episode.json`` and of ``--json``."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypedDict, get_args

from tog_drake.decision import STAGES, Decision
from tog_drake.errors import NoFeasibleGrasp
from tog_drake.files import write_atomically
from tog_drake.pipeline import PROPOSERS, SCORERS, SELECTORS, PipelineConfig
from tog_drake.proposers.answered import AnsweredGrasps
from tog_drake.selectors.oracle import ORACLE_NOTE, Oracle
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.selectors.vlm.specification import specification
from tog_drake.values import CameraView, Choice, GraspMotion, Grasps, NextLook
from tog_drake.view_scorers.vlm_compare import VlmCompare
from tog_drake.visibility import MarkState, mark_states, shown_in
from tog_drake.vlm_record import (
    ExchangeRecord,
    VlmRecord,
    exchange_records,
    exchanges_of,
    vlm_record,
)

SCHEMA = "tog_drake/episode/1"
"""Name and version; the number changes when a field changes its meaning or goes away."""


class ChoiceRecord(TypedDict):
    """What the selector decided."""

    index: int  # row among the feasible grasps, best first
    planned_index: int | None  # the row that the motion carries out: this one or an alternative
    part: str | None  # the part that the selector believes to hold
    reason: str
    status: str  # "ok", or what the selector could not resolve
    pixel: list[float] | None  # [u, v] of the contact point in the view
    pointed: dict[str, list[float]]  # role -> [u, v] in the view, where a model pointed
    score: float  # the proposer's confidence
    width: float  # [m] between the contacts


class ViewSelectionRecord(TypedDict):
    """In which view whoever chose was shown the grasps."""

    scorer: dict[str, Any]  # {"kind": who compared the views, its settings}
    camera: str  # the one that is shown
    scores: dict[str, float]  # camera -> score, higher is less ambiguous; of !Hand 1 and 0
    reason: str
    status: str  # "ok"; "not_found": no view shows the target, so the pipeline's own is shown
    candidates_visible: dict[str, int]
    """Camera -> candidates of which it sees a contact; with !Hand and no fusion its own alone."""
    marks: dict[str, list[int]]
    """"shown", "dashed" or "dropped" -> candidates, as rows of the feasible grasps, whose mark is
    so in the view that is shown (see ``visibility.mark_states``)."""


class AlignmentRecord(TypedDict):
    """How far the pose of a camera is off, taken that of the pipeline's own camera is right."""

    shift: float  # [m] of the middle of what the cameras see
    turn: float  # [rad]
    shift_told: bool  # whether the views share enough to say so in every direction
    turn_told: bool
    tolerable: bool  # less than 3 mm, as far as can be told
    message: str  # for a person


class LookRecord(TypedDict):
    """Whether the camera at the hand looked again before anything was decided, and from where."""

    X_WC: list[list[float]] | None  # (4, 4) that was planned; null: no further look
    reason: str
    shown: float  # share of the target's guessed surface that the views showed before
    expected: float  # with the further look
    duration: float | None  # [s] simulated, of the way there; null: no further look
    planning: float  # [s] wall time, with the stages that it needed


class AttemptRecord(TypedDict):
    """One look, or several, and what came of it, as far as the robot itself can tell."""

    looks: list[LookRecord]  # further ones, in order; the last says why there was no other
    choice: ChoiceRecord | None
    exchanges: list[ExchangeRecord]  # with a model; those of the last look are in ``vlm`` too
    motion: dict[str, Any] | None  # duration [s], phases [s], note
    opening: float | None  # [m] between the pads after the hold; null: nothing was executed
    message: str | None  # why it ended without a motion


class HardwareRecord(TypedDict):
    """What only a real robot has to tell. There success is judged by the hand's width alone."""

    speed: float  # of the planned motion's
    rule: str | None  # of safety, that stopped it or kept it from moving
    opening_closed: float | None  # [m] between the pads when the lift began
    opening_after: float | None  # [m] after the hold
    force: float | None  # [N] of the fingers at the end; null: the driver reports none
    late: float | None  # [s] the most that a command was late; null: it did not move


class ByHandRecord(TypedDict):
    """That a person chose the grasp, and what the selector had said."""

    selector: ChoiceRecord | None  # what it had chosen; null: nothing, or it was not asked
    message: str | None  # why it had chosen none


class EpisodeRecord(TypedDict):
    """One episode, or one choice on a saved view (then what needs a robot is null)."""

    schema: str
    version: str  # of tog_drake
    task: str
    object: str | None  # the one that the task is about (model instance); the judge's target
    scenario: str | None
    seed: int
    noise: bool | None  # whether depth was noisy; null: not simulated, nor the next two
    grip_force: float | None  # [N]
    object_friction: float | None  # null, too: what each model says
    proposer: dict[str, Any]  # {"kind": ..., its settings; of a network its weights: file,
    # sha256, git_sha1, whether it is the released one, and a note that says so; of a server that
    # answered what it says of itself: answered_by, with name, note, sha256; null: nothing}
    selector: dict[str, Any]  # {"kind": ..., its settings}
    counts: dict[str, int | None]  # points, proposed, feasible, candidates
    rejected: dict[str, int]  # proposals that are not feasible, by reason; without an arm: hidden
    view_selection: ViewSelectionRecord | None  # null: not reached, or there was one saved view
    alignment: dict[str, AlignmentRecord] | None  # camera -> ...; null: views were not fused
    choice: ChoiceRecord | None
    by_hand: ByHandRecord | None  # null: the selector chose, nobody intervened
    vlm: VlmRecord | None  # null: no model was asked
    attempts: list[AttemptRecord]
    """One, and one more for each retry. ``collisions``, ``seconds.execute`` and ``sim`` cover all,
    every other field tells of the last look and its motion."""
    outcome: str  # see OUTCOMES
    message: str | None  # why it ended early
    grasp_success: bool | None  # lifted by 0.10 m and held for 2 s
    task_compliance: bool | None  # held by a part that the task allows; null where it says none
    combined_success: bool | None
    strict_success: bool | None  # grasp_success, and turned by no more than 10°
    held: dict[str, float]  # part -> share of the pads' force at lift-off
    turned: float | None  # [deg] in the hand, lift-off to end of the hold; null: not lifted
    collisions: dict[str, float] | None
    """Largest force [N] of each "robot's body / what it met", above 0.5 N: table, itself, other
    objects; contacts with the target do not count. Empty: none; null: nothing was executed."""
    feasible_by_part: dict[str, int] | None
    """Part of the object -> feasible grasps that close on it to four fifths or more, by the labels;
    null: the stage was not reached."""
    chosen_closes_on: dict[str, float] | None
    """Part of the object -> its share of what is between the fingers of the chosen grasp, where the
    object lay at the last look, by the labels; null: none was chosen."""
    closes_on: dict[str, float] | None
    """The same of the grasp that the motion carries out, which may be an alternative to the chosen
    one; null: no motion was found."""
    allowed: list[str] | None  # parts that the task allows, by the object's labels
    lift: float | None  # [m] how high the object was at the end
    motion: dict[str, Any] | None  # duration [s], phases [s], note
    seconds: dict[str, float | None]
    """Wall time; null: did not run; decide = cloud .. plan. What an episode of a benchmark shares
    with others took so long when it was computed."""
    sim: dict[str, float | None]  # seconds (simulated), real_time_rate (of the execution)
    hardware: HardwareRecord | None  # null: simulated, or a saved view


OUTCOMES = {
    "lifted": "lifted by at least 0.10 m and held for 2 s",
    "empty": "the fingers closed on nothing",
    "slipped": "grasped, but it slipped out before it was lifted by 0.10 m",
    "dropped": "lifted by 0.10 m, then lost",
    "wrong_object": "the hand closed on another object, or lifted it",
    "no_grasp": "nothing to grasp, or nothing that the arm can carry out",
    "no_proposal": "the server that proposes grasps was not reached, or its answer was no use",
    "no_view": "who was to say which view is the least ambiguous did not",
    "no_choice": "the selector could not decide",
    "no_plan": "no motion to the chosen grasp passed the checks",
    "collision": "the arm hit something it knew of, or no longer followed its command",
    "no_image": "a real camera brought no image, or an old one",
    "stopped": "a rule of safety, or a person, stopped the arm",
    "broken": "the program failed; traceback.txt beside it says where",
    "chosen": "a grasp was chosen; nothing was executed: a saved view, or nobody said yes",
}


def new_record(
    decision: Decision, config: PipelineConfig, *, task: str, seed: int
) -> EpisodeRecord:
    """Returns the record of a decision; what only an execution can tell is null."""
    grasps, feasible, error = decision.grasps, decision.feasible_grasps, decision.error
    rejected = feasible.rejected if feasible is not None else {}
    if isinstance(error, NoFeasibleGrasp):
        rejected = error.rejected
    counts: dict[str, int | None] = {
        "points": None if decision.cloud is None else decision.cloud.size(),
        "proposed": None if grasps is None else len(grasps),
        "feasible": None if feasible is None else len(feasible),
        "candidates": None if decision.candidates is None else len(decision.candidates),
    }
    if isinstance(error, NoFeasibleGrasp):
        counts["feasible"] = 0
    seconds: dict[str, float | None] = {
        stage.key: decision.seconds.get(stage.key) for stage in STAGES
    }
    seconds["decide"] = sum(s for stage, s in decision.seconds.items() if stage != "render")
    seconds["execute"] = None
    return EpisodeRecord(
        schema=SCHEMA,
        version=version("tog_drake"),
        task=task,
        object=None,
        scenario=None,
        seed=seed,
        noise=None,
        grip_force=None,
        object_friction=None,
        proposer=_proposer_record(decision, config) | _answered_by(grasps),
        selector=kind_and_settings(config.selector),
        counts=counts,
        rejected=dict(rejected),
        view_selection=_view_selection_record(decision, config),
        alignment=_alignment_record(decision, config.camera),
        choice=_choice_record(decision.choice, decision.motion),
        by_hand=_by_hand_record(decision),
        vlm=vlm_record(decision, config.selector, seed=seed),
        attempts=[attempt_record(decision)],
        outcome=error.outcome if error is not None else "chosen",
        message=str(error) if error is not None else None,
        grasp_success=None,
        task_compliance=None,
        combined_success=None,
        strict_success=None,
        held={},
        turned=None,
        collisions=None,
        feasible_by_part=None,
        chosen_closes_on=None,
        closes_on=None,
        allowed=None,
        lift=None,
        motion=_motion_record(decision),
        seconds=seconds,
        sim={"seconds": None, "real_time_rate": None},
        hardware=None,
    )


def _alignment_record(decision: Decision, own: str) -> dict[str, AlignmentRecord] | None:
    if decision.alignments is None:
        return None
    return {
        camera: AlignmentRecord(
            shift=found.shift,
            turn=found.turn,
            shift_told=found.shift_told,
            turn_told=found.turn_told,
            tolerable=found.tolerable,
            message=found.said(own),
        )
        for camera, found in decision.alignments.items()
    }


def _proposer_record(decision: Decision, config: PipelineConfig) -> dict[str, Any]:
    record = kind_and_settings(config.proposer)
    if decision.weights is not None:
        record["weights"] = dict(decision.weights)
    return record


def kind_and_settings(config: Any) -> dict[str, Any]:
    """What the config of an alternative says, and its kind as the command spells it."""
    known = {**PROPOSERS, **SELECTORS, **SCORERS}
    tag = type(config)
    kind = next((name for name, t in known.items() if t is tag), tag.__name__.lower())
    more: dict[str, Any] = {}
    if isinstance(config, Oracle):
        more["note"] = ORACLE_NOTE
    if isinstance(config, Vlm | VlmCompare) and config.model is not None:
        more["model"] = {"specification": specification(config.model), **asdict(config.model)}
    return {"kind": kind, **asdict(config), **more}


def _answered_by(grasps: Grasps | None) -> dict[str, Any]:
    """What a server says of who proposed these grasps; nothing where they are of no server."""
    if not isinstance(grasps, AnsweredGrasps):
        return {}
    return {"answered_by": None if grasps.answerer is None else asdict(grasps.answerer)}


def proposer_name(proposer: Mapping[str, Any]) -> str:
    """Returns who proposed, of a record's ``proposer``, as ``--proposer`` spells it."""
    if proposer["kind"] == "plugin":
        return str(proposer["name"])
    place = proposer.get("path") or proposer.get("url")
    return f"{proposer['kind']}:{place}" if place else str(proposer["kind"])


def selector_name(record: EpisodeRecord) -> str:
    """Returns what tells a selector from others in a table: of a model, how and whom it asked."""
    selector, vlm = record["selector"], record["vlm"]
    if vlm is None:
        return str(selector["kind"])
    return f"{selector['kind']} {vlm['strategy']} {vlm['model']}"


def chosen_region(record: EpisodeRecord) -> Mapping[str, float] | None:
    """Returns ``chosen_closes_on``; None where that is not known.

    A record that was written before there was such a field says it of the grasp that was carried
    out, and so of the chosen one where that is the same.
    """
    if "chosen_closes_on" in record:
        return record["chosen_closes_on"]
    choice = record["choice"]
    if choice is None or choice["planned_index"] != choice["index"]:
        return None
    return record["closes_on"]


def _view_selection_record(
    decision: Decision, config: PipelineConfig
) -> ViewSelectionRecord | None:
    selected, candidates = decision.selected_view, decision.candidates
    if selected is None or candidates is None:
        return None
    grasps = candidates.grasps.take(candidates.index)
    dots = getattr(config.selector, "strategy", None) in ("cpsi", "cpmi")
    states = mark_states(grasps, selected.view, dots=dots)
    return ViewSelectionRecord(
        scorer=kind_and_settings(config.view_selection.scorer),
        camera=selected.camera,
        scores=dict(selected.scores),
        reason=selected.reason,
        status=selected.status,
        candidates_visible={
            each.camera: int(shown_in(grasps, each.view).sum())
            for each in decision.views or (CameraView(selected.camera, selected.view),)
        },
        marks={
            state: [int(row) for row, s in zip(candidates.index, states, strict=True) if s == state]
            for state in get_args(MarkState)
        },
    )


def _by_hand_record(decision: Decision) -> ByHandRecord | None:
    if not decision.by_hand:
        return None
    said = decision.overruled
    return ByHandRecord(
        selector=_choice_record(said if isinstance(said, Choice) else None, None),
        message=None if said is None or isinstance(said, Choice) else str(said),
    )


def _choice_record(choice: Choice | None, motion: GraspMotion | None) -> ChoiceRecord | None:
    if choice is None:
        return None
    return ChoiceRecord(
        index=choice.index,
        planned_index=None if motion is None else motion.grasp_index,
        part=choice.part,
        reason=choice.reason,
        status=choice.status,
        pixel=None if choice.pixel is None else list(choice.pixel),
        pointed={role: list(pixel) for role, pixel in choice.pointed.items()},
        score=float(choice.grasp.score[0]),
        width=float(choice.grasp.width[0]),
    )


def look_record(look: NextLook, planning: float) -> LookRecord:
    """Returns what is recorded of a further look that took ``planning`` [s] to plan."""
    return LookRecord(
        X_WC=None if look.X_WC is None else look.X_WC.tolist(),
        reason=look.reason,
        shown=look.shown,
        expected=look.expected,
        duration=None if look.motion is None else look.motion.duration,
        planning=planning,
    )


def attempt_record(decision: Decision, looks: Sequence[LookRecord] = ()) -> AttemptRecord:
    """Returns what a decision says of its attempt; what the hand felt is not known yet."""
    return AttemptRecord(
        looks=list(looks),
        choice=_choice_record(decision.choice, decision.motion),
        exchanges=exchange_records(exchanges_of(decision)),
        motion=_motion_record(decision),
        opening=None,
        message=None if decision.error is None else str(decision.error),
    )


def _motion_record(decision: Decision) -> dict[str, Any] | None:
    motion = decision.motion
    if motion is None:
        return None
    return {"duration": motion.duration, "phases": motion.phase_times, "note": motion.note}


def stage_rows(record: EpisodeRecord) -> list[tuple[str, str, float]]:
    """Returns of each stage that ran how many came out of it, and its wall time [s], in order."""
    counts, seconds = record["counts"], record["seconds"]
    sizes = {
        "cloud": ("points", "points"),
        "propose": ("proposed", "grasps"),
        "filter": ("feasible", "feasible"),
        "candidates": ("candidates", "candidates"),
    }
    rows: list[tuple[str, str, float]] = []
    for stage, time in seconds.items():
        if time is None:
            continue
        key, noun = sizes.get(stage, ("", ""))
        count = counts.get(key)
        rows.append((stage, "" if count is None else f"{count} {noun}", time))
    return rows


def usage(
    seconds: float,
    tokens: Sequence[Mapping[str, int] | None],
    costs: Sequence[float | None],
    replayed: Sequence[str | None] = (),
) -> str:
    """Returns what questions to a model took, such as "0.8 s, 1,234 tokens, $0.0012".

    Of what is ``replayed`` from a cassette it says so, and that this is what it took back then.

    Tokens are those read and written, reasoning with the latter; what is unknown of one question
    is unknown of all.
    """
    cassettes = sorted({cassette for cassette in replayed if cassette is not None})
    said = [f"{seconds:.1f} s"] if seconds or not cassettes else []
    known = [t["input"] + t["output"] for t in tokens if t and {"input", "output"} <= t.keys()]
    if len(known) == len(tokens):
        said.append(f"{sum(known):,} tokens")
    priced = [cost for cost in costs if cost is not None]
    said.append(f"${sum(priced):.4f}" if len(priced) == len(costs) else "price unknown")
    took = ", ".join(said)
    if not cassettes:
        return took
    back_then = f"; when asked {took}" if seconds or known else ""  # of a failure nothing is known
    n = sum(cassette is not None for cassette in replayed)
    some = f"{n} of {len(replayed)} " if n < len(replayed) else ""
    return f"{some}replayed from {', '.join(cassettes)}{back_then}"


def save_record(path: Path, record: EpisodeRecord) -> None:
    """Writes ``episode.json``, whole or not at all."""
    write_atomically(path, json.dumps(record, indent=1) + "\n")
