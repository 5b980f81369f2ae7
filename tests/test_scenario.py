from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import scanned_bar

from tog_drake.benchmark.cells import CLUTTER, SCANNED
from tog_drake.benchmark.suite import object_labels
from tog_drake.errors import InputError
from tog_drake.pipeline import Antipodal, Oracle, Random
from tog_drake.resources import scenario_files
from tog_drake.scenario import (
    DrakeModels,
    Scenario,
    load_scenario,
    model_files,
    parse_scenario,
    sampled_directives,
)


def _parse(text):
    return parse_scenario(text, "test.yaml", Scenario())


def _pose(scenario):
    added = [d.add_model for d in sampled_directives(scenario) if d.add_model is not None]
    (pose,) = added[0].default_free_body_pose.values()
    return pose.GetDeterministicValue()


def test_every_object_has_a_scenario_that_loads():
    assert set(scenario_files()) >= {
        "Axe", "Bottle", "Brush", "Cup", "Hammer", "Knife", "LotionBottle", "Muddler", "Mug",
        "Pan", "Pot", "Scissors", "Screwdriver", "Spatula", "Spoon", "ToyDinosaur", "ToyElephant",
        "Umbrella", "Whisk"
    }  # fmt: skip
    for name in set(scenario_files()) - set(SCANNED):
        scenario = load_scenario(name)
        for file in model_files(scenario).values():
            assert file.is_file()


@pytest.mark.parametrize("name", CLUTTER)
def test_clutter_of_scans_has_as_many_objects_labelled_and_told_apart_by_name(name):
    scans, built_in = load_scenario(f"Tog29{name}"), load_scenario(name)
    models = [d.add_model for d in scans.directives if d.add_model is not None]
    assert len(models) == len(model_files(built_in))
    names = {object_labels(model.name).object for model in models}
    assert len(names) == len(models)
    for model in models:
        assert model.file == f"package://tog_assets/{model.name}/model.sdf"


def test_an_unknown_scenario_names_the_valid_ones():
    with pytest.raises(InputError, match=r"'Hamer'.*Brush.*Hammer"):
        load_scenario("Hamer")


def test_text_overrides_single_fields_and_keeps_the_others():
    scenario = load_scenario("Hammer", "pipeline: {candidates: {k: 3}, selector: !Random {}}")
    assert scenario.pipeline.candidates.k == 3
    assert scenario.pipeline.candidates.k_max == 8
    assert isinstance(scenario.pipeline.selector, Random)
    assert "hammer" in model_files(scenario)


def test_tags_choose_alternatives_also_where_there_is_only_one():
    scenario = _parse("pipeline: {proposer: !Antipodal {}, selector: !Oracle {}}")
    assert isinstance(scenario.pipeline.proposer, Antipodal)
    assert isinstance(scenario.pipeline.selector, Oracle)
    assert isinstance(_parse("robot: !DrakeModels {}").robot, DrakeModels)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sede: 3", r"no field 'sede'.*valid: random_seed, .*pipeline"),
        ("random_sed: 3", r"did you mean random_seed\?"),
        ("pipeline: {clod: {}}", r"pipeline has no field 'clod' \(did you mean cloud\?\)"),
        ("pipeline: {cloud: {voxl: 1}}", r"pipeline\.cloud has no field 'voxl'.*voxel"),
        ("pipeline: {selector: !Best {}}", r"unknown tag !Best; valid: !Geometric, !TopScore"),
        ("pipeline: {proposer: !Gpd {}}", r"unknown tag !Gpd; valid: !Antipodal"),
        ("robot: !Kuka {}", r"unknown tag !Kuka; valid: !Primitives, !DrakeModels"),
        ("random_seed: -3", r"random_seed must not be below 0, not -3"),
        ("grip_force: 0", "grip_force must be above 0 and at most 140 N, not 0"),
        ("grip_force: 200", "grip_force must be above 0 and at most 140 N, not 200"),
        ("grip_force: tight", "grip_force must be a number, not 'tight'"),
        ("object_friction: -0.5", "object_friction must be above 0 and at most 2, .* not -0.5"),
        ("object_friction: 3", "object_friction must be above 0 and at most 2, .* not 3"),
        ("pipeline: {executor: {period: .nan}}", r"period must be a number, not '\.nan'"),
        ("random_seed: .inf", r"random_seed must be a whole number, not '\.inf'"),
        ("random_seed: many", r"random_seed must be a whole number, not 'many'"),
        ("pipeline: 3", r"pipeline must be a mapping of fields, not '3'"),
        ("directives: {}", r"directives must be a list, not a mapping"),
        ("cameras: {wrist: !L515 {res: 1}}", r"cameras\.wrist has no field 'res'.*resolution"),
        ("settle: {lower: [0.4, -0.2, 0.0]}", r"settle: lower \[0\.4, .* two numbers each"),
        ("settle: {upper: [0.65]}", r"settle: .* upper \[0\.65\] must be two numbers each"),
        ("settle: {lower: [0.7, -0.2]}", "settle: .* every lower below its upper"),
        ("plant_config: {time_stepp: 1}", r"plant_config has no field 'time_stepp'"),
        ("plant_config: {discrete_contact_approximation: tamsi}", "valid: lagged, similar, sap"),
        ("a: [", "not valid YAML"),
        ("a: &x 1\nb: *x", "aliases"),
        ("- 1", "must be a mapping"),
    ],
)
def test_what_is_wrong_with_a_scenario_is_said_with_what_would_be_right(text, message):
    with pytest.raises(InputError, match=message) as caught:
        _parse(text)
    assert "test.yaml" in str(caught.value)


@settings(max_examples=200, deadline=None)
@given(st.text(alphabet=st.sampled_from("ab:{}[]!&*-|>'\"\n ,#%@0"), max_size=40))
def test_no_text_makes_the_parser_fail_otherwise(text):
    with suppress(InputError):
        _parse(text)


def test_the_pose_of_an_object_is_drawn_by_the_seed():
    poses = [_pose(load_scenario("Hammer", f"random_seed: {seed}")) for seed in (0, 0, 1)]
    assert poses[0].IsExactlyEqualTo(poses[1])
    assert not poses[0].IsNearlyEqualTo(poses[2], 1e-3)


def test_drawing_a_pose_leaves_the_scenario_as_it_was():
    scenario = load_scenario("Hammer")
    sampled_directives(scenario)
    (model,) = [d.add_model for d in scenario.directives if d.add_model is not None]
    assert not next(iter(model.default_free_body_pose.values())).IsDeterministic()


def test_an_imported_object_stands_on_the_table_turned_by_the_seed(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    scanned_bar(tmp_path / "bar", z=0.4)  # its origin is far below it
    scenario = load_scenario("Tog29", "{asset: bar, settle: null}")
    assert model_files(scenario) == {"bar": tmp_path / "bar" / "model.sdf"}
    first, second = (
        _pose(load_scenario("Tog29", f"{{asset: bar, settle: null, random_seed: {seed}}}"))
        for seed in (0, 1)
    )
    assert first.translation()[2] == pytest.approx(0.001 - (0.4 - 0.015))
    for pose in (first, second):
        assert pose.rotation().matrix()[2] == pytest.approx([0, 0, 1])
    assert np.abs(first.rotation().matrix() - second.rotation().matrix()).max() > 0.01


def test_an_imported_object_comes_to_rest_by_physics(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    scanned_bar(tmp_path / "bar")
    pose = _pose(load_scenario("Tog29", "asset: bar"))
    assert pose.translation()[2] == pytest.approx(0.015, abs=0.001)


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("asset: ycb_048_hammer", "tog assets fetch ycb:048_hammer"),
        ("asset: gso_Dino_5", "tog assets fetch gso:Dino_5"),
        ("asset: hope_milk", r"tog assets add-dir DIR.*holds hope_milk/"),
        ("asset: ../hammer", r"'\.\./hammer' is no name"),
        (
            "directives: [{add_model: {name: m, file: package://tog_assets/ycb_025_mug/model.sdf}}]\n"
            "asset: null",
            "tog assets fetch ycb:025_mug",
        ),
    ],
)
def test_an_object_that_is_not_imported_says_how_to_import_it(tmp_path, monkeypatch, text, remedy):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    with pytest.raises(InputError, match=remedy):
        model_files(load_scenario("Tog29", text))
