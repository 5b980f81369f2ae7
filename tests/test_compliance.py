import numpy as np
import pytest

from tog_drake.compliance import PartLabels, load_parts
from tog_drake.errors import InputError
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
