"""One simulated episode: scenario, task and seed in; a record and what to show of it out."""

import time
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Protocol

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from tog_drake.cameras import noise_of
from tog_drake.decision import Decision, decide
from tog_drake.errors import InputError, NoFeasibleGrasp, Stopped
from tog_drake.executor import ExecutorState, Phase
from tog_drake.judge import COMPLIANT_SHARE, HOLD, LIFT, Judge, Verdict, complies
from tog_drake.look_planning import Once
from tog_drake.record import (
    AttemptRecord,
    EpisodeRecord,
    LookRecord,
    attempt_record,
    look_record,
    new_record,
)
from tog_drake.recording import Recorder, Recording
from tog_drake.scenario import Scenario
from tog_drake.sharing import Execution, KeptWorld, SharedWork
from tog_drake.values import Array, Exchange, Grasps, NextLook
from tog_drake.visualization import Sketch, draw_sketch, replay_html, sketch_of
from tog_drake.vlm_record import exchanges_of
from tog_drake.world import World, build_world, look

_BRAKING = 0.5  # [s] within which any motion of this arm comes to rest
_SAMPLE = 0.02  # [s] between two looks of the judge


class Attendant(Protocol):
    """A person who goes through an episode by hand, or who stands in for one."""

    def decide(self, world: World, context: Context) -> Decision:
        """Returns what is to be done; called in place of ``decision.decide``."""

    def watch(self) -> None:
        """Called every 20 ms of the simulation while the arm moves. Raises Stopped to end it."""


@dataclass(frozen=True)
class Episode:
    """What came out of one episode."""

    record: EpisodeRecord
    decision: Decision
    replay: str | None  # a static page that plays it over and over, where Meshcat was given
    exchanges_before: tuple[Exchange, ...] = ()  # with a model, at the looks before the last
    recording: Recording | None = None  # of the simulated world; None: nothing has moved


def run_episode(
    scenario: Scenario,
    *,
    name: str,
    task: str,
    target: str | None = None,
    meshcat: Meshcat | None = None,
    shared: SharedWork | None = None,
    attendant: Attendant | None = None,
) -> Episode:
    """Runs one episode: look, decide, move, lift, hold, and judge.

    Args:
        scenario: the world and the pipeline, with the seed.
        name: of the scenario, for the record.
        task: what a person said.
        target: as in ``build_world``.
        meshcat: where to draw and record, if anywhere.
        shared: where other episodes may have done some of this work already. It does not serve
            those that are shown, nor those that may look again (``retries``, ``look``).
        attendant: who decides in the pipeline's place, and may stop the arm.

    Raises:
        InputError: if the scenario or the task cannot be used.
    """
    _check_success_is_possible(scenario)
    world = build_world(scenario, target=target, task=task, meshcat=meshcat)
    if meshcat is not None:
        meshcat.StartRecording()
    simulator = look(world, scenario, task)
    kept = None
    one_look = scenario.pipeline.retries == 0 and isinstance(scenario.pipeline.look, Once)
    if shared is not None and meshcat is None and one_look:
        context = simulator.get_mutable_context()
        kept = KeptWorld(shared, scenario, context, world.pipeline, world.target)
    judge = Judge(world.station, world.labels, world.target)
    recorder = Recorder(world.station, scenario)
    course = _Course(recorder, attendant)
    _run(simulator, world, judge, course, task, kept, meshcat)
    record = _record(course, scenario, world, task)
    record["scenario"] = name
    _enter_end(record, course)
    if course.execution is None and course.wall > 0.0:  # earlier attempts were carried out
        record["seconds"]["execute"] = course.wall
        record["sim"]["real_time_rate"] = _since_look(world, simulator.get_context()) / course.wall
        record["collisions"] = judge.collisions()
    enter_compliance(record, world.labels.objects[world.target].allowed(task))
    end = simulator.get_context().get_time()
    record["sim"]["seconds"] = end if course.execution is None else course.execution.end
    replay = None
    if meshcat is not None:
        replay = _replay(meshcat, world, simulator.get_context(), course.looked)
    sketch = sketch_of_decision(course.decision, world.planning_model.X_WL0)
    closed = _closed(world, simulator.get_context(), course.looked)
    recording = recorder.recording(sketch, decided=course.looked, closed=closed)
    return Episode(record, course.decision, replay, course.exchanges_before, recording)


@dataclass
class _Course:
    """What happened from the first look on."""

    recorder: Recorder
    attendant: Attendant | None
    attempts: list[AttemptRecord] = field(default_factory=list)
    decision: Decision = field(default_factory=Decision)  # of the last look, as the next two
    looked: float = 0.0  # [s]
    between: list[dict[str, float]] | None = None  # see ``_parts_between_fingers``
    exchanges_before: tuple[Exchange, ...] = ()  # of the looks before
    execution: Execution | None = None  # of the last motion; None: the last look led to none
    wall: float = 0.0  # [s] that all executions took


def _run(
    simulator: Simulator,
    world: World,
    judge: Judge,
    course: _Course,
    task: str,
    kept: KeptWorld | None,
    meshcat: Meshcat | None,
) -> None:
    """Looks, decides and moves, and again as long as the executor goes back to look.

    What happens is entered in ``course``.
    """
    context, attendant = simulator.get_mutable_context(), course.attendant
    while True:
        looks: list[LookRecord] = []
        try:
            state = _look_around(simulator, world, judge, course, looks)
        except Stopped as error:
            course.decision, course.looked = Decision(error=error), context.get_time()
            course.between = None
            course.attempts.append(attempt_record(course.decision, looks))
            return
        if state is not None and state.phase is Phase.FAILED:
            course.decision, course.looked, course.between = Decision(), context.get_time(), None
            course.attempts.append(attempt_record(course.decision, looks))
            verdict = judge.verdict(state, task)
            course.execution = _executed(world, context, verdict, state, course.wall)
            return
        if attendant is not None:
            decision = attendant.decide(world, context)
        else:
            decision = decide(world.pipeline, context) if kept is None else kept.decide(context)
        course.decision, course.looked = decision, context.get_time()
        course.between = _parts_between_fingers(world, context, decision)
        course.attempts.append(attempt_record(decision, looks))
        if meshcat is not None:
            draw(meshcat, decision, world.planning_model.X_WL0)
        if decision.error is not None:
            return
        execution = None if kept is None else kept.execution(decision)
        if execution is None:
            started = time.perf_counter()
            try:
                state = _execute(simulator, world, judge, course)
            except Stopped as error:
                decision.error = error
                return
            course.wall += time.perf_counter() - started
            course.attempts[-1]["opening"] = state.opening_after
            if state.phase is Phase.OBSERVE:
                course.exchanges_before += exchanges_of(decision)
                continue
            verdict = judge.verdict(state, task)
            execution = _executed(world, context, verdict, state, course.wall)
            if kept is not None:
                kept.keep(decision, execution)
        course.attempts[-1]["opening"] = execution.opening
        course.execution = execution
        return


def _record(course: _Course, scenario: Scenario, world: World, task: str) -> EpisodeRecord:
    """Returns the record of all but how it ended."""
    decision, between = course.decision, course.between
    record = new_record(decision, scenario.pipeline, task=task, seed=scenario.random_seed)
    record["noise"] = noise_of(scenario.cameras[scenario.pipeline.camera]) is not None
    record["grip_force"] = scenario.grip_force
    record["object_friction"] = scenario.object_friction
    record["object"] = world.target
    record["attempts"] = course.attempts
    if between is not None:
        record["feasible_by_part"] = _feasible_by_part(world, between)
        if decision.choice is not None:
            record["chosen_closes_on"] = between[decision.choice.index]
        if decision.motion is not None:
            record["closes_on"] = between[decision.motion.grasp_index]
    return record


def _look_around(
    simulator: Simulator, world: World, judge: Judge, course: _Course, looks: list[LookRecord]
) -> ExecutorState | None:
    """Lets the arm take the further looks that the pipeline asks for, before anything is decided.

    What is recorded of them is added to ``looks``. Returns how the last one ended; None: there was
    none.
    """
    pipeline, context = world.pipeline, simulator.get_context()
    mine = pipeline.GetMyContextFromRoot(context)
    state = None
    while pipeline.executor.looks_left(pipeline.executor.GetMyContextFromRoot(context)) > 0:
        started = time.perf_counter()
        next_look: NextLook = pipeline.GetOutputPort("next_look").Eval(mine)
        planned = time.perf_counter()
        looks.append(look_record(next_look, planned - started))
        if next_look.motion is None:
            break
        state = _execute(simulator, world, judge, course)
        course.wall += time.perf_counter() - planned
        if state.phase is Phase.FAILED:
            break
    return state


def _since_look(world: World, context: Context) -> float:
    return float(context.get_time() - world.pipeline.executor.look_time)


def _executed(
    world: World, context: Context, verdict: Verdict, state: ExecutorState, wall: float
) -> Execution:
    executed, end = _since_look(world, context), context.get_time()
    return Execution(verdict, state.opening_after, executed, wall, end)


def enter_compliance(record: EpisodeRecord, allowed: Collection[str] | None) -> None:
    """Judges how an episode ended for a task that allows these parts; None: it says none."""
    record["allowed"] = None if allowed is None else sorted(allowed)
    record["task_compliance"] = complies(record["held"], allowed)
    record["combined_success"] = (
        None if allowed is None else record["grasp_success"] and record["task_compliance"]
    )


def _enter_end(record: EpisodeRecord, course: _Course) -> None:
    """Enters how it ended: as the judge saw the last motion, or without one."""
    execution = course.execution
    if execution is None:
        record["grasp_success"] = record["strict_success"] = False
        if (n := len(record["attempts"])) > 1:
            record["message"] = f"attempt {n}: {record['message']}"
    else:
        verdict = execution.verdict
        record["seconds"]["execute"] = execution.wall
        record["sim"]["real_time_rate"] = execution.executed / execution.wall
        record["collisions"] = verdict.collisions
        record["outcome"] = verdict.outcome
        record["message"] = verdict.message
        record["held"] = verdict.held
        record["lift"] = verdict.lift
        record["grasp_success"] = verdict.grasp_success
        record["strict_success"] = verdict.strict_success
        record["turned"] = verdict.turned


def _check_success_is_possible(scenario: Scenario) -> None:
    pipeline = scenario.pipeline
    if pipeline.trajectory.hold_time < HOLD or pipeline.feasibility.lift_height < LIFT:
        raise InputError(
            f"success is to lift by {LIFT} m and to hold for {HOLD} s, but the scenario lifts by "
            f"{pipeline.feasibility.lift_height} m (feasibility.lift_height) and holds for "
            f"{pipeline.trajectory.hold_time} s (trajectory.hold_time)"
        )


def _execute(simulator: Simulator, world: World, judge: Judge, course: _Course) -> ExecutorState:
    """Lets the executor move until it has ended or looks once more; the judge watches."""
    context = simulator.get_context()
    station_context = world.station.GetMyContextFromRoot(context)
    executor = world.pipeline.executor
    look_at: float | None = None
    judge.start_over()
    while True:
        state = executor.state(executor.GetMyContextFromRoot(context))
        judge.observe(station_context, state)
        course.recorder.observe(station_context)
        _let_watch(simulator, world, course)
        look_at = look_at or state.look_at
        then = context.get_time() + _SAMPLE
        if state.look_at > look_at:  # it has arrived, and stands still until it looks
            then = min(then, state.look_at)
        if state.phase in (Phase.DONE, Phase.FAILED) or then <= context.get_time():
            return state
        simulator.AdvanceTo(then)


def _let_watch(simulator: Simulator, world: World, course: _Course) -> None:
    """Lets the attendant look; where it raises Stopped, the arm first comes to rest."""
    if course.attendant is None:
        return
    try:
        course.attendant.watch()
    except Stopped:
        context, executor = simulator.get_mutable_context(), world.pipeline.executor
        executor.brake(executor.GetMyMutableContextFromRoot(context))
        simulator.AdvanceTo(context.get_time() + _BRAKING)
        course.recorder.observe(world.station.GetMyContextFromRoot(context))
        raise


def _parts_between_fingers(
    world: World, context: Context, decision: Decision
) -> list[dict[str, float]] | None:
    """Shares of the target's parts in what each feasible grasp closes on, by ground truth."""
    if isinstance(decision.error, NoFeasibleGrasp):
        grasps = Grasps.empty()
    elif decision.feasible_grasps is None:
        return None
    else:
        grasps = decision.feasible_grasps
    station = world.station
    query = station.GetOutputPort("cheat.query_object").Eval(station.GetMyContextFromRoot(context))
    return [
        {part: share for (model, part), share in region.items() if model == world.target}
        for region in world.labels.closing_region(grasps, query)
    ]


def _feasible_by_part(world: World, between: list[dict[str, float]]) -> dict[str, int]:
    """How many feasible grasps close on each part of the target."""
    return {
        part: sum(shares.get(part, 0.0) >= COMPLIANT_SHARE for shares in between)
        for part in world.labels.objects[world.target].part_words
    }


def draw(meshcat: Meshcat, decision: Decision, X_WL0: Array) -> None:
    """Draws all of a decision; the arm stands at ``X_WL0`` (4, 4)."""
    draw_sketch(meshcat, sketch_of_decision(decision, X_WL0))


def sketch_of_decision(decision: Decision, X_WL0: Array) -> Sketch:
    """Returns what is drawn of a decision; the arm stands at ``X_WL0`` (4, 4)."""
    return sketch_of(
        cloud=decision.cloud,
        grasps=decision.grasps,
        candidates=decision.candidates,
        choice=decision.choice,
        motion=decision.motion,
        X_WL0=X_WL0,
    )


def _replay(meshcat: Meshcat, world: World, context: Context, looked: float) -> str:
    # Every track of the recording must end at the same time for the replay to repeat evenly.
    world.diagram.ForcedPublish(context)
    closed = _closed(world, context, looked)
    return replay_html(meshcat, duration=context.get_time(), decided=looked, closed=closed)


def _closed(world: World, context: Context, looked: float) -> float | None:
    """When the hand began to close [s], if it came to that since the last look."""
    executor = world.pipeline.executor
    state = executor.state(executor.GetMyContextFromRoot(context))
    if state.motion is None or state.start_time < looked:
        return None
    return float(state.start_time + state.motion.phase_times["close"])
