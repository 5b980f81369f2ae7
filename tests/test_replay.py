"""The selector and a cassette: recorded, replayed or answered elsewhere, the same choice."""

import json
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from test_strategies import bar_scene, to_picture
from test_vlm_selector import TASK, cloud_of
from vlm_server import KEY, VlmServer, hang, status

from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.batch import Export, custom_id
from tog_drake.selectors.vlm.batch_answers import import_answers, read_answers
from tog_drake.selectors.vlm.cassette import Cassette, NotRecorded
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.request import QuestionPending
from tog_drake.selectors.vlm.selector import Vlm, VlmSelector
from tog_drake.values import Workspace

SCENE = bar_scene(n=19)
NOWHERE = "http://127.0.0.1:9/v1"


def select(*, url=NOWHERE, seed=3, task=TASK, export=None, **settings):
    model = None if url is None else OpenAi(model="any", base_url=url)
    config = Vlm(**{"strategy": "cpsi", "rendering": "paper", "model": model, **settings})
    selector = VlmSelector(config, Workspace(), seed=seed, export=export)
    return selector.select(SCENE.view, cloud_of(SCENE.points), SCENE.candidates, task)


def same(a, b):
    """Whether two values are equal to the last bit, arrays in them included.

    All but the fields that are no part of a value, such as which cassette an answer is from.
    """
    if is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a) if f.compare
        )
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def model_of(strategy):
    """What a model says to a strategy's questions in the rendering "paper"."""

    def answer(text, images):
        if strategy not in ("cpg", "avoid"):
            return f"I think so. Final answer: {2 if strategy in ('gmi', 'cpmi') else 'green'}"
        grasp, avoid = (to_picture(SCENE, images[-1], [x, 0, 0.03]) for x in (0.45, 0.57))
        told = {"grasp": grasp} if strategy == "cpg" else {"grasp": grasp, "avoid": avoid}
        return json.dumps([{"x": x, "y": y, "label": role} for role, (x, y) in told.items()])

    return answer


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_an_episode_that_is_replayed_ends_in_the_same_choice_bit_for_bit(strategy, tmp_path):
    path = str(tmp_path / "tape.jsonl")
    with VlmServer(model_of(strategy)) as server:
        url = server.base_url("openai")
        recorded = select(url=url, strategy=strategy, record=path)
        asked = len(server.received)
        assert asked == len(recorded.exchanges) > 0
        again = select(url=url, strategy=strategy, record=path)
        assert len(server.received) == asked  # nothing is asked twice
    replayed = select(url=None, strategy=strategy, replay=path)
    assert recorded.status == "ok"
    assert same(recorded, again)
    assert same(recorded, replayed)
    assert {e.replayed for e in replayed.exchanges} == {path}
    with pytest.raises(NotRecorded, match=strategy):
        select(url=None, strategy=strategy, replay=path, task="use the bar")


@pytest.mark.parametrize("mishap", [hang, status(404), status(500)])
def test_what_was_asked_in_vain_ends_in_the_same_fallback(mishap, tmp_path):
    path = str(tmp_path / "tape.jsonl")
    with VlmServer(lambda text, images: "red") as server:
        server.misbehave(mishap, always=True)
        settings = {"fallback": "geometric", "deadline": 0.2}
        recorded = select(url=server.base_url("openai"), record=path, **settings)
    replayed = select(url=None, replay=path, **settings)
    assert recorded.fallback == "geometric"
    assert (replayed.index, replayed.status, replayed.reason) == (
        recorded.index,
        recorded.status,
        recorded.reason,
    )


def pending(path, **settings):
    with pytest.raises(QuestionPending) as caught:
        select(export=path, **settings)
    return caught.value.requests


def test_both_votes_are_exported_at_once_and_no_key_is_needed(tmp_path, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    path = str(tmp_path / "tape.jsonl")
    first, second = pending(path, votes=2)
    assert first.key != second.key
    (alone,) = pending(path, votes=1)
    assert alone.key == first.key


def answer_by_hand(path, folder, request, answer):
    """Exports a question, fills in the blank answer and imports it."""
    Cassette(path, "export").add_pending(request)
    export = Export(folder)
    export.add(request, "the bar")
    export.finish()
    (blank,) = (folder / "answers.jsonl").read_text().splitlines()
    line = json.loads(blank) | {"answer": answer}
    assert line["custom_id"] == custom_id(request.key)
    (folder / "answers.jsonl").write_text(json.dumps(line))
    imported = import_answers(Cassette(path, "export"), read_answers(folder / "answers.jsonl"))
    assert (imported.added, imported.pending) == (1, 0)


def test_a_strategy_of_several_rounds_goes_on_with_each_answer_until_the_choice_is_made(tmp_path):
    path, settings = str(tmp_path / "tape.jsonl"), {"strategy": "pivot"}
    for asked in range(2):
        (request,) = pending(path, **settings)
        Cassette(path, "export").add_pending(request)
        with pytest.raises(NotRecorded, match="tog vlm import"):
            select(url=None, replay=path, **settings)
        answer_by_hand(path, tmp_path / "export", request, "Final answer: green")
        assert len(Cassette(path, "export").questions) == asked + 1
    choice = select(url=None, replay=path, **settings)
    assert len(choice.exchanges) == 2
    assert {exchange.model for exchange in choice.exchanges} == {"by hand"}
    with VlmServer(lambda text, images: "Final answer: green") as server:
        asked_live = select(url=server.base_url("openai"), **settings)
    assert asked_live.index == choice.index


def test_an_answer_by_hand_that_cannot_be_read_is_asked_for_again_in_the_next_round(tmp_path):
    path = str(tmp_path / "tape.jsonl")
    for answer in ("dunno \ud800", "Final answer: red"):
        (request,) = pending(path)
        answer_by_hand(path, tmp_path / "export", request, answer)
    choice = select(url=None, replay=path)
    assert [exchange.status for exchange in choice.exchanges] == ["unreadable", "ok"]
    assert request.message.prompt == "repair/1"
