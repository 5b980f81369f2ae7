"""The real robot, behind the same ports as the simulated one."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, MeshcatVisualizer, MeshcatVisualizerParams, SceneGraph
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import (
    GetScopedFrameByName,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from pydrake.systems.sensors import CameraConfig

from tog_drake.errors import InputError
from tog_drake.hardware.config import hardware_of
from tog_drake.panda import JOINT_NAMES
from tog_drake.planning_model import PANDA
from tog_drake.resources import make_package_map
from tog_drake.scenario import Scenario, camera_configs, robot_directive
from tog_drake.stations.camera_feed import CameraFeed, Feed
from tog_drake.stations.guard import Guard, Operator
from tog_drake.stations.panda_lcm import (
    HandCommand,
    HandStatusPort,
    PandaBus,
    PandaCommand,
    PandaStatus,
)
from tog_drake.values import Array


class HardwareStation(Diagram):
    """A real Panda, its hand and its cameras.

    .. pydrake_system::

        name: HardwareStation
        input_ports:
        - panda.position
        - hand.position
        output_ports:
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - hand.state_measured
        - "{camera}.rgb_image"
        - "{camera}.depth_image"
        - "{camera}.X_WC"

    The ports are those of ``SimulationStation`` without the ``cheat`` ones. What comes in passes
    the guard before it is sent; ``operator`` lets it, and stops it. ``X_WC`` is where the
    *measured* arm holds the camera by its calibrated mount.

    Args:
        scenario: with a section ``hardware``.
        bus: to the drivers of arm and hand, which have spoken already.
        feeds: the connected cameras, by name.
        silent: never sends anything: what would send is not even there.
        meshcat: where to draw the robot, if anywhere.

    Raises:
        InputError: a setting of the safety makes no sense.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        bus: PandaBus,
        feeds: Mapping[str, Feed],
        silent: bool = False,
        meshcat: Meshcat | None = None,
    ):
        super().__init__()
        safety = hardware_of(scenario).safety
        self.operator = Operator()
        self.guard = Guard(safety, self.operator)
        builder = DiagramBuilder()
        builder.AddNamedSystem("guard", self.guard)
        arm = builder.AddNamedSystem("panda_status", PandaStatus(bus))
        hand = builder.AddNamedSystem("hand_status", HandStatusPort(bus))
        builder.Connect(arm.GetOutputPort("heard"), self.guard.GetInputPort("heard"))
        if not silent:
            force = min(scenario.grip_force, safety.grip_force)
            for name, sender in (
                ("panda_command", PandaCommand(bus)),
                ("hand_command", HandCommand(bus, force)),
            ):
                builder.AddNamedSystem(name, sender)
                builder.Connect(self.guard.get_output_port(), sender.get_input_port())
        for name in ("panda.position", "hand.position"):
            builder.ExportInput(self.guard.GetInputPort(name), name)
        for name in ("position_measured", "velocity_measured", "torque_external"):
            builder.ExportOutput(arm.GetOutputPort(f"panda.{name}"), f"panda.{name}")
        builder.ExportOutput(hand.get_output_port(), "hand.state_measured")
        self.plant, scene_graph = _known_world(scenario)
        configs = camera_configs(scenario)
        self.feeds = {name: CameraFeed(feed) for name, feed in feeds.items()}
        for name, feed in self.feeds.items():
            _add_camera(builder, self.plant, name, feed, configs[name])
            builder.Connect(
                arm.GetOutputPort("panda.position_measured"),
                builder.GetSubsystemByName(f"{name}_pose").get_input_port(),
            )
        if meshcat is not None:
            positions = builder.AddSystem(_Positions(self.plant))
            for port in ("panda.position_measured", "hand.state_measured"):
                source = hand if port.startswith("hand") else arm
                builder.Connect(source.GetOutputPort(port), positions.GetInputPort(port))
            _draw(builder, self.plant, scene_graph, positions, meshcat)
        builder.BuildInto(self)
        self.set_name("station")

    def positions(self, context: Context) -> Array:
        """Returns the positions (9,) of the plant as measured, by the station's ``context``."""
        q, hand = (
            self.GetOutputPort(port).Eval(context)
            for port in ("panda.position_measured", "hand.state_measured")
        )
        return _positions(q, hand)


def open_cameras(scenario: Scenario, lcm: DrakeLcm, cameras: tuple[str, ...]) -> dict[str, Feed]:
    """Connects the cameras of these names; who opened them closes them.

    Raises:
        InputError: one is not in the section ``hardware``, or cannot be opened.
    """
    real, configs = hardware_of(scenario).cameras, camera_configs(scenario)
    feeds: dict[str, Feed] = {}
    try:
        for name in cameras:
            if name not in real:
                raise InputError(
                    f"hardware.cameras says nothing of camera {name}; it has {', '.join(real)}"
                )
            feeds[name] = real[name].open(lcm, configs[name])
    except BaseException:
        for feed in feeds.values():
            feed.close()
        raise
    return feeds


def _known_world(scenario: Scenario) -> tuple[MultibodyPlant, SceneGraph]:
    """What the robot knows: itself and the table, for poses and for pictures."""
    plant, scene_graph = MultibodyPlant(0.0), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    directives = [robot_directive(scenario), *scenario.planning_directives]
    ProcessModelDirectives(ModelDirectives(directives=directives), parser)
    plant.Finalize()
    return plant, scene_graph


class _CameraPose(LeafSystem):
    """Where a camera is that is mounted on the measured arm, or beside it: q -> X_WC."""

    def __init__(self, plant: MultibodyPlant, config: CameraConfig):
        super().__init__()
        self._plant = plant
        self._context = plant.CreateDefaultContext()
        self._arm = plant.GetModelInstanceByName(PANDA)
        self._frame = GetScopedFrameByName(plant, config.X_PB.base_frame or "world")
        color, _ = config.MakeCameras()
        X_BC = color.core().sensor_pose_in_camera_body()
        self._X_FC = config.X_PB.GetDeterministicValue() @ X_BC
        self._q = self.DeclareVectorInputPort("q", len(JOINT_NAMES))
        self.DeclareAbstractOutputPort(
            "X_WC",
            alloc=lambda: Value(RigidTransform()),
            calc=self._CalcPose,
            prerequisites_of_calc={self._q.ticket()},
        )

    def _CalcPose(self, context: Context, output: Value) -> None:
        self._plant.SetPositions(self._context, self._arm, self._q.Eval(context))
        output.set_value(self._frame.CalcPoseInWorld(self._context) @ self._X_FC)


def _add_camera(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    name: str,
    feed: CameraFeed,
    config: CameraConfig,
) -> None:
    builder.AddNamedSystem(name, feed)
    pose = builder.AddNamedSystem(f"{name}_pose", _CameraPose(plant, config))
    for image in ("rgb_image", "depth_image"):
        builder.ExportOutput(feed.GetOutputPort(image), f"{name}.{image}")
    builder.ExportOutput(pose.get_output_port(), f"{name}.X_WC")


class _Positions(LeafSystem):
    """The plant's positions, of what is measured of arm and hand."""

    def __init__(self, plant: MultibodyPlant):
        super().__init__()
        self._q = self.DeclareVectorInputPort("panda.position_measured", 7)
        self._hand = self.DeclareVectorInputPort("hand.state_measured", 2)
        self.DeclareVectorOutputPort("positions", plant.num_positions(), self._CalcPositions)

    def _CalcPositions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(_positions(self._q.Eval(context), self._hand.Eval(context)))


def _positions(q: Array, hand: Array) -> Array:
    """The positions (9,) of arm and fingers; of what is not measured 0."""
    half = hand[0] / 2
    return np.asarray(np.nan_to_num(np.concatenate([q, [half, half]])))


def _draw(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    positions: LeafSystem,
    meshcat: Meshcat,
) -> None:
    builder.AddNamedSystem("scene_graph", scene_graph)
    poses = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
    builder.Connect(positions.get_output_port(), poses.get_input_port())
    builder.Connect(
        poses.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id())
    )
    MeshcatVisualizer.AddToBuilder(
        builder, scene_graph, meshcat, MeshcatVisualizerParams(publish_period=1 / 10)
    )
