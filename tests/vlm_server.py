"""A server on this machine that speaks the protocols of OpenAI, Google and Anthropic.

It checks requests as the providers do and answers through a Python function, or misbehaves in a
way that providers, proxies and dying machines do::

    with VlmServer(lambda text, images: "2") as server:
        server.specification("openai")  # openai:any@http://127.0.0.1:PORT/v1
        server.misbehave(status(500), hang)  # the next two requests
        server.received  # what was asked
"""

import base64
import binascii
import contextlib
import itertools
import json
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler

import cv2
import numpy as np
from loopback import LoopbackServer
from vlm_protocols import PROTOCOLS, Refusal

KEY = "planted-key-0123456789abcdef"
PROVIDERS = ("openai", "gemini", "anthropic")
KEY_VARIABLES = {
    "openai": "OPENAI_API_KEY",
    "gemini": "GEMINI_API_KEY",
    "anthropic": "ANTHROPIC_API_KEY",
}


def plant_keys(monkeypatch) -> None:
    """Sets the key of every provider, and no other."""
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)


@dataclass
class Received:
    """A request that was in order, and one that was not."""

    provider: str | None
    path: str
    headers: dict[str, str]  # names in lower case
    body: dict
    text: str = ""  # the text parts, joined by line ends
    images: tuple[np.ndarray, ...] = ()  # (H, W, 3) RGB


@dataclass
class Spoken:
    """What a model says, before a protocol gives it a form."""

    text: str | None
    finish: str = "stop"  # or length, refusal, blocked
    reasoning: str | None = None
    refusal: str | None = None


class VlmServer(LoopbackServer):
    """The server, while the ``with`` lasts.

    Args:
        answer: (text, images) -> text; or a ``Spoken``.
        key: that requests must carry; None: none is asked for (OpenAI's protocol alone).
        lacks: names of parameters that are refused with a status 400 which names them, such as
            response_format, max_tokens, thinkingConfig or output_config.effort.
        model: that the server says it is.
        port: 0 takes any that is free.
    """

    def __init__(self, answer, *, key=KEY, lacks=(), model="served-model-1", port=0):
        super().__init__(_Handler, port=port)
        self.answer, self.key, self.lacks, self.model = answer, key, frozenset(lacks), model
        self.received: list[Received] = []
        self.errors: list[Exception] = []
        self._script: Iterator[Callable | None] = iter(())
        self._lock = threading.Lock()

    def __exit__(self, kind, error, trace):
        super().__exit__(kind, error, trace)
        if kind is None and self.errors:
            raise self.errors[0]

    def misbehave(self, *mishaps, always=False):
        """The next requests meet these, one each (None: a good answer); ``always``: for ever."""
        self._script = itertools.cycle(mishaps) if always else iter(mishaps)

    def next_mishap(self):
        with self._lock:
            return next(self._script, None)

    def base_url(self, provider):
        return self.url + "/v1" if provider in ("openai", "molmo", "qwen") else self.url

    def specification(self, provider, model="any"):
        return f"{provider}:{model}@{self.base_url(provider)}"


# Mishaps: each takes the handler and the good answer, and writes something else.


def status(code, headers=None, body=None):
    """An error as the provider words it, or ``body`` verbatim."""

    def mishap(handler, spoken):
        if body is not None:
            handler.send(code, body, headers)
        else:
            handler.send_error_body(code, "the server said so", extra=headers)

    return mishap


def hang(handler, spoken):
    """Takes the request and says nothing."""
    handler.server.owner.closing.wait(30)


def trickle(handler, spoken):
    """A byte now and then: no socket ever times out."""
    data = handler.good(spoken)
    handler.send_head(200, len(data) + 10_000)
    _drip(handler, data + b" " * 10_000)


def trickle_headers(handler, spoken):
    """The same before the answer has begun."""
    _drip(handler, b"HTTP/1.1 200 OK\r\nX-Slow: " + b"z" * 10_000)


def _drip(handler, data):
    with contextlib.suppress(OSError):
        for i in range(len(data)):
            handler.wfile.write(data[i : i + 1])
            if handler.server.owner.closing.wait(0.02):
                return


def cut(handler, spoken):
    """The connection ends in the middle of the answer."""
    data = handler.good(spoken)
    handler.send_head(200, len(data))
    handler.wfile.write(data[: len(data) // 2])


def cut_chunked(handler, spoken):
    """The same where the length was not told."""
    data = handler.good(spoken)
    handler.send_head(200, None)
    handler.wfile.write(b"%x\r\n%s" % (len(data), data[: len(data) // 2]))


def reset(handler, spoken):
    """The connection ends before the answer, without a goodbye."""
    linger = b"\x01\x00\x00\x00\x00\x00\x00\x00"
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)


def raw(data):
    """These bytes in place of an answer, the status line included."""
    return lambda handler, spoken: handler.wfile.write(data)


def html(code=200):
    page = b"<!DOCTYPE html><html><head><title>Bad gateway</title></head><body>nginx</body></html>"
    return lambda handler, spoken: handler.send(code, page, {"Content-Type": "text/html"})


def verbatim(data, code=200):
    """These bytes as the body."""
    return lambda handler, spoken: handler.send(code, data)


def extra(value):
    """A good answer with these bytes as one more value in it."""
    return lambda handler, spoken: handler.send(
        200, handler.good(spoken)[:-1] + b', "extra": ' + value + b"}"
    )


def broken_json(handler, spoken):
    handler.send(200, handler.good(spoken)[:-3])


def redirect(location):
    return lambda handler, spoken: handler.send(307, b"", {"Location": location})


def echo_key(code):
    """An error that repeats the key, as providers do; also cut short, and in other letters."""

    def mishap(handler, spoken):
        key = handler.key() or ""
        message = f"Incorrect API key provided: {key}. Also {key[:14]}..., {key.upper()}."
        handler.send_error_body(code, message, extra={"X-Echo": key})

    return mishap


def says(**changes):
    """The model says something else: ``says(text="...", finish="length", reasoning="...")``."""

    def mishap(handler, spoken):
        said = Spoken(**{**vars(spoken), **changes})
        handler.send(200, json.dumps(handler.protocol.reply(said, handler.server.owner)).encode())

    return mishap


def huge(handler, spoken):
    """Ten megabytes of text."""
    says(text="grasp " * (10 * 2**20 // 6))(handler, spoken)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    protocol = None

    def log_message(self, *arguments):
        pass

    def do_GET(self):  # the method a followed redirect may end in
        self.send(405, b"{}")

    def do_POST(self):
        vlm = self.server.owner
        self.close_connection = True
        raw = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        received = Received(None, self.path, {k.lower(): v for k, v in self.headers.items()}, {})
        vlm.received.append(received)
        self.protocol = next((p for p in PROTOCOLS if p.pattern.fullmatch(self.path)), None)
        try:
            if self.protocol is None:
                self.send(404, b'{"error": "page not found"}')
                return
            received.provider = self.protocol.name
            received.body = self._checked(raw)
            texts, images = self.protocol.contents(received.body)
            received.text = "\n".join(texts)
            received.images = tuple(_image(data) for data in images)
            self._check_lacks(received.body)
            said = vlm.answer(received.text, list(received.images))
            spoken = said if isinstance(said, Spoken) else Spoken(said)
        except Refusal as refusal:
            self.send_error_body(refusal.status, str(refusal), refusal.param)
            return
        except Exception as error:
            vlm.errors.append(error)
            self.send_error_body(500, f"the test's answer() failed: {error}")
            return
        mishap = vlm.next_mishap()
        with contextlib.suppress(OSError):  # a client that gave up
            if mishap is not None:
                mishap(self, spoken)
            else:
                self.send(200, self.good(spoken))

    def _checked(self, raw):
        if self.headers.get("Content-Type") != "application/json":
            raise Refusal(415, "Content-Type must be application/json")
        self.protocol.check_key(self.headers, self.server.owner.key)
        try:
            body = json.loads(raw)
        except ValueError as error:
            raise Refusal(
                400, f"We could not parse the JSON body of your request: {error}"
            ) from None
        self.protocol.check(body)
        return body

    def _check_lacks(self, body):
        for name in self.server.owner.lacks:
            if self.protocol.has(body, name):
                raise Refusal(400, self.protocol.lacks(name), name)

    def key(self):
        value = self.headers.get(self.protocol.key_header)
        return value and value.removeprefix("Bearer ")

    def good(self, spoken):
        return json.dumps(self.protocol.reply(spoken, self.server.owner)).encode()

    def send_error_body(self, code, message, param=None, extra=None):
        self.send(code, json.dumps(self.protocol.error(code, message, param)).encode(), extra)

    def send(self, code, data, extra=None):
        self.send_head(code, len(data), extra)
        self.wfile.write(data)

    def send_head(self, code, length, extra=None):
        self.send_response(code)
        headers = {"Content-Type": "application/json", "Connection": "close", **(extra or {})}
        if length is None:
            headers["Transfer-Encoding"] = "chunked"
        else:
            headers["Content-Length"] = str(length)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()


def _image(data):
    try:
        png = np.frombuffer(base64.b64decode(data, validate=True), np.uint8)
    except (binascii.Error, TypeError):
        raise Refusal(400, "image: invalid base64 data") from None
    image = cv2.imdecode(png, cv2.IMREAD_COLOR) if len(png) else None
    if image is None:
        raise Refusal(400, "Could not process image")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
