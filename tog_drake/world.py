"""The simulated world of an episode: station and pipeline, and which object a task is about."""

import re
from dataclasses import dataclass

from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from tog_drake.camera import rendered_intrinsics
from tog_drake.compliance import PartLabels
from tog_drake.errors import InputError
from tog_drake.object_parts import ObjectParts, labels_file, load_parts, unlabelled
from tog_drake.pipeline import GraspPipeline, GroundTruth, connect_to_station, used_cameras
from tog_drake.planning_model import MakePlanningModel, PlanningModel
from tog_drake.scenario import Scenario, camera_configs, model_files, robot_directive
from tog_drake.selectors.oracle import Oracle
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Intrinsics


@dataclass(frozen=True)
class World:
    """A diagram that can run an episode, and its parts."""

    diagram: Diagram
    station: SimulationStation
    pipeline: GraspPipeline
    planning_model: PlanningModel
    labels: PartLabels
    target: str  # model instance of the object that the task is about


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
    cameras = _intrinsics(scenario)
    used_cameras(scenario.pipeline, cameras)  # hears what is wrong before anything is built
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
        cameras=cameras,
        planning_model=planning_model,
        seed=scenario.random_seed,
        ground_truth=GroundTruth(labels, target),
        safety=None if scenario.hardware is None else scenario.hardware.safety,
    )
    builder = DiagramBuilder()
    builder.AddSystem(station)
    builder.AddSystem(pipeline)
    connect_to_station(builder, station, pipeline)
    diagram = builder.Build()
    diagram.set_name("tog_drake")
    return World(diagram, station, pipeline, planning_model, labels, target)


def _intrinsics(scenario: Scenario) -> dict[str, Intrinsics]:
    """The pinhole models of the images that the scenario's cameras deliver."""
    colors = {name: c.MakeCameras()[0] for name, c in camera_configs(scenario).items()}
    return {name: rendered_intrinsics(c.core().intrinsics()) for name, c in colors.items()}


def look(world: World, scenario: Scenario, task: str) -> Simulator:
    """Returns a simulation of the world at the time of the first look, nothing decided yet."""
    simulator = Simulator(world.diagram)
    ApplySimulatorConfig(scenario.simulator_config, simulator)
    world.diagram.GetInputPort("task").FixValue(simulator.get_mutable_context(), task)
    simulator.Initialize()
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    return simulator


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


def _is_free(station: SimulationStation, target: str) -> bool:
    plant = station.plant
    free = (plant.get_body(index).model_instance() for index in plant.GetFloatingBaseBodies())
    return target in map(plant.GetModelInstanceName, free)


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
