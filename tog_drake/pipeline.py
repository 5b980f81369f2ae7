"""The stages, connected: from one look to a motion."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem

from tog_drake.alignment import Aligner
from tog_drake.camera import Camera
from tog_drake.candidates import CandidatePicker, CandidatesConfig, candidate_counts
from tog_drake.cloud import CloudConfig, SceneCloud
from tog_drake.compliance import PartLabels
from tog_drake.errors import InputError
from tog_drake.executor import ExecutorConfig, GraspExecutor
from tog_drake.feasibility import FeasibilityConfig, FeasibilityFilter
from tog_drake.look_planning import Active, LookConfig, LookPlanner, LookWays, Once
from tog_drake.panda import MAX_OPENING
from tog_drake.planning_model import PlanningModel
from tog_drake.proposer import GraspProposer, Proposer
from tog_drake.proposers.antipodal import Antipodal, AntipodalProposer
from tog_drake.proposers.contact_graspnet.proposer import ContactGraspNet, make_contact_graspnet
from tog_drake.proposers.file import File, FileProposer
from tog_drake.proposers.plugin import Plugin, PluginProposer
from tog_drake.proposers.remote import Remote, RemoteProposer
from tog_drake.safety import SafetyConfig
from tog_drake.selector import GraspSelector, Selector
from tog_drake.selectors.baselines import Random, RandomSelector, TopScore, TopScoreSelector
from tog_drake.selectors.geometric import Geometric, GeometricSelector
from tog_drake.selectors.oracle import Oracle, OracleSelector
from tog_drake.selectors.strategies import CROWDED, check_count
from tog_drake.selectors.vlm.selector import Vlm, VlmSelector
from tog_drake.trajectory import TrajectoryConfig, TrajectoryOptimizer
from tog_drake.values import (
    Array,
    Intrinsics,
    Workspace,
)
from tog_drake.view_scorers.coverage import Coverage, CoverageScorer
from tog_drake.view_scorers.detector import Detector, DetectorScorer
from tog_drake.view_scorers.remote import Remote as RemoteDetector
from tog_drake.view_scorers.remote import RemoteScorer
from tog_drake.view_scorers.vlm_compare import VlmCompare, VlmCompareScorer
from tog_drake.view_selection import Hand, HandScorer, ViewScorer, ViewSelector

SelectorConfig = Geometric | TopScore | Random | Oracle | Vlm
# How the command spells them.
SELECTORS: dict[str, type[SelectorConfig]] = {
    "geometric": Geometric,
    "top-score": TopScore,
    "random": Random,
    "oracle": Oracle,
    "vlm": Vlm,
}
ProposerConfig = Antipodal | ContactGraspNet | File | Remote | Plugin
PROPOSERS: dict[str, type[ProposerConfig]] = {
    "antipodal": Antipodal,
    "contact-graspnet": ContactGraspNet,
    "file": File,
    "remote": Remote,
}
ScorerConfig = Hand | Coverage | Detector | RemoteDetector | VlmCompare
SCORERS: dict[str, type[ScorerConfig]] = {
    "hand": Hand,
    "coverage": Coverage,
    "detector": Detector,
    "remote": RemoteDetector,
    "vlm-compare": VlmCompare,
}

LOOKS: dict[str, type[LookConfig]] = {"once": Once, "active": Active}

_TABLE_TOLERANCE = 0.002  # [m]


@dataclass
class ViewSelectionConfig:
    """In which of the cameras' views the grasps are shown to whoever chooses."""

    scorer: ScorerConfig = field(default_factory=Hand)
    target: str | None = None  # the object's words, such as "mug"; else the task names it


@dataclass
class PipelineConfig:
    """One entry a stage, in the order of the data."""

    camera: str = "wrist"  # which of the scenario's cameras looks
    look: LookConfig = field(default_factory=Once)  # or from more than one place, before it decides
    workspace: Workspace = field(default_factory=Workspace)
    cloud: CloudConfig = field(default_factory=CloudConfig)
    proposer: ProposerConfig = field(default_factory=Antipodal)
    feasibility: FeasibilityConfig = field(default_factory=FeasibilityConfig)
    opens_fully: bool = False  # the hand arrives as wide as it can, not as the grasp needs it
    candidates: CandidatesConfig = field(default_factory=CandidatesConfig)
    view_selection: ViewSelectionConfig = field(default_factory=ViewSelectionConfig)
    selector: SelectorConfig = field(default_factory=Geometric)
    trajectory: TrajectoryConfig = field(default_factory=TrajectoryConfig)
    executor: ExecutorConfig = field(default_factory=ExecutorConfig)
    retries: int = 0  # looks again and tries another grasp, where the hand has closed on nothing


@dataclass(frozen=True)
class GroundTruth:
    """What only the oracle may be given: the labelled parts, and which object is meant."""

    labels: PartLabels
    target: str  # model instance


class GraspPipeline(Diagram):
    """From a camera's images and a task to the commands of arm and hand.

    .. pydrake_system::

        name: GraspPipeline
        input_ports:
        - "{camera}.rgb_image"
        - "{camera}.depth_image"
        - "{camera}.X_WC"
        - panda.position_measured
        - hand.state_measured
        - task
        output_ports:
        - view
        - views
        - cloud
        - grasps
        - feasible_grasps
        - candidates
        - selected_view
        - choice
        - motion
        - panda.position
        - hand.position
        - failed_grasps

    Every stage's value is exported, to be inspected and timed. It reads its own camera, and the
    others only where their views are compared or fused; where they are fused, there is one more
    output, ``alignments``. With ``!Oracle`` as selector there is one more input,
    ``cheat.query_object``, which only a simulation can feed. With ``look: !Active`` there are two
    more outputs, ``next_look`` and ``earlier_views``.
    """

    def __init__(
        self,
        config: PipelineConfig,
        *,
        cameras: Mapping[str, Intrinsics],
        planning_model: PlanningModel,
        seed: int,
        ground_truth: GroundTruth | None = None,
        safety: SafetyConfig | None = None,
    ):
        super().__init__()
        self.cameras = used_cameras(config, cameras)
        _check_workspace(config.workspace)
        _check_table(config.workspace, planning_model)
        active = config.look if isinstance(config.look, Active) else None
        self.executor = GraspExecutor(
            config.executor,
            retries=config.retries,
            max_looks=0 if active is None else active.max_looks,
            safety=safety,
        )
        self.proposer = make_proposer(config, seed)
        # The looks of an active one make the cloud together, with one camera or several.
        cloud = replace(config.cloud, fuse=config.cloud.fuse or active is not None)
        robot_spheres = partial(_spheres, planning_model)
        stages: dict[str, LeafSystem] = {
            "camera": Camera(
                {name: cameras[name] for name in self.cameras}, looks_again=active is not None
            ),
            "cloud": SceneCloud(cloud, config.workspace, robot_spheres=robot_spheres),
            "proposer": GraspProposer(self.proposer),
            "feasibility": FeasibilityFilter(
                config.feasibility,
                config.workspace,
                planning_model,
                fused=cloud.fuse,
                opens_fully=config.opens_fully,
            ),
            "candidates": CandidatePicker(config.candidates, seed=seed),
            "view_selector": ViewSelector(
                make_view_scorer(config, seed), config.view_selection.target
            ),
            "selector": _make_selector_system(config, seed, ground_truth),
            "trajectory": TrajectoryOptimizer(
                config.trajectory,
                planning_model,
                seed=seed,
                with_retreat=config.retries > 0,
                opens_fully=config.opens_fully,
            ),
            "executor": self.executor,
        }
        if config.cloud.fuse:
            stages["aligner"] = Aligner(config.workspace, robot_spheres)
        if active is not None:
            stages["look_planner"] = _make_look_planner(config, active, planning_model, seed)
        self._stages = list(stages.values())
        builder = DiagramBuilder()
        for name, stage in stages.items():
            builder.AddNamedSystem(name, stage)
        _connect_by_name(builder, self._stages)
        builder.BuildInto(self)
        self.set_name("pipeline")

    def fix(self, context: Context, port: str, value: Any) -> None:
        """Gives the stages that read ``port`` this value, for good: nothing computes it any more.

        Args:
            context: the root Context of the diagram that holds it.
            port: of one of its stages.
            value: of the port's type.
        """
        for stage in self._stages:
            if stage.HasInputPort(port):
                mine = stage.GetMyContextFromRoot(context)
                stage.GetInputPort(port).FixValue(mine, Value(value))


def _connect_by_name(builder: DiagramBuilder, stages: list[LeafSystem]) -> None:
    """Connects every input to the output of the same name; those without one are exported.

    All outputs are exported too, to be looked at.
    """
    outputs = {}
    for stage in stages:
        for i in range(stage.num_output_ports()):
            output = stage.get_output_port(i)
            outputs[output.get_name()] = output
            builder.ExportOutput(output, output.get_name())
    exported: set[str] = set()
    for stage in stages:
        for i in range(stage.num_input_ports()):
            port = stage.get_input_port(i)
            name = port.get_name()
            if name in outputs:
                builder.Connect(outputs[name], port)
            elif name in exported:
                builder.ConnectInput(name, port)
            else:
                builder.ExportInput(port, name)
                exported.add(name)


def _check_workspace(workspace: Workspace) -> None:
    lower, upper = workspace.lower, workspace.upper
    if (
        len(lower) != 3
        or len(upper) != 3
        or not all(a < b for a, b in zip(lower, upper, strict=True))
    ):
        raise InputError(
            f"workspace: lower {lower} and upper {upper} must be three numbers each [m], every "
            "lower below its upper"
        )


def _check_table(workspace: Workspace, planning_model: PlanningModel) -> None:
    """Raises InputError unless the table that the planner avoids is where grasps expect it."""
    above = 0.05  # [m]
    x, y = (np.add(workspace.lower, workspace.upper) / 2)[:2]
    height = workspace.table_height
    distance = planning_model.world_distance(np.array([x, y, height + above]))
    if abs(distance - above) > _TABLE_TOLERANCE:
        raise InputError(
            f"workspace.table_height is {height} m, but {1e3 * above:.0f} mm above it, at "
            f"({x:.2f}, {y:.2f}) m, the nearest thing in planning_directives is "
            f"{1e3 * distance:.0f} mm away: give both the same table"
        )


def make_proposer(config: PipelineConfig, seed: int) -> Proposer:
    """Returns the proposer that the scenario asks for.

    Raises:
        InputError: if a setting of it is out of bounds, or what it needs is not there.
    """
    match config.proposer:
        case Antipodal():
            return AntipodalProposer(config.proposer, config.workspace, seed)
        case ContactGraspNet():
            return make_contact_graspnet(config.proposer, seed)
        case File():
            return FileProposer(config.proposer)
        case Remote():
            return RemoteProposer(config.proposer, config.workspace, seed)
        case Plugin():
            return PluginProposer(config.proposer, config.workspace, seed)


def used_cameras(config: PipelineConfig, cameras: Collection[str]) -> tuple[str, ...]:
    """Returns the names of the cameras that the pipeline reads, its own first.

    Raises:
        InputError: if its own is not among those that there are, or it is the only one where
            several views are to be compared or fused.
    """
    own = config.camera
    if own not in cameras:
        raise InputError(
            f"pipeline.camera: the scenario has no camera {own!r}; valid: {', '.join(cameras)}"
        )
    if isinstance(config.view_selection.scorer, Hand) and not config.cloud.fuse:
        return (own,)
    if len(cameras) == 1 and isinstance(config.look, Once):
        raise InputError(
            f"views are to be compared or fused, but the scenario has one camera, {own}; valid: "
            "more in its `cameras`, or with --side-cameras, or looks with --look active"
        )
    return (own, *(name for name in cameras if name != own))


def make_view_scorer(
    config: PipelineConfig, seed: int, *, export: Path | None = None
) -> ViewScorer:
    """Returns who tells which view shows the target best.

    Args:
        config: of the pipeline.
        seed: of everything random in the scorer.
        export: for a model: the cassette of questions to be asked elsewhere.

    Raises:
        InputError: if a setting of it is out of bounds, or what it needs is not there.
    """
    match config.view_selection.scorer:
        case Hand():
            return HandScorer()
        case Coverage():
            return CoverageScorer(config.workspace)
        case Detector():
            return DetectorScorer(config.view_selection.scorer)
        case RemoteDetector():
            return RemoteScorer(config.view_selection.scorer)
        case VlmCompare():
            return VlmCompareScorer(config.view_selection.scorer, seed=seed, export=export)


def make_selector(config: PipelineConfig, seed: int, *, export: Path | None = None) -> Selector:
    """Returns the selector that the scenario asks for.

    Args:
        config: of the pipeline.
        seed: of everything random in the selector.
        export: for a model: the cassette of questions to be asked elsewhere, see ``VlmSelector``.

    Raises:
        InputError: if a setting of it is out of bounds, or it is the oracle, which is no Selector:
            it needs simulated labels.
    """
    match config.selector:
        case Geometric():
            return GeometricSelector(config.selector, config.workspace)
        case TopScore():
            return TopScoreSelector()
        case Random():
            return RandomSelector(seed=seed)
        case Vlm():
            k, _ = candidate_counts(config.candidates)
            if k is not None and config.selector.strategy in CROWDED:
                check_count(k)
            return VlmSelector(config.selector, config.workspace, seed=seed, export=export)
        case Oracle():
            raise InputError(
                "selector oracle reads simulated part labels, and there are none here; "
                "valid: geometric, top-score, random, vlm"
            )


def _make_selector_system(
    config: PipelineConfig, seed: int, ground_truth: GroundTruth | None
) -> LeafSystem:
    if isinstance(config.selector, Oracle) and ground_truth is not None:
        return OracleSelector(ground_truth.labels, ground_truth.target)
    return GraspSelector(make_selector(config, seed))


def _make_look_planner(
    config: PipelineConfig, look: Active, planning_model: PlanningModel, seed: int
) -> LookPlanner:
    moves = config.trajectory
    ways = LookWays(planning_model, moves.speed, moves.position_margin, moves.transfer, seed)
    return LookPlanner(look, config.workspace, ways, config.view_selection.target)


def _spheres(planning_model: PlanningModel, q: Array) -> tuple[Array, Array]:
    """The robot's spheres at q (7,), hand open: centres (S, 3) and radii (S,) [m] in W."""
    centres, radii, _ = planning_model.spheres(np.asarray(q)[None], MAX_OPENING)
    return centres[0], radii


def connect_to_station(builder: DiagramBuilder, station: Diagram, pipeline: GraspPipeline) -> None:
    """Connects a pipeline to a station, simulated or real: the names of their ports agree.

    ``task`` is exported from the diagram that is being built.

    Raises:
        InputError: if the station lacks a port that the pipeline needs.
    """
    for i in range(pipeline.num_input_ports()):
        port = pipeline.get_input_port(i)
        name = port.get_name()
        if name == "task":
            builder.ExportInput(port, "task")
            continue
        if not station.HasOutputPort(name):
            raise InputError(
                f"the {station.get_name()} has no output {name}; it has "
                + ", ".join(
                    station.get_output_port(k).get_name() for k in range(station.num_output_ports())
                )
            )
        builder.Connect(station.GetOutputPort(name), port)
    for name in ("panda.position", "hand.position"):
        builder.Connect(pipeline.GetOutputPort(name), station.GetInputPort(name))
