"""``tog vlm export`` and ``tog vlm import``: questions go out, answers come in, the run goes on."""

import json

import cv2
import numpy as np
import pytest
from command import refused, tog
from test_replay import same
from vlm_server import KEY, VlmServer

from tog_drake.options import SelectorOptions
from tog_drake.pipeline import PipelineConfig, make_selector
from tog_drake.scenario import load_scenario
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.recorded import Recorded
from tog_drake.world import build_world, look

TASK = "hand me the hammer"
MODEL = ("--vlm", "openai:any@http://127.0.0.1:9/v1")


def config(**options):
    pipeline = PipelineConfig()
    SelectorOptions("vlm", "cpg", **options).apply(pipeline)
    return pipeline


def looked(pipeline):
    """What a pipeline's selector is given in a real scene, and what it chooses."""
    scenario = load_scenario("Hammer")
    scenario.pipeline.selector = pipeline.selector
    world = build_world(scenario, task=TASK)
    simulator = look(world, scenario, TASK)
    context = world.pipeline.GetMyContextFromRoot(simulator.get_context())
    ports = ("view", "cloud", "candidates", "choice")
    return [world.pipeline.GetOutputPort(port).Eval(context) for port in ports]


def on_the_handle(image):
    """The middle of what is yellow in a picture of the hammer."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    y, x = np.nonzero((red > 170) & (green > 120) & (blue < 80))
    middle = np.argmin(np.hypot(x - np.median(x), y - np.median(y)))
    return {"x": int(x[middle]), "y": int(y[middle])}


@pytest.fixture(autouse=True)
def no_key(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)


def test_a_run_goes_on_where_somebody_answered_its_question_by_hand(tmp_path, monkeypatch):
    tape, out = tmp_path / "tape.jsonl", tmp_path / "out"
    command = ("vlm", "export", "--cassette", tape, *MODEL, "--strategy", "cpg", "--out", out)
    exported = tog(*command, "--task", TASK, "--json")
    assert exported.status == 0, exported.err
    told = json.loads(exported.out)
    assert (told["waiting"], told["questions"], told["decided"]) == (1, 1, 0)
    assert {path.name for path in out.iterdir()} == {
        "answers.jsonl", "batch-1.jsonl", "images", "index.html"
    }  # fmt: skip
    (entry,) = Cassette(tape, "export").questions
    assert entry.pending
    assert TASK in (out / "index.html").read_text(encoding="utf-8")

    line = json.loads((out / "answers.jsonl").read_text())
    sent = json.loads((out / "batch-1.jsonl").read_text())
    assert line["custom_id"] == sent["custom_id"]
    (picture,) = (out / "images").iterdir()
    line["answer"] = json.dumps(on_the_handle(cv2.imread(str(picture))[..., ::-1]))
    (out / "answers.jsonl").write_text(json.dumps(line))
    refused(tog(*command, "--task", TASK), "holds answers that were not imported", "--out")
    imported = tog("vlm", "import", out / "answers.jsonl", "--cassette", tape)
    assert imported.status == 0, imported.err
    assert "1 added" in imported.out
    assert "1 answered, 0 pending" in imported.out
    assert "then: the same tog vlm export again" in imported.out
    again = tog("vlm", "import", out / "answers.jsonl", "--cassette", tape)
    assert "1 known already" in again.out
    assert "then:" not in again.out

    view, cloud, candidates, by_hand = looked(config(replay=tape))
    assert by_hand.exchanges[0].key == entry.key
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    live = tmp_path / "live.jsonl"
    with VlmServer(lambda text, images: line["answer"]) as server:
        model = server.specification("openai")
        selector = make_selector(config(vlm=model, record=live), seed=0)
        recorded = selector.select(view, cloud, candidates, TASK)
    selector = make_selector(config(vlm=f"replay:{live}"), seed=0)
    assert same(recorded, selector.select(view, cloud, candidates, TASK))
    assert recorded.index == by_hand.index


def test_the_view_is_asked_for_first_and_then_the_grasp(tmp_path):
    tape, out = tmp_path / "tape.jsonl", tmp_path / "out"
    command = ("vlm", "export", "--cassette", tape, *MODEL, "--strategy", "cpg", "--out", out)
    command += ("--scenario", "Mug", "--side-cameras", "--view", "vlm-compare")
    command += ("--task", "drink from the mug")

    def asked():
        done = tog(*command, "--json")
        assert done.status == 0, done.err
        assert json.loads(done.out)["waiting"] == 1
        return [entry for entry in Cassette(tape, "export").questions if entry.pending]

    (view,) = asked()
    assert (view.prompt, view.model) == ("view/1", MODEL[1])
    line = json.loads((out / "answers.jsonl").read_text())
    (out / "answers.jsonl").write_text(json.dumps({**line, "answer": "Final answer: 2"}))
    assert tog("vlm", "import", out / "answers.jsonl", "--cassette", tape).status == 0
    (grasp,) = asked()
    assert grasp.prompt == "cpg/1"


def test_a_suite_is_exported_as_far_as_it_comes(tmp_path, monkeypatch):
    from tog_drake import vlm_export
    from tog_drake.vlm_export import _Looked

    cells = []

    def look_at(cell, options, cassette):
        cells.append(cell)
        return _Looked(problem="no grasp") if cell.seed else _Looked()

    monkeypatch.setattr(vlm_export, "_look_at", look_at)
    monkeypatch.setattr(
        vlm_export, "in_processes", lambda work, cells, workers: [(c, work(c)) for c in cells]
    )
    suite = tmp_path / "two.yaml"
    suite.write_text(
        "groups: [{objects: [hammer, mug], tasks: [{category: use, task: 'use the {object}'}]}]"
    )
    done = tog(
        "vlm", "export", suite, "--cassette", tmp_path / "t.jsonl", *MODEL, "--seeds", 2,
        "--strategy", "gmi", "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.status == 0, done.err
    assert [(cell.scenario, cell.seed) for cell in cells] == [
        ("Hammer", 0), ("Hammer", 1), ("Mug", 0), ("Mug", 1)
    ]  # fmt: skip
    assert "2 decided, 0 waiting for answers, 2 without a question" in done.out
    assert "no question: Mug, seed 1: use the mug: no grasp" in done.out
    assert f"go on: tog eval {suite} --vlm replay:{tmp_path / 't.jsonl'}" in done.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("--task for one scenario, or a suite",)),
        (("builtin", "--task", TASK), ("--task for one scenario, or", "not both")),
        (("builtin", "--seed", 3), ("--seeds",)),
        (("--task", "..."), ("no words",)),
        (("--task", TASK, "--strategy", "gpt"), ("strategy", "gsi, cpsi")),
        (("--task", TASK, "--scenario", "Hamer"), ("Hamer",)),
        (("juggling",), ("'juggling'", "builtin", "tog29")),
        (("--task", TASK, "--vlm", "openai:my-own"), ("my-own", "profile")),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(options, words, tmp_path):
    command = ("vlm", "export", "--cassette", tmp_path / "t.jsonl", "--out", tmp_path / "out")
    refused(tog(*command, *MODEL, *options), *words)
    assert not (tmp_path / "t.jsonl").exists()


@pytest.fixture
def tape(tmp_path):
    """A cassette with one question that waits for its answer."""
    path = tmp_path / "tape.jsonl"
    body = {"model": "any"}
    question = Recorded("0" * 64, "/v1/chat/completions", body, MODEL[1], "pixels", "gsi/1")
    Cassette(path, "export").enter(question)
    return path


def test_answers_of_no_use_are_told_and_counted_and_the_others_enter(tape, tmp_path):
    answers = tmp_path / "answers.jsonl"
    lines = [{"custom_id": "\x1b[2J", "answer": "1"}, {"custom_id": "0" * 32, "answer": "2"}]
    answers.write_text("\n".join(map(json.dumps, lines)))
    done = tog("vlm", "import", answers, "--cassette", tape, "--json")
    assert done.status == 1
    told = json.loads(done.out)
    assert (told["added"], len(told["problems"]), told["pending"]) == (1, 1, 0)
    assert "\x1b" not in done.err
    assert f"not used: {answers}, line 1: no question" in done.err.replace("\n", " ")


def test_what_cannot_be_imported_is_refused_in_one_line(tape, tmp_path):
    answers = tmp_path / "answers.jsonl"
    answers.write_text('{"custom_id": "' + "0" * 32 + '", "answer": "1"}\n{oops\n')
    refused(tog("vlm", "import", answers, "--cassette", tape), "line 2 is not valid JSON")
    assert Cassette(tape, "export").questions[0].pending
    none = tmp_path / "none.jsonl"
    refused(tog("vlm", "import", answers, "--cassette", none), "no cassette", "tog vlm export")
    refused(tog("vlm", "import", none, "--cassette", tape), "cannot be read")
    answers.write_text("")
    tape.write_text(tape.read_text().replace("gsi/1", "gsi/1\\u0000") + "{}\n")
    refused(tog("vlm", "import", answers, "--cassette", tape), "line 2 is no line of a cassette")
