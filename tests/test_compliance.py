import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    Box,
    ProximityProperties,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder
from scans import scanned_bar

from tog_drake.assets.contact import prepare_contacts
from tog_drake.compliance import PartLabels
from tog_drake.errors import InputError
from tog_drake.object_parts import labels_file, load_parts
from tog_drake.regions import Rest
from tog_drake.resources import resource_dir
from tog_drake.scenario import load_scenario
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Grasps


def _parts(name):
    return load_parts(resource_dir("models") / "objects" / name / "parts.yaml")


@pytest.mark.parametrize(
    ("task", "allowed"),
    [
        ("use the hammer to drive a nail", {"handle"}),
        ("hand me the hammer", {"head"}),
        ("hand me the hammer by the handle", {"handle"}),
        ("pick up the hammer by its grip", {"handle"}),
        ("pick up the hammer, not by the head", {"handle"}),
        ("lift the hammer by its spout", None),
        ("look at the hammer", None),
        ("bring me the hammer so that I can take the handle", {"head"}),
        ("clean the head of the hammer", {"handle"}),
        ("hand me the hammer, not by the head", {"handle"}),
        ("don't pick the hammer up", set()),
    ],
)
def test_a_task_allows_parts_of_a_hammer(task, allowed):
    found = _parts("hammer").allowed(task)
    assert found == (None if allowed is None else frozenset(allowed))


def test_part_labels_that_cannot_be_read_say_what_is_needed(tmp_path):
    path = tmp_path / "parts.yaml"
    with pytest.raises(InputError, match=r"parts\.yaml beside its SDF"):
        load_parts(path)
    path.write_text("object: [")
    with pytest.raises(InputError, match="cannot read part labels"):
        load_parts(path)
    path.write_text("object: a\nwords: []\nparts: 3\ntasks: {}")
    with pytest.raises(InputError, match="cannot read part labels"):
        load_parts(path)


@pytest.fixture(scope="module")
def hammer():
    """A station with a hammer whose handle lies along x of W, its labels and its context."""
    scenario = load_scenario("Hammer")
    scenario.cameras = {}
    station = SimulationStation(scenario)
    labels = PartLabels.from_plant(station.plant, station.scene_graph, {"hammer": _parts("hammer")})
    return station, labels, station.CreateDefaultContext()


def test_every_collision_geometry_of_the_object_is_labelled(hammer):
    _, labels, _ = hammer
    assert {part for _, part in labels.part_of.values()} == {"handle", "head"}


def test_the_closing_region_of_a_grasp_is_the_part_between_the_fingers(hammer):
    station, labels, context = hammer
    inspector = station.scene_graph.model_inspector()
    query_object = station.GetOutputPort("cheat.query_object").Eval(context)
    for geometry, (model, part) in labels.part_of.items():
        if inspector.GetName(geometry).split("::")[-1] not in ("grip", "head"):
            continue
        X_WG = np.eye(4)
        X_WG[:3, 3] = query_object.GetPoseInWorld(geometry).translation()
        contact = X_WG[:3, 3] + [0, 0.01, 0]
        grasp = Grasps(X_WG[None], np.array([0.02]), np.ones(1), contact[None])
        (shares,) = labels.closing_region(grasp, query_object)
        assert shares[model, part] > 0.6


def test_a_grasp_in_the_air_closes_on_no_part(hammer):
    station, labels, context = hammer
    query_object = station.GetOutputPort("cheat.query_object").Eval(context)
    X_WG = np.eye(4)
    X_WG[:3, 3] = [0.5, 0, 1.0]
    grasp = Grasps(X_WG[None], np.array([0.02]), np.ones(1), X_WG[None, :3, 3])
    assert labels.closing_region(grasp, query_object) == [{}]


BAR = """
object: bar
words: [bar]
parts:
  left: {words: [left end]}
  right: {words: [right end]}
regions:
  - {part: right, half_space: {normal: [1, 0, 0], offset: 0}}
  - {part: left}
tasks: {use: [left], handover: [right]}
"""


def _bar(tmp_path, labels):
    """A scanned bar and a pad, 4 cm wide, that presses on it from above, 1 cm left of its middle
    to 3 cm right of it."""
    model = scanned_bar(tmp_path / "bar")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=0.005, contact_model="hydroelastic", use_sampled_output_ports=False
        ),
        builder,
    )
    (instance,) = Parser(plant).AddModels(str(model))
    soft = ProximityProperties()
    AddCompliantHydroelasticProperties(0.1, 1e7, soft)
    AddContactMaterial(1.25, None, CoulombFriction(0.8, 0.8), soft)
    pad = plant.RegisterCollisionGeometry(
        plant.world_body(),
        RigidTransform([0.51, 0, 0.014 + 0.01]),
        Box(0.04, 0.02, 0.02),
        "pad",
        soft,
    )
    plant.Finalize()
    prepare_contacts(plant, scene_graph)
    objects = {"bar": load_parts(labels)} if labels else {}
    known = PartLabels.from_plant(plant, scene_graph, objects)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.SetFreeBodyPose(
        plant.GetMyMutableContextFromRoot(context),
        plant.GetBodyByName("base", instance),
        RigidTransform([0.5, 0, 0]),
    )
    return plant, scene_graph, diagram, context, pad, known


@pytest.fixture
def bar_labels(tmp_path):
    path = tmp_path / "parts.yaml"
    path.write_text(BAR)
    return path


def _held(plant, context, pad, known):
    plant_context = plant.GetMyContextFromRoot(context)
    contacts = plant.get_contact_results_output_port().Eval(plant_context)
    poses = plant.get_body_poses_output_port().Eval(plant_context)
    assert contacts.num_hydroelastic_contacts() == 1  # with the core, not with its skin
    return known.held(contacts, frozenset({pad}), poses)


def test_the_force_on_a_scanned_object_is_split_by_where_the_pad_lies_on_it(tmp_path, bar_labels):
    plant, _, _diagram, context, pad, known = _bar(tmp_path, bar_labels)
    held = _held(plant, context, pad, known)
    total = sum(held.values())
    assert total > 1
    assert held["bar", "left"] / total == pytest.approx(0.25, abs=0.05)
    assert held["bar", "right"] / total == pytest.approx(0.75, abs=0.05)


def test_a_scanned_object_without_labels_is_one_part(tmp_path):
    plant, _, _diagram, context, pad, known = _bar(tmp_path, None)
    assert list(_held(plant, context, pad, known)) == [("bar", "unlabelled")]


def test_the_closing_region_of_a_scanned_object_is_read_from_its_surface(tmp_path, bar_labels):
    _plant, scene_graph, _diagram, context, _, known = _bar(tmp_path, bar_labels)
    scene_graph_context = scene_graph.GetMyContextFromRoot(context)
    query_object = scene_graph.get_query_output_port().Eval(scene_graph_context)
    X_WG = np.tile(np.eye(4), (3, 1, 1))
    X_WG[:, :3, 3] = [[0.44, 0, 0], [0.56, 0, 0], [0.9, 0, 0]]
    grasps = Grasps(X_WG, np.full(3, 0.03), np.ones(3), X_WG[:, :3, 3] + [0, 0.015, 0])
    assert known.closing_region(grasps, query_object) == [
        {("bar", "left"): 1.0}, {("bar", "right"): 1.0}, {}
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("part: left}", "part: middle}", "part 'middle' is none of left, right"),
        ("use: [left]", "use: [top]", r"tasks name .*top.*; the parts are left, right"),
        ("offset: 0", "offset: far", "offset must be a number"),
        ("object: bar", "object: bar" + 1_000_000 * " ", "more than 1000000 bytes"),
        ("regions:", "region:", "'geometries'"),
    ],
)
def test_labels_of_a_scanned_object_that_make_no_sense_are_refused(bar_labels, old, new, message):
    bar_labels.write_text(BAR.replace(old, new))
    with pytest.raises(InputError, match=message):
        load_parts(bar_labels)


def test_labels_come_from_beside_the_model_and_else_with_the_package(tmp_path):
    model = tmp_path / "ycb_048_hammer" / "model.sdf"
    assert labels_file(model) == resource_dir("models") / "labels" / "ycb_048_hammer.yaml"
    model.parent.mkdir()
    (model.parent / "parts.yaml").write_text(BAR)
    assert labels_file(model) == model.parent / "parts.yaml"
    assert labels_file(tmp_path / "thing" / "model.sdf") is None


@pytest.mark.parametrize(
    "path", sorted((resource_dir("models") / "labels").glob("*.yaml")), ids=lambda path: path.stem
)
def test_the_labels_that_come_with_the_package_leave_no_place_without_a_part(path):
    assert isinstance(load_parts(path).regions[-1].shape, Rest)
