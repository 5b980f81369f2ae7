from collections import Counter
from dataclasses import replace

import pytest
import yaml

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.suite import (
    SCENARIO,
    load_suite,
    object_labels,
    rows_of_suites,
    suite_files,
)
from tog_drake.benchmark.tables import agreement, failures, summarize
from tog_drake.errors import InputError
from tog_drake.scenario import load_scenario

TRIALS = load_suite(suite_files()["tog29"])
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
    assert trial.allowed | trial.forbidden == set(labels.part_words)
    assert not trial.allowed & trial.forbidden
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
    return path


def test_a_suite_fills_the_objects_name_into_its_tasks(tmp_path):
    (trial,) = load_suite(_suite(tmp_path / "s.yaml"))
    assert (trial.task, trial.scenario, trial.beyond) == ("use the hammer", "Tog29", None)
    assert (trial.allowed, trial.forbidden) == ({"handle"}, {"head"})


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
        ({"task": None}, "it has groups, each of objects and tasks"),
    ],
)
def test_a_suite_that_contradicts_its_labels_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        load_suite(_suite(tmp_path / "s.yaml", **changes))


def test_a_suite_of_objects_without_labels_is_refused(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(yaml.safe_dump({"groups": [{**GROUP, "objects": ["ycb_000_none"]}]}))
    with pytest.raises(InputError, match="no part labels for ycb_000_none"):
        load_suite(path)


def test_a_suite_is_run_object_by_object_and_all_must_be_imported(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    with pytest.raises(InputError, match=r"cy_glue_1, .*tog assets fetch --suite tog29"):
        make_cells(["tog29"], ["oracle"], [0], tasks=[])
    for name in {trial.object for trial in TRIALS}:
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.sdf").touch()
    reading = make_cells(["tog29"], ["oracle"], [0, 1], tasks=[])
    assert len(reading) == 2 * len(TRIALS)
    blind = make_cells(["tog29"], ["top-score"], [0], tasks=[])
    assert len(blind) == 29 + 6
    mug = next(cell for cell in blind if cell.object == MUG)
    assert mug.asset and len(mug.tasks) == 2
    assert not any(cell.asset for cell in blind if cell.scenario != SCENARIO)


def _episode(trial, outcome="lifted", selector="oracle", **rest):
    lifted = outcome == "lifted"
    return {
        "object": trial.object, "seed": 0, "task": trial.task, "scenario": trial.scenario,
        "selector": {"kind": selector}, "vlm": None, "outcome": outcome, "message": None,
        "grasp_success": lifted, "task_compliance": lifted, "combined_success": lifted,
        "strict_success": lifted, "collisions": {}, "held": {}, "closes_on": None, **rest,
    }  # fmt: skip


def test_the_table_of_a_suite_has_a_row_for_each_category_and_two_for_all(monkeypatch):
    beyond = replace(TRIALS[0], beyond="it is too wide")
    monkeypatch.setattr("tog_drake.benchmark.suite.load_suite", lambda path: [beyond, *TRIALS[1:]])
    records = [_episode(TRIALS[0], "no_choice"), *map(_episode, TRIALS[1:])]
    rows = {row["scenario"]: row for row in summarize(records, rows_of_suites(["tog29"]))}
    assert {name: row["tasks"] for name, row in rows.items()} == {
        "position": 36, "use": 11, "handover": 10, "choose": 6, "all": 57,
        "all that 8 cm can hold": 56,
    }  # fmt: skip
    assert rows["all"]["both"] == pytest.approx(56 / 57)
    assert rows["all that 8 cm can hold"]["both"] == 1.0


def test_failures_are_counted_by_outcome_and_reason():
    one, two, three, four = TRIALS[:4]
    records = [
        _episode(one, "no_choice", message="none of 284 grasps"),
        _episode(two, "no_choice", message="none of 12 grasps"),
        _episode(three, combined_success=False, held={"head": 0.7, "body": 0.3}),
        _episode(four),
    ]
    assert [(f["outcome"], f["reason"], f["n"]) for f in failures(records)] == [
        ("no_choice", "none of # grasps", 2),
        ("lifted", "held by head and body", 1),
    ]


def test_labels_agree_where_the_part_between_the_fingers_is_the_one_that_is_held():
    clear, mixed = {"head": 0.9, "body": 0.1}, {"head": 0.6, "body": 0.4}
    records = [
        _episode(TRIALS[0], held=clear, closes_on=clear),
        _episode(TRIALS[2], held=clear, closes_on={"body": 1.0}),
        _episode(TRIALS[4], held=mixed, closes_on=clear),
        _episode(TRIALS[6], "empty", closes_on=clear),
        _episode(TRIALS[8], held={"head": 0.52, "body": 0.48}, closes_on={"body": 1.0}),  # a tie
        _episode(TRIALS[10], held={"head": 0.6, "body": 0.4}, closes_on={"body": 1.0}),
    ]
    assert agreement(records) == {
        "n": 5, "agree": 3, "clear": 2, "clear_agree": 1, "mixed": 3
    }  # fmt: skip
