import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from tog_drake import placement
from tog_drake.errors import InputError
from tog_drake.scenario import load_scenario, sampled_directives
from tog_drake.stations.simulation import SimulationStation

SCENES = ("Household", "Kitchen", "Tools")
MUG = "file: package://tog_drake/objects/mug/mug.sdf"
POSE = "default_free_body_pose: {base: {translation: [0.5, 0, 0.01]}}"


def _dropped(*models):
    table = "- add_directives: {file: package://tog_drake/scenes/table.dmd.yaml}"
    lines = [f"- add_model: {{{model}}}" for model in models]
    return load_scenario("Mug", "\n".join(["settle: {}", "directives:", table, *lines]))


def _poses(scenario):
    models = [d.add_model for d in sampled_directives(scenario) if d.add_model is not None]
    return {
        model.name: pose.GetDeterministicValue().GetAsMatrix4()
        for model in models
        for pose in model.default_free_body_pose.values()
    }


@pytest.mark.parametrize("name", SCENES)
def test_what_was_dropped_lies_on_the_table_before_the_robot(name):
    poses = _poses(load_scenario(name))
    assert 5 <= len(poses) <= 7
    for X_WO in poses.values():
        assert np.all(X_WO[:2, 3] > [0.30, -0.35])  # the origin, beside the centre of mass
        assert np.all(X_WO[:2, 3] < [0.75, 0.35])
        assert -0.01 < X_WO[2, 3] < 0.15


def test_a_scene_is_drawn_by_its_seed():
    one = _poses(load_scenario("Tools", "random_seed: 1"))
    placement._settled.cache_clear()
    again = _poses(load_scenario("Tools", "random_seed: 1"))
    other = _poses(load_scenario("Tools", "random_seed: 2"))
    for model in one:
        np.testing.assert_array_equal(one[model], again[model])
        assert not np.allclose(one[model], other[model], atol=1e-3)


@pytest.mark.parametrize("name", ["Household", "Kitchen", "Tools"])
def test_a_scene_is_still_at_rest_in_the_world_of_the_episode(name):
    scenario = load_scenario(name)
    scenario.cameras = {}
    station = SimulationStation(scenario)
    context = station.CreateDefaultContext()
    arm = scenario.initial_position["panda"]
    station.GetInputPort("panda.position").FixValue(context, list(arm.values()))
    station.GetInputPort("hand.position").FixValue(context, [0.08])
    plant = station.plant
    plant_context = plant.GetMyContextFromRoot(context)
    bodies = [plant.get_body(index) for index in plant.GetFloatingBaseBodies()]
    before = [body.EvalPoseInWorld(plant_context).translation() for body in bodies]
    Simulator(station, context).AdvanceTo(0.3)
    for body, p_WB in zip(bodies, before, strict=True):
        moved = body.EvalPoseInWorld(plant_context).translation() - p_WB
        assert np.linalg.norm(moved) < 0.001


def test_objects_that_leave_the_area_are_dropped_anew_and_at_last_refused(monkeypatch):
    monkeypatch.setattr(placement, "_SCENES", 1)
    far = load_scenario("Tools", "settle: {lower: [0.0, 1.0], upper: [0.1, 1.1]}")
    with pytest.raises(InputError, match=r"dropped 1 times, at last axe came to rest at \[0\."):
        sampled_directives(far)


def test_an_object_in_the_way_is_dropped_on(monkeypatch):
    monkeypatch.setattr(placement, "_DRAWS", 1)
    stack = _dropped(f"name: lower, {MUG}, {POSE}", f"name: upper, {MUG}, {POSE}")
    poses = _poses(stack)
    assert poses["lower"][2, 3] == pytest.approx(0.0, abs=0.002)
    assert poses["upper"][2, 3] > 0.03


def test_objects_without_a_pose_that_are_in_each_others_way_are_refused_by_name():
    scenario = _dropped(f"name: a, {MUG}", f"name: b, {MUG}", f"name: c, {MUG}, {POSE}")
    with pytest.raises(InputError, match=r"c cannot be put clear .* 2 m .*give these.*: a, b"):
        sampled_directives(scenario)


@pytest.mark.parametrize("frame", ["panda_link8", "table"])
def test_a_pose_in_another_frame_than_the_worlds_is_refused_where_objects_settle(frame):
    pose = f"default_free_body_pose: {{base: {{base_frame: {frame}, translation: [0.5, 0, 0.1]}}}}"
    with pytest.raises(InputError, match=f"pose of a has base_frame '{frame}'.*or give world"):
        sampled_directives(_dropped(f"name: a, {MUG}, {pose}"))
