"""One simulated episode: scenario, task and seed in; a record and what to show of it out."""

import re
import time
from collections.abc import Collection
from dataclasses import dataclass

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tog_drake.camera import rendered_intrinsics
from tog_drake.cameras import noise_of
from tog_drake.compliance import PartLabels
from tog_drake.errors import InputError, NoFeasibleGrasp
from tog_drake.executor import ExecutorState, Phase
from tog_drake.judge import COMPLIANT_SHARE, HOLD, LIFT, Judge, Verdict, complies
from tog_drake.object_parts import ObjectParts, labels_file, load_parts, unlabelled
from tog_drake.pipeline import Decision, GraspPipeline, GroundTruth, connect_to_station, decide
from tog_drake.planning_model import MakePlanningModel, PlanningModel
from tog_drake.record import AttemptRecord, EpisodeRecord, attempt_record, new_record
from tog_drake.scenario import Scenario, camera_configs, model_files, robot_directive
from tog_drake.selectors.oracle import Oracle
from tog_drake.sharing import Execution, KeptWorld, SharedWork
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Exchange, Grasps
from tog_drake.visualization import draw_decision, replay_html
from tog_drake.vlm_record import exchanges_of

_SAMPLE = 0.02  # [s] between two looks of the judge


@dataclass(frozen=True)
class Episode:
    """What came out of one episode."""

    record: EpisodeRecord
    decision: Decision
    replay: str | None  # a static page that plays it over and over, where Meshcat was given
    exchanges_before: tuple[Exchange, ...] = ()  # with a model, at the looks before the last


@dataclass(frozen=True)
class World:
    """A diagram that can run an episode, and its parts."""

    diagram: Diagram
    station: SimulationStation
    pipeline: GraspPipeline
    planning_model: PlanningModel
    labels: PartLabels
    target: str  # model instance of the object that the task is about


def load_objects(scenario: Scenario) -> dict[str, ObjectParts]:
    """Returns the labels of the scenario's objects, those that have any, by model instance."""
    files = {name: labels_file(file) for name, file in model_files(scenario).items()}
    return {name: load_parts(path) for name, path in files.items() if path is not None}


def _objects_of_tasks(scenario: Scenario, wanted: str | None) -> dict[str, ObjectParts]:
    """The objects that a task may be about, by model instance.

    They are those with labels. One without is among them where it is named, or where no object has
    any: it can be lifted, but nobody can say whether the part that is held suits the task.
    """
    labelled = load_objects(scenario)
    others = {name: unlabelled(name) for name in model_files(scenario) if name not in labelled}
    if wanted in others:
        return {**labelled, wanted: others[wanted]}
    return labelled or others


def _check_target(scenario: Scenario, objects: dict[str, ObjectParts], target: str) -> None:
    if isinstance(scenario.pipeline.selector, Oracle) and not objects[target].part_words:
        raise InputError(
            f"selector oracle reads part labels, and {target} has none (no parts.yaml beside its "
            "model); valid: another selector; of an imported object `tog assets label "
            f"{target}` says where they belong"
        )


def build_world(
    scenario: Scenario,
    *,
    target: str | None = None,
    task: str = "",
    meshcat: Meshcat | None = None,
) -> World:
    """Builds the simulated station and the pipeline of a scenario, connected.

    Args:
        scenario: what to build.
        target: the object that the task is about (model instance); None where there is only one,
            or the task names it.
        task: what a person said, where the target is to be found in it.
        meshcat: where to draw, if anywhere.

    Raises:
        InputError: if the scenario does not hold the camera or the target, or the oracle is to
            read labels that the target has not.
    """
    objects = _objects_of_tasks(scenario, target)
    target = _find_target(objects, target, task)
    _check_target(scenario, objects, target)
    camera = scenario.pipeline.camera
    cameras = camera_configs(scenario)
    if camera not in cameras:
        raise InputError(
            f"pipeline.camera: the scenario has no camera {camera!r}; valid: {', '.join(cameras)}"
        )
    color, _ = cameras[camera].MakeCameras()
    try:
        station = SimulationStation(scenario, meshcat)
        planning_model = MakePlanningModel(
            [robot_directive(scenario), *scenario.planning_directives]
        )
    except RuntimeError as error:  # so Drake refuses a joint, frame, file or setting
        raise InputError(f"the scenario cannot be built: {error}") from error
    if not _is_free(station, target):
        raise InputError(f"{target} is fixed in the scenario, so that nothing can lift it")
    labels = PartLabels.from_plant(station.plant, station.scene_graph, objects)
    pipeline = GraspPipeline(
        scenario.pipeline,
        intrinsics=rendered_intrinsics(color.core().intrinsics()),
        planning_model=planning_model,
        seed=scenario.random_seed,
        ground_truth=GroundTruth(labels, target),
    )
    builder = DiagramBuilder()
    builder.AddSystem(station)
    builder.AddSystem(pipeline)
    connect_to_station(builder, station, pipeline, camera)
    diagram = builder.Build()
    diagram.set_name("tog_drake")
    return World(diagram, station, pipeline, planning_model, labels, target)


def run_episode(
    scenario: Scenario,
    *,
    name: str,
    task: str,
    target: str | None = None,
    meshcat: Meshcat | None = None,
    shared: SharedWork | None = None,
) -> Episode:
    """Runs one episode: look, decide, move, lift, hold, and judge.

    Args:
        scenario: the world and the pipeline, with the seed.
        name: of the scenario, for the record.
        task: what a person said.
        target: as in ``build_world``.
        meshcat: where to draw and record, if anywhere.
        shared: where other episodes may have done some of this work already. It does not serve
            those that are shown, nor those that may look again (``retries``).

    Raises:
        InputError: if the scenario or the task cannot be used.
    """
    _check_success_is_possible(scenario)
    world = build_world(scenario, target=target, task=task, meshcat=meshcat)
    if meshcat is not None:
        meshcat.StartRecording()
    simulator = look(world, scenario, task)
    context = simulator.get_mutable_context()
    kept = None
    if shared is not None and meshcat is None and scenario.pipeline.retries == 0:
        kept = KeptWorld(shared, scenario, context, world.pipeline, world.target)
    judge = Judge(world.station, world.labels, world.target)
    attempts: list[AttemptRecord] = []
    exchanges: tuple[Exchange, ...] = ()  # of the looks before this one
    execution: Execution | None = None
    wall = 0.0
    while True:
        decision = decide(world.pipeline, context) if kept is None else kept.decide(context)
        looked, between = context.get_time(), _parts_between_fingers(world, context, decision)
        attempts.append(attempt_record(decision))
        if meshcat is not None:
            _draw(meshcat, decision, world)
        if decision.error is not None:
            break
        execution = None if kept is None else kept.execution(decision)
        if execution is None:
            started = time.perf_counter()
            state = _execute(simulator, world, judge)
            wall += time.perf_counter() - started
            attempts[-1]["opening"] = state.opening_after
            if state.phase is Phase.OBSERVE:
                exchanges += exchanges_of(decision)
                continue
            execution = _executed(world, context, judge.verdict(state, task), state, wall)
            if kept is not None:
                kept.keep(decision, execution)
        attempts[-1]["opening"] = execution.opening
        break
    record = new_record(decision, scenario.pipeline, task=task, seed=scenario.random_seed)
    record["scenario"] = name
    record["noise"] = noise_of(scenario.cameras[scenario.pipeline.camera]) is not None
    record["grip_force"] = scenario.grip_force
    record["object_friction"] = scenario.object_friction
    record["object"] = world.target
    record["attempts"] = attempts
    if between is not None:
        record["feasible_by_part"] = _feasible_by_part(world, between)
        if decision.choice is not None:
            record["chosen_closes_on"] = between[decision.choice.index]
        if decision.motion is not None:
            record["closes_on"] = between[decision.motion.grasp_index]
    if execution is None and wall > 0.0:  # earlier attempts were carried out
        record["seconds"]["execute"] = wall
        record["sim"]["real_time_rate"] = _since_look(world, context) / wall
        record["collisions"] = judge.collisions()
    _enter_end(record, execution)
    enter_compliance(record, world.labels.objects[world.target].allowed(task))
    record["sim"]["seconds"] = context.get_time() if execution is None else execution.end
    replay = None if meshcat is None else _replay(meshcat, world, simulator.get_context(), looked)
    return Episode(record, decision, replay, exchanges)


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


def _enter_end(record: EpisodeRecord, execution: Execution | None) -> None:
    """Enters how it ended: as the judge saw the last motion, or without one."""
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


def look(world: World, scenario: Scenario, task: str) -> Simulator:
    """Returns a simulation of the world at the time of the first look, nothing decided yet."""
    simulator = Simulator(world.diagram)
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    world.diagram.GetInputPort("task").FixValue(simulator.get_mutable_context(), task)
    simulator.Initialize()
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    return simulator


def _check_success_is_possible(scenario: Scenario) -> None:
    pipeline = scenario.pipeline
    if pipeline.trajectory.hold_time < HOLD or pipeline.feasibility.lift_height < LIFT:
        raise InputError(
            f"success is to lift by {LIFT} m and to hold for {HOLD} s, but the scenario lifts by "
            f"{pipeline.feasibility.lift_height} m (feasibility.lift_height) and holds for "
            f"{pipeline.trajectory.hold_time} s (trajectory.hold_time)"
        )


def _execute(simulator: Simulator, world: World, judge: Judge) -> ExecutorState:
    """Lets the executor move until it has ended or looks again; the judge watches."""
    context = simulator.get_context()
    station_context = world.station.GetMyContextFromRoot(context)
    executor = world.pipeline.executor
    attempt: int | None = None
    judge.start_over()
    while True:
        state = executor.state(executor.GetMyContextFromRoot(context))
        judge.observe(station_context, state)
        attempt = attempt or state.attempt
        then = context.get_time() + _SAMPLE
        if state.attempt > attempt:  # it is back, and stands still until it looks
            then = min(then, state.look_at)
        if state.phase in (Phase.DONE, Phase.FAILED) or then <= context.get_time():
            return state
        simulator.AdvanceTo(then)


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


def _draw(meshcat: Meshcat, decision: Decision, world: World) -> None:
    draw_decision(
        meshcat,
        cloud=decision.cloud,
        grasps=decision.grasps,
        candidates=decision.candidates,
        choice=decision.choice,
        motion=decision.motion,
        X_WL0=world.planning_model.X_WL0,
    )


def _replay(meshcat: Meshcat, world: World, context: Context, looked: float) -> str:
    # Every track of the recording must end at the same time for the replay to repeat evenly.
    world.diagram.ForcedPublish(context)
    executor = world.pipeline.executor
    state = executor.state(executor.GetMyContextFromRoot(context))
    closed = None
    if state.motion is not None and state.start_time >= looked:
        closed = state.start_time + state.motion.phase_times["close"]
    return replay_html(meshcat, duration=context.get_time(), decided=looked, closed=closed)


def _find_target(objects: dict[str, ObjectParts], wanted: str | None, task: str) -> str:
    """The model instance of the object meant, by its instance name or by what it is.

    It tells the judge and the oracle alone what the task is about; other selectors read the task.
    """
    valid = ", ".join(objects)
    if not objects:
        raise InputError("the scenario holds no object; give it an add_model or an asset")
    if wanted is None:
        named = list(objects) if len(objects) == 1 else _named(objects, task)
        if len(named) != 1:
            found = f"the task {task!r} names {' and '.join(named) or 'none of them'}; "
            raise InputError(
                f"which object is the task about? {found if task else ''}give --object; "
                f"valid: {valid}"
            )
        return named[0]
    if wanted in objects:
        return wanted
    same = [name for name, parts in objects.items() if wanted in (parts.object, *parts.words)]
    if len(same) != 1:
        raise InputError(f"unknown object {wanted!r}; valid: {valid}")
    return same[0]


def _is_free(station: SimulationStation, target: str) -> bool:
    plant = station.plant
    free = (plant.get_body(index).model_instance() for index in plant.GetFloatingBaseBodies())
    return target in map(plant.GetModelInstanceName, free)


def _named(objects: dict[str, ObjectParts], task: str) -> list[str]:
    """The objects that a task calls by one of their names; "lotion bottle" is no "bottle"."""
    spoken = f" {' '.join(re.findall(r'[a-z]+', task.lower()))} "
    names = {
        model: max((w for w in parts.words if f" {w} " in spoken), key=len, default="")
        for model, parts in objects.items()
    }
    return [
        model
        for model, name in names.items()
        if name
        and not any(name != other and f" {name} " in f" {other} " for other in names.values())
    ]
