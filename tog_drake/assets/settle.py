"""Puts an imported object on a table and looks whether it lies still: the last check of a model."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from tog_drake.assets.ground import finalize
from tog_drake.resources import make_package_map
from tog_drake.values import Array

TIME_STEP = 0.005  # [s] that of scenarios
DROP = 0.002  # [m] above the table
REST_BY = 2.0  # [s] when it must lie still ...
WATCH = 1.0  # [s] ... and for how long it is watched then
# What passes.
MAX_PENETRATION = 0.001  # [m]
MAX_DRIFT = 0.002  # [m]
MAX_SPEED = 0.001  # [m/s] of the centre of mass


@dataclass(frozen=True)
class Settled:
    """How an object lies on the table after it was put down."""

    penetration: float  # [m] of its lowest point into the table
    drift: float  # [m] of its centre of mass while it was watched
    speed: float  # [m/s] greatest while it was watched
    turned: float  # [deg] from how it was put down
    X_WB: Array  # (4, 4) how it lies

    @property
    def ok(self) -> bool:
        return (
            self.penetration < MAX_PENETRATION and self.drift < MAX_DRIFT and self.speed < MAX_SPEED
        )


def settle(model: Path, vertices: Array, rotation: Array | None = None) -> Settled:
    """Drops a model onto the table of the scenarios and watches it.

    Args:
        model: its SDF; its one body is called base.
        vertices: (V, 3) [m] of its core.
        rotation: (3, 3) how it is put down; None: as in its file.
    """
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=TIME_STEP,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="lagged",
    )
    plant, scene_graph = AddMultibodyPlant(config, builder)
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    parser.AddModelsFromUrl("package://tog_drake/scenes/table.dmd.yaml")
    (instance,) = parser.AddModels(str(model))
    finalize(plant, scene_graph)
    body = plant.GetBodyByName("base", instance)
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    R_WB = np.eye(3) if rotation is None else rotation
    X_WB = np.eye(4)
    X_WB[:3, :3] = R_WB
    # In front of the arm's place, its lowest point just above the table.
    X_WB[:3, 3] = [0.5, 0.0, DROP - (vertices @ R_WB.T)[:, 2].min()]
    plant.SetFreeBodyPose(context, body, RigidTransform(X_WB))
    center = body.CalcCenterOfMassInBodyFrame(context)
    simulator.AdvanceTo(REST_BY)
    start = body.EvalPoseInWorld(context) @ center
    speed = drift = 0.0
    for time in np.arange(REST_BY, REST_BY + WATCH, 0.02) + 0.02:
        simulator.AdvanceTo(time)
        pose = body.EvalPoseInWorld(context)
        V = body.EvalSpatialVelocityInWorld(context)
        arm = pose.rotation() @ center
        speed = max(speed, float(np.linalg.norm(V.Shift(arm).translational())))
        drift = max(drift, float(np.linalg.norm(pose @ center - start)))
    pose = body.EvalPoseInWorld(context)
    cosine = (np.trace(pose.rotation().matrix() @ R_WB.T) - 1) / 2
    return Settled(
        penetration=max(0.0, -float((pose @ vertices.T)[2].min())),
        drift=drift,
        speed=speed,
        turned=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        X_WB=np.asarray(pose.GetAsMatrix4()),
    )
