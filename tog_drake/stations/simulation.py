"""The simulated robot and its world, behind the same ports as the real one."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    ProximityProperties,
    RoleAssign,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import (
    GetScopedFrameByName,
    ModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import JointActuator, ModelInstanceIndex, PdControllerGains
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    Demultiplexer,
    MatrixGain,
    StateInterpolatorWithDiscreteDerivative,
)
from pydrake.systems.sensors import CameraConfig, RgbdSensor

from tog_drake.assets.ground import finalize
from tog_drake.cameras import noise_of
from tog_drake.errors import InputError
from tog_drake.panda import FINGER_BODIES, FINGER_JOINT_NAMES, JOINT_NAMES
from tog_drake.planning_model import HAND, PANDA
from tog_drake.rendering import make_render_engine
from tog_drake.resources import make_package_map
from tog_drake.scenario import Scenario, camera_configs, sampled_directives
from tog_drake.stations.depth_noise import DepthSensor
from tog_drake.values import Array

# Implicit PD gains on the joint actuators, found by experiment: the arm follows to 0.5 mrad and
# the fingers, told to close by 20 mm more than nothing, reach 70 N on whatever is between them.
ARM_P = (4000.0, 4000.0, 3000.0, 3000.0, 1500.0, 1500.0, 600.0)  # [Nm/rad]
ARM_D_OVER_SQRT_P = 1.6
FINGER_P, FINGER_D = 8000.0, 60.0  # [N/m], [Ns/m]


class SimulationStation(Diagram):
    """A Panda, its hand, its cameras and the world around them, simulated.

    .. pydrake_system::

        name: SimulationStation
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
        - cheat.body_poses
        - cheat.query_object
        - cheat.contact_results

    ``panda.position`` is 7 joint angles [rad]; ``hand.position`` the distance between the pads
    [m], where a value below what the object allows squeezes it; ``hand.state_measured`` is that
    distance and its rate. The ``cheat`` ports exist in simulation alone: they are for the oracle
    and for the judge of an episode.
    """

    def __init__(self, scenario: Scenario, meshcat: Meshcat | None = None):
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlant(scenario.plant_config, builder)
        _add_models(self.plant, scenario)
        finalize(self.plant, self.scene_graph)
        if scenario.object_friction is not None:
            _set_friction(self.plant, self.scene_graph, scenario.object_friction)
        _connect_arm(builder, self.plant)
        _connect_hand(builder, self.plant)
        _add_cameras(builder, self.plant, self.scene_graph, scenario)
        for port, name in (
            (self.plant.get_body_poses_output_port(), "cheat.body_poses"),
            (self.scene_graph.get_query_output_port(), "cheat.query_object"),
            (self.plant.get_contact_results_output_port(), "cheat.contact_results"),
        ):
            builder.ExportOutput(port, name)
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(
                builder, self.scene_graph, meshcat, MeshcatVisualizerParams(publish_period=1 / 30)
            )
        builder.BuildInto(self)
        self.set_name("station")

    def positions(self, context: Context) -> Array:
        """Returns the positions (Q,) of the plant, by the station's ``context``."""
        q: Array = self.plant.GetPositions(self.GetSubsystemContext(self.plant, context))
        return q


def _add_models(plant: MultibodyPlant, scenario: Scenario) -> None:
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    directives = ModelDirectives(directives=sampled_directives(scenario))
    ProcessModelDirectives(directives, parser)
    for model, joints in scenario.initial_position.items():
        instance = plant.GetModelInstanceByName(model)
        for joint, position in joints.items():
            plant.GetJointByName(joint, instance).set_default_positions(np.atleast_1d(position))

    panda, hand = (plant.GetModelInstanceByName(name) for name in (PANDA, HAND))
    for joint, p in zip(JOINT_NAMES, ARM_P, strict=True):
        gains = PdControllerGains(p=p, d=ARM_D_OVER_SQRT_P * p**0.5)
        _actuator(plant, panda, joint).set_controller_gains(gains)
    for joint in FINGER_JOINT_NAMES:
        _actuator(plant, hand, joint).set_controller_gains(
            PdControllerGains(p=FINGER_P, d=FINGER_D)
        )
        _actuator(plant, hand, joint).set_effort_limit(scenario.grip_force)
    # One motor drives both fingers of the real hand.
    left, right = (plant.GetJointByName(joint, hand) for joint in FINGER_JOINT_NAMES)
    plant.AddCouplerConstraint(left, right, 1.0)
    # The real arm compensates the weight of arm and hand by itself.
    for instance in (panda, hand):
        plant.set_gravity_enabled(instance, False)


def _actuator(plant: MultibodyPlant, instance: ModelInstanceIndex, joint: str) -> JointActuator:
    wanted = plant.GetJointByName(joint, instance)
    for index in plant.GetJointActuatorIndices():  # by instance it is empty before Finalize
        actuator = plant.get_joint_actuator(index)
        if actuator.joint().index() == wanted.index():
            return actuator
    raise InputError(f"joint {joint} of the robot model has no actuator")


def _set_friction(plant: MultibodyPlant, scene_graph: SceneGraph, coefficient: float) -> None:
    """Gives all free bodies and the fingers the same ``coefficient``.

    Contact between two of them then has it too: Drake combines two coefficients by their harmonic
    mean (``CalcContactFrictionFromSurfaceProperties``).
    """
    hand = plant.GetModelInstanceByName(HAND)
    bodies = [plant.get_body(index) for index in plant.GetFloatingBaseBodies()]
    bodies += [plant.GetBodyByName(name, hand) for name in FINGER_BODIES]
    friction = CoulombFriction(coefficient, coefficient)
    for geometry in (g for b in bodies for g in plant.GetCollisionGeometriesForBody(b)):
        properties = ProximityProperties(
            scene_graph.model_inspector().GetProximityProperties(geometry)
        )
        properties.UpdateProperty("material", "coulomb_friction", friction)
        scene_graph.AssignRole(plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def _connect_arm(builder: DiagramBuilder, plant: MultibodyPlant) -> None:
    panda = plant.GetModelInstanceByName(PANDA)
    # A desired velocity cuts the tracking error thirty-fold; the port carries positions alone.
    desired = builder.AddSystem(
        StateInterpolatorWithDiscreteDerivative(
            7, plant.time_step(), suppress_initial_transient=True
        )
    )
    builder.Connect(desired.get_output_port(), plant.get_desired_state_input_port(panda))
    state = builder.AddSystem(Demultiplexer(output_ports_sizes=[7, 7]))
    builder.Connect(plant.get_state_output_port(panda), state.get_input_port())
    builder.ExportInput(desired.get_input_port(), "panda.position")
    builder.ExportOutput(state.get_output_port(0), "panda.position_measured")
    builder.ExportOutput(state.get_output_port(1), "panda.velocity_measured")
    builder.ExportOutput(
        plant.get_generalized_contact_forces_output_port(panda), "panda.torque_external"
    )


def _connect_hand(builder: DiagramBuilder, plant: MultibodyPlant) -> None:
    hand = plant.GetModelInstanceByName(HAND)
    desired = builder.AddSystem(
        StateInterpolatorWithDiscreteDerivative(
            1, plant.time_step(), suppress_initial_transient=True
        )
    )
    # Opening and its rate -> half of it for each finger.
    split = builder.AddSystem(MatrixGain(np.kron(np.eye(2), np.full((2, 1), 0.5))))
    builder.Connect(desired.get_output_port(), split.get_input_port())
    builder.Connect(split.get_output_port(), plant.get_desired_state_input_port(hand))
    joined = builder.AddSystem(MatrixGain(np.kron(np.eye(2), np.ones((1, 2)))))
    builder.Connect(plant.get_state_output_port(hand), joined.get_input_port())
    builder.ExportInput(desired.get_input_port(), "hand.position")
    builder.ExportOutput(joined.get_output_port(), "hand.state_measured")


class _CameraPose(LeafSystem):
    """The sensor's body pose as it is now, X_WC."""

    def __init__(self, X_BC: RigidTransform):
        super().__init__()
        self._X_BC = X_BC
        self._X_WB = self.DeclareAbstractInputPort("X_WB", Value(RigidTransform()))
        self.DeclareAbstractOutputPort(
            "X_WC",
            alloc=lambda: Value(RigidTransform()),
            calc=self._CalcPose,
            prerequisites_of_calc={self._X_WB.ticket()},
        )

    def _CalcPose(self, context: Context, output: Value) -> None:
        output.set_value(self._X_WB.Eval(context) @ self._X_BC)


def _add_cameras(
    builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph, scenario: Scenario
) -> None:
    """Adds the cameras, which look at a copy of the finished scene.

    A SceneGraph moves what its render engines draw whenever it is asked anything, contact in every
    step too. The copy is asked for images alone, so that nobody pays for those not taken. It has
    the frames of the original and takes its poses from the same port.
    """
    configs = camera_configs(scenario)
    if not configs:
        return
    seen = builder.AddNamedSystem("seen_by_cameras", scene_graph.Clone())
    builder.Connect(
        plant.get_geometry_pose_output_port(), seen.get_source_pose_port(plant.get_source_id())
    )
    for name, config in configs.items():
        depth_sensor = _make_depth_sensor(scenario, name, config)
        _add_camera(builder, plant, seen, name, config, depth_sensor)


def _make_depth_sensor(scenario: Scenario, name: str, config: CameraConfig) -> DepthSensor | None:
    """What adds the camera's noise to its depth; None where that is to be exact."""
    noise = noise_of(scenario.cameras[name])
    if noise is None:
        return None
    return DepthSensor(noise, focal=config.focal_x(), seed=scenario.random_seed, camera=name)


def _add_camera(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    name: str,
    config: CameraConfig,
    depth_sensor: DepthSensor | None,
) -> None:
    if not scene_graph.HasRenderer(config.renderer_name):
        scene_graph.AddRenderer(config.renderer_name, make_render_engine(config.background))
    color, depth = config.MakeCameras()
    X_BC = color.core().sensor_pose_in_camera_body()
    if not X_BC.IsNearlyEqualTo(depth.core().sensor_pose_in_camera_body(), 1e-9):
        raise InputError(
            f"camera {name}: colour and depth must be aligned; give X_BC and X_BD the same pose"
        )
    frame = GetScopedFrameByName(plant, config.X_PB.base_frame or "world")
    X_BodyB = frame.GetFixedPoseInBodyFrame() @ config.X_PB.GetDeterministicValue()
    frame_id = plant.GetBodyFrameIdOrThrow(frame.body().index())
    sensor = builder.AddSystem(
        RgbdSensor(frame_id, X_BodyB, color_camera=color, depth_camera=depth)
    )
    sensor.set_name(name)
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    pose = builder.AddSystem(_CameraPose(X_BC))
    pose.set_name(f"{name}_pose")
    builder.Connect(sensor.body_pose_in_world_output_port(), pose.get_input_port())
    builder.ExportOutput(sensor.color_image_output_port(), f"{name}.rgb_image")
    depth_image = sensor.depth_image_32F_output_port()
    if depth_sensor is not None:
        builder.AddNamedSystem(f"{name}_depth_sensor", depth_sensor)
        builder.Connect(depth_image, depth_sensor.get_input_port())
        depth_image = depth_sensor.get_output_port()
    builder.ExportOutput(depth_image, f"{name}.depth_image")
    builder.ExportOutput(pose.get_output_port(), f"{name}.X_WC")
