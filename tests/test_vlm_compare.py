"""The view that a vision-language model finds clearest, against a server on this machine."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tabletop import HAMMER_SIZED, TABLE, look
from test_strategies import bar_scene
from test_vlm_selector import cloud_of, saying
from vlm_server import KEY, VlmServer, hang

from tog_drake.decision import Decision
from tog_drake.errors import InputError, NoChoice, NoView
from tog_drake.pipeline import make_view_scorer
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.selectors import prompts
from tog_drake.selectors.marks import CANVASES, TILE
from tog_drake.selectors.vlm.cassette import NotRecorded
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.request import QuestionPending
from tog_drake.values import CameraView, Choice, SelectedView
from tog_drake.view_scorers.vlm_compare import VlmCompare, VlmCompareScorer
from tog_drake.vlm_record import exchanges_of

SCENE = bar_scene()
TASK = 'use the "hammer"'
EYES = {"wrist": (0.25, 0.0, 0.45), "left": (0.5, 0.5, 0.3), "far": (-0.4, -0.6, 0.9)}


@cache
def views():
    """What three cameras see of the bar; a wall stands before the second."""
    wall = ((0.35, 0.2, 0.0), (0.65, 0.21, 0.2), (0, 90, 200))
    return tuple(
        CameraView(name, look([TABLE, HAMMER_SIZED] + [wall] * (name == "left"), eye=eye))
        for name, eye in EYES.items()
    )


def config(server, **changes):
    model = OpenAi(model="any", base_url=server.base_url("openai"), max_tokens=500)
    return VlmCompare(**{"model": model, **changes})


def score(asking, seen=None, seed=3, target="hammer", export=None):
    scorer = VlmCompareScorer(asking, seed=seed, export=export)
    cloud = cloud_of(SCENE.points)
    return scorer.score(seen or views(), cloud, SCENE.candidates, target, TASK)


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


@pytest.mark.parametrize("seed", range(4))
def test_the_view_that_the_model_names_has_1_wherever_it_was_shown(seed):
    def behind_the_wall(text, images):
        return f"Final answer: {1 + int(np.argmax([image[..., 2].mean() for image in images]))}"

    with VlmServer(behind_the_wall) as server:
        scores = score(config(server), seed=seed)
    assert scores.values == (0.0, 1.0, 0.0)  # of "left", which alone shows blue
    (exchange,) = scores.exchanges
    assert f"{exchange.answer[-1]} left" in scores.reason
    assert scores.reason.endswith(f"clearest in {exchange.answer[-1]}.")


def test_the_order_of_the_pictures_is_drawn_by_the_seed_and_by_it_alone():
    with saying("Final answer: 1") as server:
        orders = {seed: score(config(server), seed=seed).reason for seed in range(6)}
        again = {seed: score(config(server), seed=seed).reason for seed in range(6)}
    assert orders == again
    assert len(set(orders.values())) > 2


def test_one_question_has_a_numbered_picture_of_each_view_and_the_task_as_data():
    with saying("Final answer: 2") as server:
        scores = score(config(server))
    (exchange,) = scores.exchanges
    (received,) = server.received
    assert exchange.prompt == prompts.load("view").version == "view/1"
    assert (exchange.status, exchange.marks) == ("ok", {})
    assert [f"Image {n}:" in received.text for n in (1, 2, 3, 4)] == [True, True, True, False]
    assert r'Task: "use the \"hammer\""' in received.text
    assert 'in quotes: "hammer"' in received.text
    assert "1, 2, 3" in received.text
    for sent, kept in zip(received.images, exchange.images, strict=True):
        np.testing.assert_array_equal(sent, kept)
        assert (sent.shape[1] // TILE, sent.shape[0] // TILE) in CANVASES


def test_how_sure_the_model_is_of_itself_is_not_asked():
    text = prompts.load("view").source.lower()
    assert not any(word in text for word in ("confiden", "sure", "score", "rate", "percent"))


def test_a_task_that_names_no_object_is_asked_without_one():
    with saying("Final answer: 1") as server:
        score(config(server), target="")
    assert "object that is meant" not in server.received[0].text


def test_of_a_single_view_nothing_is_asked():
    with saying("Final answer: 1") as server:
        scores = score(config(server), views()[:1])
    assert scores.values == (1.0,)
    assert (scores.exchanges, server.received) == ((), [])


@pytest.mark.parametrize(
    ("useless", "found"),
    [("I like them all.", "unreadable"), ("Final answer: 4", "out_of_range"), ("", "empty")],
)
def test_an_answer_that_cannot_be_used_is_asked_for_once_more_and_then_there_is_no_view(
    useless, found
):
    with saying(useless, "Final answer: 3") as server:
        repaired = score(config(server))
    assert [exchange.status for exchange in repaired.exchanges] == [found, "ok"]
    with saying(useless) as server, pytest.raises(NoView, match=found) as caught:
        score(config(server))
    assert caught.value.status == found
    assert caught.value.outcome == "no_view"
    assert [exchange.prompt for exchange in caught.value.exchanges] == ["view/1", "repair/1"]


def test_a_server_that_does_not_answer_ends_at_the_deadline_in_no_view():
    with saying("Final answer: 1") as server:
        server.misbehave(hang, always=True)
        with pytest.raises(NoView, match="timed_out") as caught:
            score(config(server, deadline=0.3))
    assert caught.value.status == "timed_out"


def test_what_was_recorded_is_replayed_without_a_server(tmp_path):
    tape = str(tmp_path / "tape.jsonl")
    with saying("Final answer: 2") as server:
        asked = score(config(server, record=tape))
        replayed = score(VlmCompare(replay=tape))  # the cassette names the model
    assert (replayed.values, replayed.reason) == (asked.values, asked.reason)
    assert [e.replayed for e in (*asked.exchanges, *replayed.exchanges)] == [None, tape]
    assert len(server.received) == 1
    with pytest.raises(NotRecorded, match="view/1"):
        score(VlmCompare(replay=tape), seed=4)


def test_a_question_can_be_written_down_to_be_asked_elsewhere(tmp_path):
    with saying("Final answer: 2") as server, pytest.raises(QuestionPending) as caught:
        score(config(server), export=tmp_path / "tape.jsonl")
    (request,) = caught.value.requests
    assert request.message.prompt == "view/1"
    assert len(request.images) == 3
    assert server.received == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model": None}, r"!VlmCompare has no model to ask: give --vlm"),
        ({"deadline": 0.0}, "!VlmCompare: deadline: 0; valid: above 0, at most 3600 s"),
        ({"record": "a", "replay": "b"}, "!VlmCompare: record and replay are given"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_asked(changes, said):
    with saying("Final answer: 1") as server, pytest.raises(InputError, match=said):
        VlmCompareScorer(config(server, **changes), seed=0)
    assert server.received == []


def test_the_number_of_a_picture_hides_nothing_of_the_things():
    with saying("Final answer: 1") as server:
        (exchange,) = score(config(server), (views()[0], views()[2])).exchanges
    for image in exchange.images:
        white = (image > 240).all(axis=-1)
        red = (image[..., 0] > 150) & (image[..., 1] < 60)
        assert white.any()
        v, u = np.nonzero(white)
        around = red[max(v.min() - 6, 0) : v.max() + 6, max(u.min() - 6, 0) : u.max() + 6]
        assert not around.any()


def test_what_was_asked_of_the_views_is_in_the_record_before_what_was_asked_of_the_grasp():
    with saying("Final answer: 2") as server:
        asked = score(config(server)).exchanges
    selected = SelectedView("wrist", views()[0].view, {}, "", exchanges=asked)
    said = replace(asked[0], prompt="gsi/1")
    choice = replace(Choice.none(), exchanges=(said,))
    chosen = Decision(selected_view=selected, choice=choice)
    assert [e.prompt for e in exchanges_of(chosen)] == ["view/1", "gsi/1"]
    no_choice = Decision(selected_view=selected, error=NoChoice("", exchanges=(said,)))
    assert [e.prompt for e in exchanges_of(no_choice)] == ["view/1", "gsi/1"]
    no_view = Decision(error=NoView("", exchanges=asked))
    assert [e.prompt for e in exchanges_of(no_view)] == ["view/1"]


def test_a_scenario_names_the_model_by_tags():
    scorer = "!VlmCompare {model: !OpenAi {model: any, base_url: http://127.0.0.1:9/v1}}"
    text = f"pipeline: {{view_selection: {{scorer: {scorer}}}}}"
    pipeline = parse_scenario(text, "text", Scenario()).pipeline
    assert isinstance(make_view_scorer(pipeline, seed=3), VlmCompareScorer)
    assert pipeline.view_selection.scorer.model.model == "any"
