"""A test of grasps: the hand alone closes on a scanned object on the table, lifts and shakes it.

The hand hangs on rails at the pose of the grasp; the object stands or lies as in its file. The
hand closes, rises by 10 cm, and swings along x, y and z at once by ±3 cm at 2 Hz: that is up to
4.7 m/s² each, 8.2 m/s² (0.84 g) together. Hand, grip, contact and time step are the product's.
"""

from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant
from pydrake.multibody.tree import PdControllerGains, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.assets.contact import prepare_contacts
from tog_drake.judge import TURN
from tog_drake.panda import FINGER_BODIES, FINGER_JOINT_NAMES, X_HG
from tog_drake.resources import make_package_map
from tog_drake.scenario import Scenario
from tog_drake.stations.simulation import FINGER_D, FINGER_P

LIFT, SWING, RATE = 0.10, 0.03, 2.0  # [m], [m], [Hz]
CLOSED, LIFTED, SHAKEN = 0.5, 0.9, 1.9  # [s] when each is over; two swings
SPEED = 0.1  # [m/s] at which the opening closes, as the product's
SQUEEZE = 0.02  # [m] less than nothing, which the fingers are told to close to
MOVED = 0.02  # [m] what was between the pads, 18.5 mm wide, is still at them ...
LOST = 0.06  # [m] ... or farther than they reach: it has left the hand
ON_TABLE = np.array([0.5, 0.0, 0.0])  # [m] where the object's origin is, its lowest point at z = 0


class Grip(NamedTuple):
    """A hand's pose G in the frame of an object, and how it closes."""

    at: tuple[float, float, float]  # [m] the origin of G, between the pads
    approach: tuple[float, float, float]  # z_G
    closing: tuple[float, float, float]  # y_G, made perpendicular to the approach
    opening: float  # [m] between the pads before they close
    force: float = Scenario().grip_force  # [N]

    def pose(self) -> RigidTransform:
        z = np.array(self.approach) / np.linalg.norm(self.approach)
        y = np.array(self.closing) - np.dot(self.closing, z) * z
        y = y / np.linalg.norm(y)
        return RigidTransform(RotationMatrix(np.stack([np.cross(y, z), y, z], axis=-1)), self.at)


def outcome(model, lowest, grip: Grip) -> str:
    """What becomes of an object: "held", "slipped" in the hand, "lost", or it "does not fit".

    Held is what turns in the hand by no more than a strict success may, too. What does not fit is
    touched by the hand before it closes.

    Args:
        model: its SDF; its one body is called base.
        lowest: [m] z of its lowest point, in its frame.
        grip: how it is grasped.
    """
    hand = _Hand(model, lowest, grip)
    if hand.touches():
        return "does not fit"
    hand.simulator.AdvanceTo(CLOSED)
    before = hand.X_GO()
    hand.simulator.AdvanceTo(SHAKEN)
    after = hand.X_GO()
    moved = np.linalg.norm(after @ before.inverse().translation())  # of what was between the pads
    turned = np.degrees((before.inverse() @ after).rotation().ToAngleAxis().angle())
    if moved > LOST:
        return "lost"
    return "held" if moved <= MOVED and turned <= TURN else "slipped"


class _Hand:
    """The simulated hand on its rails, the object, and the table."""

    def __init__(self, model, lowest, grip):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlant(Scenario().plant_config, builder)
        parser = Parser(self.plant)
        parser.package_map().AddMap(make_package_map())
        parser.AddModelsFromUrl("package://tog_drake/scenes/table.dmd.yaml")
        (hand,) = parser.AddModelsFromUrl("package://tog_drake/panda/panda_hand.urdf")
        (thing,) = parser.AddModels(str(model))
        X_WO = RigidTransform(ON_TABLE - [0, 0, lowest])
        self.hand = self.plant.GetBodyByName("panda_hand", hand)
        self.thing = self.plant.GetBodyByName("base", thing)
        _put_on_rails(self.plant, self.hand, X_WO @ grip.pose() @ RigidTransform(X_HG).inverse())
        _make_grip(self.plant, hand, grip)
        self.plant.Finalize()
        self.plant.SetDefaultFloatingBaseBodyPose(self.thing, X_WO)
        prepare_contacts(self.plant, scene_graph)
        _connect(builder, self.plant, _way(), self.plant.GetModelInstanceByName("rails"))
        _connect(builder, self.plant, _closing(grip.opening), hand)
        self.simulator = Simulator(builder.Build())

    def X_GO(self):
        context = self.plant.GetMyContextFromRoot(self.simulator.get_context())
        X_WG = self.hand.EvalPoseInWorld(context) @ RigidTransform(X_HG)
        return X_WG.inverse() @ self.thing.EvalPoseInWorld(context)

    def touches(self):
        self.simulator.AdvanceTo(self.plant.time_step())  # contact is known after a step
        context = self.plant.GetMyContextFromRoot(self.simulator.get_context())
        contacts = self.plant.get_contact_results_output_port().Eval(context)
        surfaces = [
            contacts.hydroelastic_contact_info(i).contact_surface()
            for i in range(contacts.num_hydroelastic_contacts())
        ]
        bodies = [self.hand, *(self.plant.GetBodyByName(name) for name in FINGER_BODIES)]
        of_hand = {g for b in bodies for g in self.plant.GetCollisionGeometriesForBody(b)}
        return any(s.id_M() in of_hand or s.id_N() in of_hand for s in surfaces)


def _put_on_rails(plant, hand, X_WH):
    """Lets the hand move along x, y and z alone, far stronger than anything it holds."""
    rails = plant.AddModelInstance("rails")
    parent = plant.world_frame()
    for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", [0, 0, 1])):
        body = plant.AddRigidBody(name, rails, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        joint = plant.AddJoint(PrismaticJoint(name, parent, body.body_frame(), axis))
        actuator = plant.AddJointActuator(name, joint)
        actuator.set_controller_gains(PdControllerGains(p=1e6, d=2e4))
        parent = body.body_frame()
    plant.WeldFrames(parent, hand.body_frame(), X_WH)
    plant.set_gravity_enabled(rails, False)


def _make_grip(plant, hand, grip):
    """Gives the fingers the product's gains, the grip's force, and one motor."""
    joints = [plant.GetJointByName(name, hand) for name in FINGER_JOINT_NAMES]
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        if actuator.joint() in joints:
            actuator.set_controller_gains(PdControllerGains(p=FINGER_P, d=FINGER_D))
            actuator.set_effort_limit(grip.force)
    for joint in joints:
        joint.set_default_translation(grip.opening / 2)
    plant.AddCouplerConstraint(*joints, 1.0)
    plant.set_gravity_enabled(hand, False)


def _way():
    """Where the hand is, from where it closes: up, then to and fro."""
    times = np.arange(LIFTED, SHAKEN, 0.01)
    swing = SWING * np.sin(2 * np.pi * RATE * (times - LIFTED))
    there = np.stack([swing, swing, LIFT + swing])
    times = np.concatenate([[0.0, CLOSED], times])
    points = np.hstack([np.zeros((3, 2)), there])
    return PiecewisePolynomial.CubicShapePreserving(times, points, zero_end_point_derivatives=True)


def _closing(opening):
    """Where the fingers are told to be; (2,) [m]."""
    end = (opening + SQUEEZE) / SPEED
    fingers = [[opening / 2] * 2, [-SQUEEZE / 2] * 2]
    return PiecewisePolynomial.FirstOrderHold([0.0, end], np.transpose(fingers))


def _connect(builder, plant, trajectory, instance):
    source = builder.AddSystem(TrajectorySource(trajectory, output_derivative_order=1))
    builder.Connect(source.get_output_port(), plant.get_desired_state_input_port(instance))
