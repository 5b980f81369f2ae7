"""A key lives in the environment: nothing that is written, printed or raised holds a part of it."""

import time
import traceback

import numpy as np
import pytest
from command import tog
from tabletop import TABLE, look
from test_choose import ABOVE, BLOCK
from test_choose import _write as write_view
from test_replay import select
from vlm_server import KEY, PROVIDERS, VlmServer, echo_key, plant_keys

from tog_drake.errors import InputError, Unanswered
from tog_drake.report import EpisodeReport, report_html
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.question import Message
from tog_drake.selectors.vlm.specification import read_specification

MESSAGE = Message((np.zeros((8, 8, 3), np.uint8), "Which?"), None, 100, prompt="gsi/1")
PARTS = (KEY, KEY[:12], KEY[-12:])


@pytest.fixture(autouse=True)
def planted(monkeypatch):
    plant_keys(monkeypatch)


def shows_no_key(text):
    assert not [part for part in PARTS if part in text]


def all_files(folder):
    return b"".join(p.read_bytes() for p in folder.rglob("*") if p.is_file()).decode("latin-1")


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_key_that_a_model_repeats_is_in_no_answer_and_no_cassette(provider, tmp_path):
    with VlmServer(lambda text, images: f"I know {KEY}, and {KEY[:12]}; 2") as server:
        api = read_specification(server.specification(provider), "pixels")
        client = Client(api, profile="pixels", cassette=Cassette(tmp_path / "t.jsonl", "record"))
        asked = client.ask(MESSAGE, time.monotonic() + 5)
        assert len(server.received) == 1
    assert asked.reply.text.startswith("I know [key]")
    for text in (repr(asked), repr(client), repr(api), all_files(tmp_path)):
        shows_no_key(text)
    replayed = Client(api, profile="pixels", cassette=Cassette(tmp_path / "t.jsonl", "replay"))
    assert replayed.ask(MESSAGE, 0.0) == asked


@pytest.mark.parametrize("code", [200, 400, 401, 500])
@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_key_that_an_error_repeats_is_not_raised_and_not_recorded(provider, code, tmp_path):
    path = tmp_path / "t.jsonl"
    with VlmServer(lambda text, images: "2") as server:
        server.misbehave(echo_key(code), always=True)
        api = read_specification(server.specification(provider), "pixels")
        client = Client(api, profile="pixels", cassette=Cassette(path, "record"))
        with pytest.raises(Unanswered) as caught:
            client.ask(MESSAGE, time.monotonic() + 0.3)
    shows_no_key("".join(traceback.format_exception(caught.value)))
    shows_no_key(repr(caught.value))
    shows_no_key(all_files(tmp_path))
    replay = Client(api, profile="pixels", cassette=Cassette(path, "replay"))
    with pytest.raises(Unanswered) as again:
        replay.ask(MESSAGE, 0.0)
    assert (again.value.status, str(again.value)) == (caught.value.status, str(caught.value))


@pytest.mark.parametrize("url", ["http://me:{}@127.0.0.1:9/v1", "http://127.0.0.1:9/v1?key={}"])
def test_a_key_in_a_url_is_refused_and_not_repeated(url):
    with pytest.raises(InputError) as caught:
        read_specification(f"openai:any@{url.format(KEY)}", "pixels")
    shows_no_key("".join(traceback.format_exception(caught.value)))


@pytest.mark.parametrize("answer", [f"{KEY} red {KEY[:12]}", None])
def test_a_key_is_in_nothing_that_the_command_prints_or_writes(answer, tmp_path):
    files = write_view(tmp_path / "view", look([TABLE, BLOCK], eye=ABOVE))
    out, tape = tmp_path / "out", tmp_path / "tape.jsonl"
    with VlmServer(lambda text, images: answer) as server:
        if answer is None:
            server.misbehave(echo_key(401), always=True)
        done = tog(
            "choose", *files, "--task", "pick up the box", "--out", out, "--record", tape,
            "--vlm", server.specification("openai"), "--rendering", "paper", "--debug",
        )  # fmt: skip
        assert server.received or answer is None
    assert done.status == 0, done
    shows_no_key(done.out + done.err)
    assert "[key]" in (out / "episode.json").read_text()
    shows_no_key(all_files(tmp_path))


def test_a_key_that_a_model_repeats_is_not_in_the_report():
    with VlmServer(lambda text, images: f"{KEY}\nFinal answer: red") as server:
        choice = select(url=server.base_url("openai"))
    (exchange,) = choice.exchanges
    assert exchange.answer == "[key]\nFinal answer: red"
    shows_no_key(repr(choice))
    record = {"task": "use it", "choice": {"reason": choice.reason}}
    shows_no_key(report_html([EpisodeReport(record, exchanges=choice.exchanges)]))
