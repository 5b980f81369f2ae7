"""The client: one question, one typed end, whatever the server does."""

import time

import numpy as np
import pytest
import vlm_server
from vlm_server import KEY, KEY_VARIABLES, PROVIDERS, VlmServer, status

from tog_drake.selectors.vlm import transport
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.question import Message, Unanswered
from tog_drake.selectors.vlm.specification import read_specification

IMAGE = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)
SCHEMA = {
    "type": "object",
    "properties": {"choice": {"type": "string"}},
    "required": ["choice"],
    "additionalProperties": False,
}
MESSAGE = Message((IMAGE, "Which one?"), SCHEMA, 512, "test/1")


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    monkeypatch.delenv("TOG_PRICES", raising=False)
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)
    monkeypatch.setattr(transport, "FIRST_DELAY", 0.01)


@pytest.fixture
def server():
    with VlmServer(lambda text, images: '{"choice": "2"}') as running:
        yield running


def client(server, provider, **fields):
    config = read_specification(server.specification(provider))
    for name, value in fields.items():
        setattr(config, name, value)
    return Client(config, profile="pixels")


def ask(server, provider, seconds=5.0, **fields):
    return client(server, provider, **fields).ask(MESSAGE, time.monotonic() + seconds)


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_question_is_answered_with_what_it_took(server, provider):
    asked = ask(server, provider)
    assert asked.reply.text == '{"choice": "2"}'
    assert 0.0 < asked.seconds < 5.0
    assert asked.cost is None  # nobody bills for a server on this machine
    assert len(asked.key) == 64


GOOD = None
ONCE = {
    "status 408": status(408),
    "status 409": status(409),
    "status 429": status(429),
    "status 429 with Retry-After": status(429, {"Retry-After": "0.02"}),
    "status 429 with retry-after-ms": status(429, {"retry-after-ms": "20"}),
    "status 500": status(500),
    "status 502 in HTML": vlm_server.html(502),
    "status 503": status(503),
    "status 504": status(504),
    "status 529": status(529),
    "a cut connection": vlm_server.cut,
    "a cut connection, chunked": vlm_server.cut_chunked,
    "a reset": vlm_server.reset,
    "no HTTP": vlm_server.not_http,
}


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("mishap", ONCE.values(), ids=ONCE)
def test_what_passes_is_survived(server, provider, mishap):
    server.misbehave(mishap)
    assert ask(server, provider).reply.text == '{"choice": "2"}'
    assert len(server.received) == 2
    assert server.received[0].body == server.received[1].body


FOR_EVER = {
    **{f"always {name}": (m, {"unreachable", "truncated"}) for name, m in ONCE.items()},
    "a hang": (vlm_server.hang, {"timed_out"}),
    "a trickle": (vlm_server.trickle, {"timed_out"}),
    "a trickle of headers": (vlm_server.trickle_headers, {"timed_out"}),
    "Retry-After beyond the deadline": (status(429, {"Retry-After": "60"}), {"timed_out"}),
    "HTML instead of JSON": (vlm_server.html(), {"unreachable"}),
    "broken JSON": (vlm_server.broken_json, {"unreachable"}),
    "an empty body": (vlm_server.verbatim(b""), {"unreachable"}),
    "JSON of another kind": (vlm_server.verbatim(b'["hello", 1e999]'), {"unreachable"}),
    "NaN": (vlm_server.verbatim(b'{"choices": NaN}'), {"unreachable"}),
    "JSON nested too deeply": (vlm_server.verbatim(b"[" * 200_000), {"unreachable"}),
    "no UTF-8": (vlm_server.verbatim(b'{"a": "\xff\xfe"}'), {"unreachable"}),
    "ten megabytes": (vlm_server.huge, {"too_long"}),
    "a redirect": (vlm_server.redirect("http://127.0.0.1:9/v1"), {"rejected"}),
    "status 400": (status(400), {"rejected"}),
    "status 401 that repeats the key": (vlm_server.echo_key(401), {"rejected"}),
    "status 402": (status(402), {"rejected"}),
    "status 403": (status(403), {"rejected"}),
    "status 404 in HTML": (vlm_server.html(404), {"rejected"}),
    "status 413 in HTML": (vlm_server.html(413), {"rejected"}),
    "status 422": (status(422), {"rejected"}),
    "status 501": (status(501), {"unreachable"}),
    "an error of a line": (status(400, body=b'{"error": "no such model"}'), {"rejected"}),
    "status 418": (status(418, body=b""), {"rejected"}),
}


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("name", FOR_EVER)
def test_every_misbehaviour_ends_in_a_typed_status_within_the_deadline(server, provider, name):
    mishap, expected = FOR_EVER[name]
    server.misbehave(mishap, always=True)
    started = time.monotonic()
    with pytest.raises(Unanswered) as caught:
        ask(server, provider, seconds=0.4)
    assert time.monotonic() - started < 0.6
    assert caught.value.status in expected
    assert str(caught.value).isprintable()
    assert KEY not in repr(caught.value)
