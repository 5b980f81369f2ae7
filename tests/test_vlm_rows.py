"""The row of a model tells how often it was right: so often as the model itself says.

The model is ``knowing_server``'s: what is right it was taught, and its errors are drawn.
"""

import json

import pytest
from command import tog
from knowing_server import NOT_CARRIED_OUT, KnowingModel, learn, trial_of
from vlm_server import VlmServer

from tog_drake.benchmark.journal import read_run
from tog_drake.benchmark.suite import load_suite
from tog_drake.benchmark.tables import ALL

PROBABILITY = 0.7
STRATEGIES = ("gsi", "cpg")
TASKS = {
    "use the hammer": "use",
    "hand me the hammer": "handover",
    "pick up the hammer by its head": "position",
    "pick up the hammer by its handle": "position",
}


@pytest.fixture
def suite(tmp_path):
    tasks = [{"category": category, "task": task} for task, category in TASKS.items()]
    path = tmp_path / "hammer.yaml"
    path.write_text(json.dumps({"groups": [{"objects": ["hammer"], "tasks": tasks}]}))
    return path


def run(suite, server, out, *options):
    """Asks the server in a run of its own; returns its rows by strategy, and its lines."""
    specification = server.specification("openai")
    done = tog(
        "eval", suite, "--vlm", specification, "--strategies", ",".join(STRATEGIES),
        "--scenario-text", NOT_CARRIED_OUT, "--out", out, "--json", *options,
    )  # fmt: skip
    assert done.status == 0, done
    rows = {(row["method"], row["group"]): row for row in json.loads(done.out)["rows"]}
    of_all = {s: rows.get((f"vlm {s} {specification}", ALL)) for s in STRATEGIES}
    return of_all, read_run(out).lines


def decided(line):
    record = line["record"]
    asked = [(e["key"], e["answer"], e["points"]) for e in record["vlm"]["exchanges"]]
    return asked, record["choice"], record["chosen_closes_on"], record["outcome"]


def test_the_rows_of_a_model_say_how_often_it_was_right_whoever_asks_and_when(suite, tmp_path):
    lessons = learn(load_suite(str(suite)), STRATEGIES, [0])
    assert all(lesson.leaves_a_choice for lesson in lessons.values())
    model = KnowingModel(lessons.values(), PROBABILITY)
    with VlmServer(model, key=None) as server:
        rows, lines = run(suite, server, tmp_path / "two", "--workers", 2)
        was_right = dict(model.was_right)
        _, again = run(suite, server, tmp_path / "one", "--workers", 1, "--limit", 2)
    assert was_right.keys() == lessons.keys() == {trial_of(line["cell"]) for line in lines}
    for strategy, row in rows.items():
        right = [told for trial, told in was_right.items() if trial[3] == strategy]
        assert set(right) == {True, False}
        assert (row["chosen_successes"], row["tasks"]) == (sum(right), len(TASKS))
        assert row["chosen_low"] < PROBABILITY < row["chosen_high"]
    assert [line["cell"] for line in again] == [line["cell"] for line in lines[:2]]
    assert [decided(line) for line in again] == [decided(line) for line in lines[:2]]
    assert model.was_right == was_right
