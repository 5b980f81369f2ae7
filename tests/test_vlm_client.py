"""The client: one question, one typed end, whatever the server does."""

import json
import logging
import time
import traceback
from email.utils import formatdate

import pytest
import vlm_server
from test_vlm_apis import IMAGE, SCHEMA
from vlm_server import KEY, KEY_VARIABLES, PROVIDERS, VlmServer, plant_keys, says, status

from tog_drake import http_post
from tog_drake.errors import InputError, Unanswered
from tog_drake.selectors.vlm.cassette import Cassette, NotRecorded
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.question import Message
from tog_drake.selectors.vlm.specification import read_specification

MESSAGE = Message((IMAGE, "Which one?"), SCHEMA, 512, "test/1")
ANSWER = '{"choice": "2"}'
PATIENCE = 20.0  # [s] for what needs a moment: a busy machine may take its time


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    plant_keys(monkeypatch)
    monkeypatch.delenv("TOG_PRICES", raising=False)
    monkeypatch.setattr(http_post, "FIRST_DELAY", 0.001)


@pytest.fixture
def server():
    with VlmServer(lambda text, images: ANSWER) as running:
        yield running


def client(server, provider, cassette=None, **fields):
    config = read_specification(server.specification(provider))
    for name, value in fields.items():
        setattr(config, name, value)
    return Client(config, profile="pixels", cassette=cassette)


def ask(server, provider, seconds=PATIENCE, **fields):
    return client(server, provider, **fields).ask(MESSAGE, time.monotonic() + seconds)


def caught(server, provider, seconds=PATIENCE):
    with pytest.raises(Unanswered) as info:
        ask(server, provider, seconds)
    return info.value


def leaks(text):
    """The stretches of the key that are in the text, whatever the case of their letters."""
    return [KEY[i : i + 8] for i in range(len(KEY) - 7) if KEY[i : i + 8] in text.lower()]


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_question_is_answered(server, provider):
    asked = ask(server, provider)
    assert asked.reply.text == ANSWER
    assert asked.seconds > 0.0
    assert asked.cost is None  # nobody bills for a server on this machine
    assert len(asked.key) == 64


PASSING = {
    "status 408": status(408),
    "status 409": status(409),
    "status 429": status(429),
    "status 429 with Retry-After": status(429, {"Retry-After": "0.02"}),
    "status 500": status(500),
    "status 502 in HTML": vlm_server.html(502),
    "status 503": status(503),
    "status 504": status(504),
    "status 529": status(529),
    "a cut connection": vlm_server.cut,
    "a cut connection, chunked": vlm_server.cut_chunked,
    "a reset": vlm_server.reset,
    "no HTTP": vlm_server.raw(b"SSH-2.0-OpenSSH_9.2\r\n"),
}
UNREACHABLE = ("status 429", "status 500", "status 502 in HTML", "status 529", "a reset", "no HTTP")
LASTING = {
    **{f"always {name}": (PASSING[name], {"unreachable"}) for name in UNREACHABLE},
    "always a cut connection": (vlm_server.cut, {"unreachable"}),
    "always a cut connection, chunked": (vlm_server.cut_chunked, {"unreachable"}),
    "a hang": (vlm_server.hang, {"timed_out"}),
    "a trickle": (vlm_server.trickle, {"timed_out"}),
    "a trickle of headers": (vlm_server.trickle_headers, {"timed_out"}),
    "Retry-After beyond the deadline": (status(429, {"Retry-After": "60"}), {"timed_out"}),
    "HTML instead of JSON": (vlm_server.html(), {"unreachable"}),
    "broken JSON": (vlm_server.broken_json, {"unreachable"}),
    "an empty body": (vlm_server.verbatim(b""), {"unreachable"}),
    "JSON of another kind": (vlm_server.verbatim(b'["hello", 1e999]'), {"unreachable"}),
    "NaN": (vlm_server.extra(b"NaN"), {"unreachable"}),
    "a number beyond all": (vlm_server.extra(b"-1e999"), {"unreachable"}),
    "JSON nested deeply": (vlm_server.extra(b"[" * 150 + b"]" * 150), {"unreachable"}),
    "JSON nested too deeply": (vlm_server.extra(b"[" * 200_000), {"unreachable"}),
    "no UTF-8": (vlm_server.verbatim(b'{"a": "\xff\xfe"}'), {"unreachable"}),
    "control characters": (vlm_server.verbatim(b"\x1b[2J\x00\xe2\x80\xae", 404), {"rejected"}),
    "a redirect": (vlm_server.redirect("http://127.0.0.1:9/v1"), {"rejected"}),
    "status 400": (status(400), {"rejected"}),
    "status 401": (status(401), {"rejected"}),
    "status 402": (status(402), {"rejected"}),
    "status 403": (status(403), {"rejected"}),
    "status 404 in HTML": (vlm_server.html(404), {"rejected"}),
    "status 413 in HTML": (vlm_server.html(413), {"rejected"}),
    "status 418 without a word": (status(418, body=b""), {"rejected"}),
    "status 422": (status(422), {"rejected"}),
    "status 501": (status(501), {"unreachable"}),
}


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("mishap", PASSING.values(), ids=PASSING)
def test_what_passes_is_survived(server, provider, mishap):
    server.misbehave(mishap)
    assert ask(server, provider).reply.text == ANSWER
    assert len(server.received) == 2
    assert server.received[0].body == server.received[1].body


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize(("mishap", "expected"), LASTING.values(), ids=LASTING)
def test_what_lasts_ends_in_a_typed_status_within_the_deadline(server, provider, mishap, expected):
    server.misbehave(mishap, always=True)
    started = time.monotonic()
    error = caught(server, provider, 0.2 if expected == {"timed_out"} else PATIENCE)
    assert time.monotonic() - started < PATIENCE  # no measure of speed: a hang would never end
    assert error.status in expected
    assert str(error).isprintable()
    assert len(str(error)) < 500


def test_after_the_deadline_nothing_is_asked(server):
    assert caught(server, "openai", seconds=-1.0).status == "timed_out"
    assert server.received == []


def test_what_lies_behind_an_error_of_openrouter_is_read_too(server):
    raw = json.dumps({"error": "response_format is not supported"})
    error = {"message": "Provider returned error", "code": 400, "metadata": {"raw": raw}}
    server.misbehave(status(400, body=json.dumps({"error": error}).encode()))
    assert ask(server, "openai").reply.text == ANSWER
    assert "response_format" not in server.received[1].body


OK = b"HTTP/1.1 200 OK\r\n"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"HTTP/1.1 99999 What\r\n\r\n",
        b"HTTP/1.1 101 Switching\r\n\r\n{}",
        OK + b"Content-Length: -5\r\n\r\n{}",
        OK + b"Content-Length: many\r\n\r\n{}",
        OK + b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n{}",
        OK + b"Content-Length: 99999999999999999999\r\n\r\n{}",
        OK + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n{}",
        OK + b"Transfer-Encoding: chunked\r\n\r\n-2\r\n{}",
        OK + b"Transfer-Encoding: what\r\n\r\n{}",
        OK + b"Content-Encoding: gzip\r\n\r\n{}",
        OK + b"Content-Encoding: gzip, gzip, gzip, gzip, gzip, gzip\r\n\r\n{}",
        OK + b"X: y\r\n" * 200 + b"\r\n{}",
        OK + b"X: " + b"y" * 100_000 + b"\r\n\r\n{}",
        OK + b"\xff\xfe: \x00\r\n\r\n{}",
        b"HTTP/1.1 307 Go\r\nLocation: http://[::1\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 429 Wait\r\nRetry-After: Mon, 99 Foo\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 429 Wait\r\nRetry-After: nan\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 429 Wait\r\nRetry-After: -1e9\r\nContent-Length: 0\r\n\r\n",
    ],
)
def test_broken_http_ends_in_a_typed_status(server, data):
    server.misbehave(vlm_server.raw(data), always=True)
    assert caught(server, "openai").status in {"unreachable", "rejected"}


def test_https_to_a_server_without_it_is_said_so(server):
    url = server.base_url("openai").replace("http:", "https:")
    asking = Client(read_specification(f"openai:any@{url}"), profile="pixels")
    with pytest.raises(Unanswered, match="does not speak https; is it http://") as info:
        asking.ask(MESSAGE, time.monotonic() + PATIENCE)
    assert info.value.status == "unreachable"


@pytest.mark.parametrize(("provider", "hint"), [("openai", "most end in /v1"), ("gemini", "right")])
def test_what_may_be_wrong_with_an_address_is_said_for_its_protocol(server, provider, hint):
    server.misbehave(status(404), always=True)
    said = str(caught(server, provider))
    assert hint in said
    assert ("/v1)" in said) == (provider == "openai")


@pytest.mark.parametrize("provider", PROVIDERS)
def test_ten_megabytes_are_not_read_to_their_end(server, provider):
    server.misbehave(vlm_server.huge)
    assert caught(server, provider).status == "too_long"


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_dead_server_is_unreachable(provider):
    with VlmServer(lambda text, images: "") as server:
        pass
    assert caught(server, provider).status == "unreachable"


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_redirect_is_not_followed(server, provider):
    with VlmServer(lambda text, images: ANSWER) as other:
        server.misbehave(vlm_server.redirect(other.url), always=True)
        error = caught(server, provider)
    assert other.received == []
    assert len(server.received) == 1
    assert f"127.0.0.1:{other.port}" in str(error)


@pytest.mark.parametrize(
    "headers",
    [
        {"Retry-After": "0.12"},
        {"retry-after-ms": "120", "Retry-After": "60"},
        {"retry-after-ms": "soon", "Retry-After": "0.12"},
    ],
    ids=["seconds", "milliseconds first", "nonsense is passed over"],
)
def test_a_server_is_left_alone_for_as_long_as_it_asks(server, headers):
    server.misbehave(status(429, headers))
    asked = ask(server, "openai")
    assert asked.seconds >= 0.12


def test_gemini_says_in_the_body_how_long_to_wait(server):
    detail = b'{"@type": "type.googleapis.com/google.rpc.RetryInfo", "retryDelay": "0.12s"}'
    server.misbehave(status(429, body=b'[{"error": {"code": 429, "details": [7, %b]}}]' % detail))
    assert ask(server, "gemini").seconds >= 0.12


def test_a_date_to_wait_for_beyond_the_deadline_ends_the_question_at_once(server):
    server.misbehave(status(503, {"Retry-After": formatdate(time.time() + 100, usegmt=True)}))
    error = caught(server, "openai")
    assert error.status == "timed_out"
    assert "next attempt" in str(error)
    assert len(server.received) == 1


def test_where_there_is_no_time_for_another_attempt_the_first_failure_counts(server, monkeypatch):
    monkeypatch.setattr(http_post, "FIRST_DELAY", 60.0)
    server.misbehave(status(500), always=True)
    error = caught(server, "openai", seconds=5.0)
    assert error.status == "unreachable"
    assert "next attempt would be in 8 s" in str(error)  # no delay is longer, unless asked for
    assert len(server.received) == 1


def test_a_date_that_has_passed_is_no_wait(server, monkeypatch):
    slept = []
    monkeypatch.setattr(http_post.time, "sleep", slept.append)
    server.misbehave(status(503, {"Retry-After": formatdate(time.time() - 100, usegmt=True)}))
    assert ask(server, "openai").reply.text == ANSWER
    assert slept == [0.0]


def test_the_delays_double_and_attempts_end(server, monkeypatch):
    slept = []
    monkeypatch.setattr(http_post.time, "sleep", slept.append)
    server.misbehave(status(500), always=True)
    assert caught(server, "openai").status == "unreachable"
    assert slept == [0.001, 0.002, 0.004]
    assert len(server.received) == 4


def test_a_server_that_says_not_to_retry_is_believed(server):
    server.misbehave(status(429, {"x-should-retry": "false"}), always=True)
    assert caught(server, "openai").status == "rejected"
    assert len(server.received) == 1


REFUSED = {
    "openai": ["response_format", "reasoning_effort"],
    "gemini": ["responseJsonSchema", "thinkingConfig"],
    "anthropic": ["output_config.format", "output_config.effort"],
}


@pytest.mark.parametrize("provider", PROVIDERS)
def test_parameters_that_a_server_does_not_take_are_left_out(provider, caplog):
    with VlmServer(lambda text, images: ANSWER, lacks=REFUSED[provider]) as server:
        asking = client(server, provider, effort="low")
        first = asking.ask(MESSAGE, time.monotonic() + PATIENCE)
        assert len(server.received) == 3
        assert len(caplog.records) == 2  # it is said, not hidden
        second = asking.ask(MESSAGE, time.monotonic() + PATIENCE)
        assert len(server.received) == 4  # it is remembered
    assert first.reply.text == second.reply.text == ANSWER
    # What the question is, and so its key, does not depend on what a server takes.
    with VlmServer(lambda text, images: ANSWER) as server:
        assert ask(server, provider, effort="low").key == first.key


@pytest.mark.parametrize("old", ["max_tokens", "max_completion_tokens"])
def test_the_limit_of_tokens_is_sent_under_the_name_that_the_server_knows(old, monkeypatch):
    with VlmServer(lambda text, images: ANSWER, lacks=[old]) as server:
        if old == "max_completion_tokens":
            monkeypatch.setattr("tog_drake.selectors.vlm.openai._OPENAI", server.base_url("openai"))
        assert ask(server, "openai").reply.text == ANSWER
        limits = [{k: v for k, v in r.body.items() if k.startswith("max")} for r in server.received]
    new = ({"max_tokens", "max_completion_tokens"} - {old}).pop()
    assert limits == [{old: 512}, {new: 512}]


def test_a_server_that_takes_no_limit_is_not_asked_for_ever():
    lacks = ["max_tokens", "max_completion_tokens"]
    with VlmServer(lambda text, images: ANSWER, lacks=lacks) as server:
        assert caught(server, "openai").status == "rejected"
        assert len(server.received) == 3


@pytest.mark.parametrize(
    "complaint",
    [
        "Could not process image",
        "This model's maximum context length is 4096 tokens; reduce max_tokens or the messages",
        "max_tokens: 100000 > 64000, which is the maximum allowed number of output tokens",
        "Your credit balance is too low; see response_format, effort and thinking",
    ],
)
@pytest.mark.parametrize("provider", PROVIDERS)
def test_other_complaints_change_nothing(server, provider, complaint):
    body = json.dumps({"error": {"message": complaint}}).encode()
    server.misbehave(status(400, body=body), always=True)
    with pytest.raises(Unanswered, match="status 400") as info:
        ask(server, provider, effort="low")
    assert info.value.status == "rejected"
    assert len(server.received) == 1


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("code", [400, 401, 429, 500])
def test_a_key_that_a_server_repeats_is_shown_to_nobody(server, provider, code, caplog):
    caplog.set_level(logging.DEBUG)
    server.misbehave(vlm_server.echo_key(code), always=True)
    error = caught(server, provider)
    assert "[key]" in str(error)
    shown = [str(error), repr(error), repr(vars(error)), caplog.text]
    shown += traceback.format_exception(error)
    assert leaks("".join(shown)) == []


def test_a_key_is_not_shown_in_part_either(server):
    for mishap in (
        vlm_server.redirect(f"http://127.0.0.1/?key={KEY}"),
        vlm_server.verbatim(f"<html>{KEY[3:14]}</html>".encode()),
        vlm_server.verbatim(b"x" * 195 + KEY.encode(), 404),
        vlm_server.verbatim(b"x" * 3995 + KEY.encode(), 404),
        status(400, body=f'{{"error": {{"message": "m", "param": "{KEY}"}}}}'.encode()),
        status(429, {"Retry-After": KEY}),
    ):
        server.misbehave(mishap, always=True)
        error = caught(server, "openai", seconds=0.5)
        assert leaks(repr(vars(error)) + str(error)) == []


def test_a_key_in_an_answer_is_taken_out_of_it(server):
    server.misbehave(says(text=f"Your key is {KEY}."))
    assert ask(server, "openai").reply.text == "Your key is [key]."


def test_a_netrc_file_replaces_no_key(server, tmp_path, monkeypatch):
    netrc = tmp_path / "netrc"
    netrc.write_text("machine 127.0.0.1 login somebody password else\n")
    monkeypatch.setenv("NETRC", str(netrc))
    monkeypatch.setattr(http_post, "is_loopback", lambda url: False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    ask(server, "openai")
    assert server.received[0].headers["authorization"] == f"Bearer {KEY}"


def test_no_proxy_stands_on_the_way_to_this_machine(server, monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:9")
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    assert ask(server, "openai").reply.text == ANSWER


@pytest.mark.parametrize("provider", PROVIDERS)
def test_without_a_key_nothing_is_asked(server, provider, monkeypatch):
    monkeypatch.delenv(KEY_VARIABLES[provider])
    if provider == "openai":  # a local server mostly wants none, and says so if it does
        assert caught(server, provider).status == "rejected"
        return
    with pytest.raises(InputError, match=KEY_VARIABLES[provider]):
        client(server, provider).check_key()
    with pytest.raises(InputError, match=KEY_VARIABLES[provider]):
        ask(server, provider)
    assert not server.received


def test_a_server_that_wants_no_key_is_sent_none(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    with VlmServer(lambda text, images: ANSWER, key=None) as server:
        assert ask(server, "openai").reply.text == ANSWER
        assert "authorization" not in server.received[0].headers


def test_what_was_recorded_is_replayed_without_a_server_or_a_key(tmp_path, monkeypatch):
    with VlmServer(lambda text, images: ANSWER, lacks=["response_format"]) as server:
        recording = client(server, "openai", Cassette(tmp_path / "c.jsonl", "record"))
        asked = [recording.ask(MESSAGE, time.monotonic() + PATIENCE) for _ in range(2)]
    monkeypatch.delenv("OPENAI_API_KEY")
    assert [a.key for a in asked] == [asked[0].key, f"{asked[0].key}#2"]
    assert recording.key(MESSAGE) == asked[1].key
    replaying = client(server, "openai", Cassette(tmp_path / "c.jsonl", "replay"))
    again = [replaying.ask(MESSAGE, 0.0) for _ in range(2)]
    assert [a.reply for a in again] == [a.reply for a in asked]
    assert [a.replayed for a in asked] == [None, None]
    assert [a.replayed for a in again] == 2 * [str(tmp_path / "c.jsonl")]
    assert [a.seconds for a in again] == pytest.approx([a.seconds for a in asked], abs=1e-3)
    with pytest.raises(NotRecorded, match=f"{asked[0].key}#3"):
        replaying.ask(MESSAGE, 0.0)


def test_a_failure_is_recorded_and_replayed(server, tmp_path):
    server.misbehave(status(401), always=True)
    recording = client(server, "gemini", Cassette(tmp_path / "c.jsonl", "record"))
    with pytest.raises(Unanswered) as first:
        recording.ask(MESSAGE, time.monotonic() + PATIENCE)
    replaying = client(server, "gemini", Cassette(tmp_path / "c.jsonl", "replay"))
    with pytest.raises(Unanswered) as second:
        replaying.ask(MESSAGE, 0.0)
    assert (second.value.status, str(second.value)) == (first.value.status, str(first.value))


def test_costs_are_known_where_prices_are(server, tmp_path, monkeypatch):
    prices = tmp_path / "prices.yaml"
    prices.write_text("hosts: {127.0.0.1: {served-model-1: {input: 2.0, output: 10.0}}}")
    monkeypatch.setenv("TOG_PRICES", str(prices))
    assert ask(server, "openai").cost == pytest.approx((1000 * 2.0 + 50 * 10.0) / 1e6)


def test_what_an_answer_holds_besides_does_not_matter(server):
    server.misbehave(vlm_server.extra(b'[[1.5, -2e3, null, "\\u0000"], 123456789012345678901]'))
    assert ask(server, "openai").reply.text == ANSWER
