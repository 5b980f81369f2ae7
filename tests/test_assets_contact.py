"""What a world is like once it is readied for scanned objects."""

from itertools import combinations

import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    Box,
    Convex,
    ProximityProperties,
    Role,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder
from scans import scanned_bar

from tog_drake.assets.contact import MODULUS, prepare_contacts
from tog_drake.panda import FINGER_BODIES
from tog_drake.scenario import load_scenario
from tog_drake.stations.simulation import SimulationStation


def _inspector(scenario):
    return SimulationStation(scenario).scene_graph.model_inspector()


def _filters(inspector):
    """Of each two collision geometries of robot and table whether they may not meet.

    Geometries are told apart by their names and places: a finger's two boxes by the latter.
    """
    rows = {}
    for geometry in inspector.GetAllGeometryIds(Role.kProximity):
        frame = inspector.GetName(inspector.GetFrameId(geometry))
        if frame.split("::")[0] in ("panda", "hand", "table"):
            place = inspector.GetPoseInFrame(geometry).translation().round(6)
            rows[(frame, inspector.GetName(geometry), *place)] = geometry
    assert sum("finger" in row[0] for row in rows) == 4
    return {
        (a, b): inspector.CollisionFiltered(rows[a], rows[b])
        for a, b in combinations(sorted(rows), 2)
    }


def test_fingers_that_hold_scans_are_of_few_tetrahedra_and_meet_what_they_met(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    scanned_bar(tmp_path / "bar")
    after = _inspector(load_scenario("Tog29", "{asset: bar, settle: null}"))
    before = _inspector(load_scenario("Hammer"))
    assert _filters(after) == _filters(before)
    for geometry in after.GetAllGeometryIds(Role.kProximity):
        if after.GetName(after.GetFrameId(geometry)).split("::")[-1] in FINGER_BODIES:
            assert isinstance(after.GetShape(geometry), Convex)
            assert after.maybe_get_hydroelastic_mesh(geometry).num_elements() == 12


def test_a_finger_presses_as_hard_as_the_box_that_it_was(tmp_path):
    """Two equal boxes press on a scanned bar, equally deep; one is a finger."""
    model = scanned_bar(tmp_path / "bar")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=0.005, contact_model="hydroelastic", use_sampled_output_ports=False
        ),
        builder,
    )
    Parser(plant).AddModels(str(model))
    inertia = SpatialInertia.SolidBoxWithMass(0.1, 0.02, 0.02, 0.02)
    finger = plant.AddRigidBody(FINGER_BODIES[0], plant.AddModelInstance("hand"), inertia)
    plant.WeldFrames(plant.world_frame(), finger.body_frame())
    soft = ProximityProperties()
    AddCompliantHydroelasticProperties(0.1, MODULUS, soft)
    AddContactMaterial(1.25, None, CoulombFriction(0.8, 0.8), soft)
    box, z = Box(0.0185, 0.0185, 0.0152), 0.015 + 0.0152 / 2 - 0.0002  # 0.2 mm deep
    pads = [
        plant.RegisterCollisionGeometry(body, RigidTransform([x, 0, z]), box, "pad", soft)
        for body, x in ((finger, -0.05), (plant.world_body(), 0.05))
    ]
    plant.Finalize()
    prepare_contacts(plant, scene_graph)
    diagram = builder.Build()
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    contacts = plant.get_contact_results_output_port().Eval(context)
    force, faces = {}, {}
    for i in range(contacts.num_hydroelastic_contacts()):
        surface = contacts.hydroelastic_contact_info(i).contact_surface()
        (pad,) = {surface.id_M(), surface.id_N()} & {*pads}
        pressure = surface.poly_e_MN()
        force[pad] = sum(
            surface.area(face) * pressure.EvaluateCartesian(face, surface.centroid(face))
            for face in range(surface.num_faces())
        )
        faces[pad] = surface.num_faces()
    a_finger, a_box = pads
    expected = MODULUS * 0.0002 / (0.0152 / 2) * 0.0185**2  # pressure by depth, on the whole side
    assert force[a_box] == pytest.approx(expected, rel=0.03)
    assert force[a_finger] == pytest.approx(force[a_box], rel=0.01)
    assert faces[a_finger] < 0.7 * faces[a_box]
