import re
from collections import Counter

import pytest
import yaml
from command import tog

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.method import Method, make_methods
from tog_drake.benchmark.suite import SCENARIO, load_suite, object_labels, suite_files
from tog_drake.errors import InputError
from tog_drake.resources import scenario_files
from tog_drake.scenario import load_scenario

TRIALS = load_suite("tog29").trials
LION, MUG = "gso_Schleich_Lion_Action_Figure", "ycb_025_mug"
MUSTARD, HAMMER = "ycb_006_mustard_bottle", "ycb_048_hammer"


def test_the_suite_has_the_papers_57_trials_on_29_objects_and_six_choices():
    counts = Counter(trial.category for trial in TRIALS)
    assert counts == {"position": 36, "use": 11, "handover": 10, "choose": 6}
    assert len({trial.object for trial in TRIALS}) == 29
    assert len({(t.scenario, t.object, t.task) for t in TRIALS}) == len(TRIALS)


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: f"{trial.object} {trial.task}")
def test_a_trial_divides_the_parts_of_its_object_as_its_words_are_read(trial):
    labels = object_labels(trial.object)
    assert trial.allowed
    assert trial.allowed <= set(labels.part_words)
    assert labels.allowed(trial.task) == trial.allowed


def test_the_scenes_to_choose_from_hold_what_is_asked_for():
    for trial in TRIALS:
        if trial.scenario != SCENARIO:
            directives = load_scenario(trial.scenario).directives
            models = {d.add_model.name for d in directives if d.add_model is not None}
            assert trial.object in models
            assert len(models) == 3


@pytest.mark.parametrize(
    ("name", "task", "allowed"),
    [
        (LION, "grasp the front of the toy", {"head", "front"}),
        (LION, "pick up the toy by its front part", {"head", "front"}),
        (LION, "grasp the toy by the front", {"head", "front"}),
        (LION, "grasp the toy by the head", {"head"}),
        (LION, "by the tail", {"tail"}),
        (LION, "grasp the tail of the toy", {"tail"}),
        (LION, "pick up the toy in front of the mug", None),
        (LION, "put the toy in front of me", None),
        (MUG, "grasp the handle of the mug", {"handle"}),
        (MUG, "not by the handle", {"body", "rim"}),
        (MUG, "grasp the mug by a part other than the handle", {"body", "rim"}),
        (MUG, "pick up the mug by any part but the handle", {"body", "rim"}),
        (MUG, "grasp the part of the mug that is not the handle", {"body", "rim"}),
        (MUG, "grasp the mug by the rim", {"rim"}),
        (MUSTARD, "by the head of the bottle", {"cap"}),
        (MUSTARD, "grasp the head part of the bottle", {"cap"}),
        (MUSTARD, "grasp the body of the bottle", {"body"}),
        (HAMMER, "use the hammer to drive a nail", {"handle"}),
        (HAMMER, "hand me the hammer", {"head"}),
    ],
)
def test_the_words_of_the_paper_are_read_to_the_parts_that_they_mean(name, task, allowed):
    assert object_labels(name).allowed(task) == allowed


GROUP = {
    "objects": [HAMMER],
    "tasks": [
        {"category": "use", "task": "use the {object}", "allowed": ["handle"],
         "forbidden": "others"}
    ],
}  # fmt: skip


def _suite(path, **changes):
    group = {**GROUP, "tasks": [{**GROUP["tasks"][0], **changes}]}
    path.write_text(yaml.safe_dump({"groups": [group]}))
    return str(path)


def test_a_suite_fills_the_objects_name_into_its_tasks(tmp_path):
    (trial,) = load_suite(_suite(tmp_path / "s.yaml")).trials
    assert (trial.task, trial.scenario, trial.beyond) == ("use the hammer", "Tog29", None)
    assert trial.allowed == {"handle"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"allowed": ["head"]}, r"lists \['head'\], but the words are read as \['handle'\]"),
        ({"task": "look at the {object}"}, "the words are read as None"),
        ({"forbidden": ["handle", "head"]}, "must divide its parts"),
        ({"allowed": ["grip"]}, "must divide its parts"),
        ({"allowed": "others"}, "cannot both be the others"),
        ({"category": "juggle"}, "'juggle' is none of position, use, handover, choose"),
        ({"beyond": {"ycb_025_mug": "too wide"}}, "beyond names .*ycb_025_mug"),
        ({"task": None}, "a task: task must be text, not None"),
        ({"part": "head"}, "a task has no field 'part'; valid: category, task, allowed"),
        ({"allowed": 3}, "allowed must be a list or text, not 3"),
        ({"task": "by the {part}"}, "says itself what is allowed"),
    ],
)
def test_a_suite_that_contradicts_its_labels_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load_suite(_suite(tmp_path / "s.yaml", **changes))


def test_a_suite_of_objects_without_labels_is_refused(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(yaml.safe_dump({"groups": [{**GROUP, "objects": ["ycb_000_none"]}]}))
    with pytest.raises(InputError, match="no part labels for ycb_000_none"):
        load_suite(str(path))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("groups: []", "holds no trial"),
        ("groups: {a: 1}", "groups must be a list"),
        ("groups: [hammer]", "a group must have tasks"),
        ("groups: [{objects: [hammer]}]", "a group lacks tasks"),
        ("groups: [{tasks: [{category: use, task: use it}]}]", "has no objects"),
        ("groups: [{objects: [3], tasks: []}]", "a list of names"),
        ("groups: [{objects: [hammer], tasks: [1]}]", "a task must have category, task"),
        ("{groups: [], seeds: 0}", "seeds must be at least 1"),
        ("{groups: [], seeds: true}", "seeds must be a whole number"),
        ("{groups: [], rows: 1}", "no field 'rows'; valid: groups, seeds"),
        ("{groups: [}", "cannot read the suite"),
    ],
)
def test_a_suite_that_is_none_says_where_and_what_would_be_valid(tmp_path, content, message):
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as refused:
        load_suite(str(path))
    assert "mine.yaml" in str(refused.value)


def _mine(path, **group):
    path.write_text(yaml.safe_dump({"seeds": 2, "groups": [group]}))
    return load_suite(str(path))


USE = {"category": "use", "task": "use the {object}"}


def test_what_a_task_allows_is_what_the_labels_say_where_it_does_not(tmp_path):
    suite = _mine(tmp_path / "mine.yaml", objects=["hammer", "lotion_bottle"], tasks=[USE])
    assert (suite.name, suite.seeds) == ("mine", 2)
    assert [(t.object, t.task, t.allowed, t.scenario) for t in suite.trials] == [
        ("hammer", "use the hammer", {"handle"}, "Hammer"),
        ("lotion_bottle", "use the lotion bottle", {"body"}, "LotionBottle"),
    ]
    with pytest.raises(InputError, match="do not say which part"):
        _mine(tmp_path / "mine.yaml", objects=["toy_elephant"], tasks=[USE])
    with pytest.raises(InputError, match="asked twice of hammer"):
        _mine(tmp_path / "mine.yaml", objects=["hammer"], tasks=[USE, USE])


def test_the_parts_are_named_in_turn_by_the_seed(tmp_path):
    task = {"category": "position", "task": "pick up the {object} by its {part}"}
    suite = _mine(tmp_path / "mine.yaml", objects=["mug"], tasks=[task])
    cells = make_cells(suite, [Method("oracle")], range(3))
    assert [cell.task.split()[-1] for cell in cells] == ["handle", "body", "handle"]
    assert [cell.trials[0].allowed for cell in cells] == [{"handle"}, {"body"}, {"handle"}]


def test_a_group_may_be_all_objects_of_a_scenario_and_a_scenario_lies_beside_its_suite(tmp_path):
    scenario = scenario_files()["Tools"].read_text()
    (tmp_path / "bench.yaml").write_text(scenario)
    suite = _mine(tmp_path / "mine.yaml", scenario="bench.yaml", tasks=[USE])
    tools = _mine(tmp_path / "mine.yaml", scenario="Tools", tasks=[USE])
    assert [t.object for t in suite.trials] == [t.object for t in tools.trials]
    assert len(suite.trials) == 5
    assert {trial.scenario for trial in suite.trials} == {str(tmp_path / "bench.yaml")}
    with pytest.raises(InputError, match="no object 'mug'; valid: axe, hammer"):
        _mine(tmp_path / "mine.yaml", scenario="Tools", objects=["mug"], tasks=[USE])


def test_a_scenario_is_a_suite_of_its_objects_to_use_and_to_hand_over(tmp_path):
    path = tmp_path / "house.yaml"
    path.write_text(scenario_files()["Household"].read_text())
    for name in ("Household", str(path)):
        trials = load_suite(name).trials
        assert Counter(trial.category for trial in trials) == {"use": 5, "handover": 6}
        assert {trial.scenario for trial in trials} == {name}


def test_the_suites_of_the_package_can_be_loaded_and_say_how_often_they_are_run():
    found = {name: load_suite(name) for name in suite_files()}
    assert {name: (len(suite.trials), suite.seeds) for name, suite in found.items()} == {
        "builtin": (55, 5), "household": (11, 3), "kitchen": (12, 3), "tools": (10, 3),
        "tog29": (63, 1), "views": (2, 5),
    }  # fmt: skip


def test_a_suite_is_run_object_by_object_and_all_must_be_imported(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    suite = load_suite("tog29")
    with pytest.raises(InputError, match=r"cy_glue_1, .*tog assets fetch --suite tog29"):
        make_cells(suite, [Method("oracle")], [0])
    for name in {trial.object for trial in TRIALS}:
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.sdf").touch()
    assert len(make_cells(suite, [Method("oracle")], [0, 1])) == 2 * len(TRIALS)
    blind = make_cells(suite, [Method("top-score")], [0])
    assert len(blind) == 29 + 6
    mug = next(cell for cell in blind if cell.object == MUG)
    assert len(mug.trials) == 2


def test_a_method_that_does_not_read_the_task_runs_once_for_all_tasks():
    suite = load_suite("Hammer")
    tasks = ["use the hammer", "hand me the hammer"]
    blind, reading = (make_cells(suite, [Method(s)], [0]) for s in ("random", "geometric"))
    assert [[trial.task for trial in cell.trials] for cell in blind] == [tasks]
    assert [cell.task for cell in reading] == tasks
    lines = [cell.record(trial) for cell in blind for trial in cell.trials]
    assert [(line["tasks"], line["task"], line["category"]) for line in lines] == [
        (2, tasks[0], "use"), (2, tasks[1], "handover")
    ]  # fmt: skip


def test_cells_have_an_order_and_names_that_are_fit_for_files():
    methods = make_methods(
        ["random", "vlm"], strategies=["gsi", "cpg"], models=["openai:a/b@http://[::1]:9/v1"],
        ks=["2", "auto"],
    )  # fmt: skip
    cells = make_cells(load_suite("Mug"), methods, range(2))
    assert [cell.number for cell in cells] == list(range(len(cells)))
    assert len({cell.name for cell in cells}) == len(cells) == 2 * (2 + 2 * 4)
    assert all(set(cell.name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-") for cell in cells)
    assert max(len(cell.name) for cell in cells) < 100
    assert len({name.split("-")[0] for name in (cell.name for cell in cells)}) == len(cells)


def test_methods_are_all_combinations_but_only_a_model_has_strategies():
    methods = make_methods(
        ["oracle", "vlm"], strategies=["gsi", "cpg"], models=["gemini:a", "openai:b"],
        proposers=["antipodal", "file:x.npz"], ks=["3"],
    )  # fmt: skip
    assert [method.name for method in methods[:5]] == [
        "oracle, K=3, antipodal",
        "vlm gsi gemini:a, K=3, antipodal",
        "vlm gsi openai:b, K=3, antipodal",
        "vlm cpg gemini:a, K=3, antipodal",
        "vlm cpg openai:b, K=3, antipodal",
    ]
    assert len({method.name for method in methods}) == len(methods) == 10
    with pytest.raises(InputError, match=r"'best'; valid: .*oracle"):
        make_methods(["oracle", "best"])
    with pytest.raises(InputError, match="named twice"):
        make_methods(["oracle", "random", "oracle"])


@pytest.mark.parametrize("allowed", ["[1, head]", "[[head]]", "head", "{head: 1}"])
def test_parts_that_are_no_list_of_names_are_said(allowed, tmp_path):
    path = tmp_path / "odd.yaml"
    path.write_text(
        "groups: [{objects: [hammer], tasks: [{category: use, task: 'use the {object}', "
        f"allowed: {allowed}}}]}}]"
    )
    with pytest.raises(InputError, match="allowed must be a list"):
        load_suite(str(path))


def test_the_help_names_every_suite_that_comes_with_the_package():
    (named,) = re.findall(r"SUITE <str> +(.+?);", " ".join(tog("eval", "--help").out.split()))
    assert sorted(named.split(" | ")) == sorted(suite_files())
