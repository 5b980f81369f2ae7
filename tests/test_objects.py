"""The built-in objects: their files, their mass, their rest on a table."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    Box,
    Convex,
    Ellipsoid,
    GeometryId,
    Mesh,
    ProximityProperties,
    QueryObject,
    Role,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
    VolumeMesh,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.multibody.tree import RigidBody
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from tog_drake.resources import make_package_map, resource_dir
from tog_drake.scenario import Scenario

NAMES = (
    "axe",
    "bottle",
    "brush",
    "cup",
    "hammer",
    "knife",
    "lotion_bottle",
    "muddler",
    "mug",
    "pan",
    "pot",
    "scissors",
    "screwdriver",
    "spatula",
    "spoon",
    "toy_dinosaur",
    "toy_elephant",
    "umbrella",
    "whisk",
)
# Parts wider than the hand, which is held around one piece of them, one finger inside.
AROUND = {("pan", "body"): "wall_00", ("scissors", "handle"): "bow_left_3"}
MAX_HAND_WIDTH = 0.065  # [m] what a hand of 80 mm takes with room to spare


def load(*names: str) -> tuple[MultibodyPlant, SceneGraph, DiagramBuilder]:
    """Returns a plant with a table and the named objects, not yet finalized."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(Scenario().plant_config, builder)
    table = ProximityProperties()
    AddCompliantHydroelasticProperties(0.1, 1e6, table)  # as scenes/table.urdf
    AddContactMaterial(1.25, None, CoulombFriction(0.8, 0.8), table)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0, 0, -0.02]), Box(8, 8, 0.04), "table", table
    )
    parser = Parser(plant)
    parser.package_map().AddMap(make_package_map())
    for name in names:
        parser.AddModelsFromUrl(f"package://tog_drake/objects/{name}/{name}.sdf")
    return plant, scene_graph, builder


class Placed(NamedTuple):
    """One object at the origin of the world."""

    body: RigidBody
    inspector: SceneGraphInspector
    query: QueryObject
    collisions: list[GeometryId]
    visuals: list[GeometryId]
    owners: tuple[Diagram, Context]  # what the query reads must stay alive


def place(name: str) -> Placed:
    plant, scene_graph, builder = load(name)
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    body = plant.GetBodyByName("base", plant.GetModelInstanceByName(name))
    plant.SetFreeBodyPose(plant.GetMyContextFromRoot(context), body, RigidTransform())
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    return Placed(
        body=body,
        inspector=inspector,
        query=scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context)),
        collisions=inspector.GetGeometries(frame, Role.kProximity),
        visuals=inspector.GetGeometries(frame, Role.kPerception),
        owners=(diagram, context),
    )


def points_of(inspector: SceneGraphInspector, geometry: GeometryId) -> np.ndarray:
    """Returns points (N, 3) in the body frame whose bounding box is that of the geometry."""
    shape = inspector.GetShape(geometry)
    X = inspector.GetPoseInFrame(geometry)
    if isinstance(shape, (Convex, Mesh)):
        rows = Path(shape.source().path()).read_text().splitlines()
        points = np.array([line.split()[1:] for line in rows if line.startswith("v ")], float)
    elif isinstance(shape, (Ellipsoid, Sphere)):
        radii = [shape.a(), shape.b(), shape.c()] if isinstance(shape, Ellipsoid) else None
        radii = np.diag(radii or [shape.radius()] * 3)
        # The support points of an ellipsoid along the body's axes.
        directions = np.vstack([np.eye(3), -np.eye(3)]) @ X.rotation().matrix()
        points = np.array([radii @ radii @ d / np.linalg.norm(radii @ d) for d in directions])
    else:
        box = inspector.GetObbInGeometryFrame(geometry)
        corners = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
        points = (box.pose() @ (corners * box.half_width()).T).T
    return (X @ points.T).T


def parts_of(name: str) -> dict:
    return yaml.safe_load((resource_dir("models") / "objects" / name / "parts.yaml").read_text())


def local_name(inspector: SceneGraphInspector, geometry: GeometryId) -> str:
    return inspector.GetName(geometry).split("::")[-1]


def test_the_folder_holds_these_objects_and_no_others():
    folders = (resource_dir("models") / "objects").iterdir()
    assert sorted(f.name for f in folders if f.is_dir()) == sorted([*NAMES, "make_objects"])


def test_the_object_files_are_what_their_generator_writes(tmp_path: Path):
    objects = resource_dir("models") / "objects"
    subprocess.run([sys.executable, str(objects / "make_objects"), str(tmp_path)], check=True)
    assert sorted(f.name for f in tmp_path.iterdir()) == sorted(NAMES)
    for name in NAMES:
        written = sorted(f.name for f in (tmp_path / name).iterdir())
        # The labels are written by hand.
        assert sorted([*written, "parts.yaml"]) == sorted(
            f.name for f in (objects / name).iterdir()
        )
        for file in written:
            same = (tmp_path / name / file).read_bytes() == (objects / name / file).read_bytes()
            assert same, f"{name}/{file}"


@pytest.mark.parametrize("name", NAMES)
def test_every_collision_geometry_belongs_to_exactly_one_part(name):
    _, inspector, _, collisions, _, _owners = place(name)
    listed = [g for part in parts_of(name)["parts"].values() for g in part["geometries"]]
    assert sorted(listed) == sorted(local_name(inspector, g) for g in collisions)


@pytest.mark.parametrize("name", NAMES)
def test_parts_have_words_and_tasks_name_parts(name):
    labels = parts_of(name)
    assert set(labels) == {"object", "words", "parts", "tasks"}
    assert labels["object"] == name
    assert set(labels["tasks"]) == {"use", "handover"}
    assert labels["words"] and all(word == word.lower() for word in labels["words"])
    for part in labels["parts"].values():
        assert set(part) == {"geometries", "words"}
        assert part["words"] and all(word == word.lower() for word in part["words"])
    for held in labels["tasks"].values():
        assert set(held) <= set(labels["parts"])
    use, handover = map(set, labels["tasks"].values())
    assert not use & handover
    assert handover


def test_the_name_of_an_object_means_no_other():
    for name in NAMES:
        others = [word for other in NAMES if other != name for word in parts_of(other)["words"]]
        assert name.replace("_", " ") not in others


@pytest.mark.parametrize("name", NAMES)
def test_no_word_means_two_things(name):
    labels = parts_of(name)
    words = labels["words"] + [w for part in labels["parts"].values() for w in part["words"]]
    assert len(words) == len(set(words))


@pytest.mark.parametrize("name", NAMES)
def test_contact_is_compliant_hydroelastic_with_the_measured_parameters(name):
    _, inspector, _, collisions, _, _owners = place(name)
    assert 1 <= len(collisions) <= 20
    for geometry in collisions:
        properties = inspector.GetProximityProperties(geometry)
        assert isinstance(inspector.maybe_get_hydroelastic_mesh(geometry), VolumeMesh)  # compliant
        assert properties.GetProperty("hydroelastic", "hydroelastic_modulus") == 5e6
        assert properties.GetProperty("hydroelastic", "resolution_hint") <= 0.01
        assert properties.GetProperty("material", "hunt_crossley_dissipation") == 1.25
        assert properties.GetProperty("material", "coulomb_friction").static_friction() == 0.8


@pytest.mark.parametrize("name", NAMES)
def test_mass_and_inertia_fit_the_shape(name):
    body, inspector, _, collisions, _, _owners = place(name)
    inertia = body.default_spatial_inertia()
    points = np.vstack([points_of(inspector, g) for g in collisions])
    lower, upper = points.min(0), points.max(0)
    com = inertia.get_com()
    assert 0.03 <= inertia.get_mass() <= 0.6
    assert np.all(lower + 0.1 * (upper - lower) < com) and np.all(com < upper)
    assert inertia.IsPhysicallyValid()
    # A body that fills its box evenly has moments of m (b² + c²) / 12. All the mass at the corners
    # would be three times that; ours spread theirs more evenly, and none is near a point.
    moments = np.diag(inertia.Shift(com).CalcRotationalInertia().CopyToFullMatrix3())
    extent = (upper - lower) ** 2
    box = inertia.get_mass() * (extent.sum() - extent) / 12
    assert np.all(moments < 1.5 * box) and np.all(moments > 0.15 * box)


def test_tools_balance_where_real_ones_do():
    x = {
        name: place(name).body.default_spatial_inertia().get_com()[0]
        for name in ("axe", "hammer", "screwdriver", "mug", "pot")
    }
    assert 0.07 < x["axe"] < 0.10  # near the steel head (0.115), too
    assert 0.05 < x["hammer"] < 0.09  # near the steel head (0.115), not the middle (-0.002)
    assert -0.04 < x["screwdriver"] < -0.01  # in the thick handle (-0.105 .. 0.01)
    assert 0.0 < x["mug"] < 0.01  # the handle pulls it a little off the axis
    assert 0.0 < x["pot"] < 0.02  # the long handle more, but not over the foot's edge (0.0295)


@pytest.mark.parametrize("name", NAMES)
def test_the_camera_sees_what_the_hand_touches(name):
    _, inspector, query, collisions, visuals, _owners = place(name)
    touch = np.vstack([points_of(inspector, g) for g in collisions])
    look = np.vstack([points_of(inspector, g) for g in visuals])
    np.testing.assert_allclose(look.min(0), touch.min(0), atol=0.002)
    np.testing.assert_allclose(look.max(0), touch.max(0), atol=0.002)
    ids = set(collisions)
    for geometry in visuals:
        if isinstance(inspector.GetShape(geometry), Mesh):
            for point in points_of(inspector, geometry)[::5]:
                near = query.ComputeSignedDistanceToPoint(point)
                assert min(d.distance for d in near if d.id_G in ids) < 0.002


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("cup", [0, 0, 0.030]),
        ("mug", [0, 0, 0.045]),
        ("pan", [-0.075, 0, 0.020]),
        ("pan", [-0.035, 0, 0.020]),
        ("pot", [0, 0, 0.030]),
        ("scissors", [-0.083, 0.024, 0.009]),  # a finger goes through either bow
        ("scissors", [-0.083, -0.024, 0.009]),
        ("spoon", [0.088, 0, 0.018]),
    ],
)
def test_hollow_things_are_hollow(name, inside):
    _, _, query, collisions, _, _owners = place(name)
    ids = set(collisions)
    distances = [d.distance for d in query.ComputeSignedDistanceToPoint(inside) if d.id_G in ids]
    assert min(distances) > 0.009


@pytest.mark.parametrize("name", NAMES)
def test_what_a_task_may_hold_stands_up_from_the_table_and_fits_the_hand(name):
    _, inspector, _, collisions, _, _owners = place(name)
    labels = parts_of(name)
    by_name = {local_name(inspector, g): points_of(inspector, g) for g in collisions}
    for part in {p for held in labels["tasks"].values() for p in held}:
        points = np.vstack([by_name[g] for g in labels["parts"][part]["geometries"]])
        assert points[:, 2].max() > 0.010  # the knife's blade, which is held from edge to spine
        if (name, part) in AROUND:
            points = by_name[AROUND[name, part]]
        assert np.ptp(points[:, :2], axis=0).min() <= MAX_HAND_WIDTH


def test_objects_come_to_rest_where_they_are_put():
    plant, scene_graph, builder = load(*NAMES)
    plant.Finalize()
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context: Context = plant.GetMyMutableContextFromRoot(root)
    yaws = np.random.default_rng(0).uniform(-np.pi, np.pi, len(NAMES))
    nominal = {}
    for i, name in enumerate(NAMES):
        body = plant.GetBodyByName("base", plant.GetModelInstanceByName(name))
        X_WO = RigidTransform(
            RotationMatrix.MakeZRotation(yaws[i]), [0.4 * (i - len(NAMES) // 2), 0.0, 0.0]
        )
        nominal[body] = X_WO
        plant.SetFreeBodyPose(context, body, RigidTransform([0, 0, 0.001]) @ X_WO)
    for t in (0.5, 1.0, 1.5):
        simulator.AdvanceTo(t)
        contacts = plant.get_contact_results_output_port().Eval(context)
        assert contacts.num_point_pair_contacts() == 0
        assert contacts.num_hydroelastic_contacts() >= len(NAMES)

    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
    inspector = scene_graph.model_inspector()
    table = plant.GetCollisionGeometriesForBody(plant.world_body())[0]
    for body, X_WO in nominal.items():
        V_WO = body.EvalSpatialVelocityInWorld(context)
        error = X_WO.inverse() @ body.EvalPoseInWorld(context)
        name = plant.GetModelInstanceName(body.model_instance())
        assert np.linalg.norm(V_WO.translational()) < 0.002, name
        assert np.linalg.norm(error.translation()) < 0.005, name
        assert np.degrees(error.rotation().ToAngleAxis().angle()) < 3.0, name
        for geometry in plant.GetCollisionGeometriesForBody(body):
            pair = query.ComputeSignedDistancePairClosestPoints(table, geometry)
            assert pair.distance > -0.001, (name, local_name(inspector, geometry))
