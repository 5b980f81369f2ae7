"""The ground on which scanned objects lie."""

import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    Box,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scans import scanned_bar

from tog_drake.assets.ground import finalize


def _soft():
    soft = ProximityProperties()
    AddCompliantHydroelasticProperties(0.02, 1e7, soft)
    AddContactMaterial(1.25, None, CoulombFriction(0.7, 0.7), soft)
    return soft


@pytest.fixture
def world(tmp_path):
    """Drops a scanned bar (0.1 kg) and a compliant ball on a table; returns what they touch by then
    and where they are."""

    def drop(top):
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=0.005,
            contact_model="hydroelastic_with_fallback",
            discrete_contact_approximation="lagged",
            use_sampled_output_ports=False,
        )
        plant, scene_graph = AddMultibodyPlant(config, builder)
        (bar,) = Parser(plant).AddModels(str(scanned_bar(tmp_path / "bar")))
        world = plant.world_body()
        pose = RigidTransform([0, 0, top - 0.02])
        plant.RegisterCollisionGeometry(world, pose, Box(1, 1, 0.04), "top", _soft())
        ball = plant.AddRigidBody("ball", bar, SpatialInertia.SolidSphereWithMass(0.05, 0.02))
        plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.02), "ball", _soft())
        finalize(plant, scene_graph)
        inspector = scene_graph.model_inspector()
        simulator = Simulator(builder.Build())
        context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        base = plant.GetBodyByName("base", bar)
        plant.SetFreeBodyPose(context, base, RigidTransform([0, 0, top + 0.017]))
        plant.SetFreeBodyPose(context, ball, RigidTransform([0, 0.3, top + 0.021]))
        simulator.AdvanceTo(0.5)
        contacts = plant.get_contact_results_output_port().Eval(context)
        assert contacts.num_point_pair_contacts() == 0
        touching = {}
        for i in range(contacts.num_hydroelastic_contacts()):
            info = contacts.hydroelastic_contact_info(i)
            surface = info.contact_surface()
            names = (inspector.GetName(g) for g in (surface.id_M(), surface.id_N()))
            pair = frozenset(name.rpartition("::")[2] for name in names)
            touching[pair] = np.linalg.norm(info.F_Ac_W().translational())
        heights = [plant.EvalBodyPoseInWorld(context, b).translation()[2] for b in (base, ball)]
        return touching, heights

    return drop


def test_a_core_meets_the_ground_in_place_of_the_table_and_all_else_the_table(world):
    touching, (bar, ball) = world(top=0.0)
    assert set(touching) == {frozenset({"core", "ground"}), frozenset({"ball", "top"})}
    assert touching[frozenset({"core", "ground"})] == pytest.approx(0.1 * 9.81, rel=0.01)
    assert bar == pytest.approx(0.015, abs=1e-4)
    assert ball == pytest.approx(0.02, abs=1e-3)


@pytest.mark.parametrize("top", [-0.2, 0.3])
def test_at_another_height_cores_meet_the_table_itself_and_there_is_no_ground(world, top):
    touching, (bar, _) = world(top=top)
    assert set(touching) == {frozenset({"core", "top"}), frozenset({"ball", "top"})}
    assert bar == pytest.approx(top + 0.015, abs=1e-4)
