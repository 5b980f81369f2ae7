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
import re
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np

KEY = "planted-key-0123456789abcdef"
PROVIDERS = ("openai", "gemini", "anthropic")
KEY_VARIABLES = {
    "openai": "OPENAI_API_KEY",
    "gemini": "GEMINI_API_KEY",
    "anthropic": "ANTHROPIC_API_KEY",
}


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


class Refusal(Exception):
    """The request is not in order: status, message, name of the parameter."""

    def __init__(self, status, message, param=None):
        super().__init__(message)
        self.status, self.param = status, param


class VlmServer:
    """The server, while the ``with`` lasts.

    Args:
        answer: (text, images) -> text; or a ``Spoken``.
        key: that requests must carry; None: none is asked for (OpenAI's protocol alone).
        lacks: names of parameters that are refused with a status 400 which names them, such as
            response_format, max_tokens, thinkingConfig or output_config.effort.
        model: that the server says it is.
    """

    def __init__(self, answer, *, key=KEY, lacks=(), model="served-model-1"):
        self.answer, self.key, self.lacks, self.model = answer, key, frozenset(lacks), model
        self.received: list[Received] = []
        self.errors: list[Exception] = []
        self.closing = threading.Event()
        self._script: Iterator[Callable | None] = iter(())
        self._lock = threading.Lock()
        self._http = _Http(("127.0.0.1", 0), _Handler)
        self._http.vlm = self
        self.port = self._http.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._thread = threading.Thread(
            target=self._http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        )

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, kind, error, trace):
        self.closing.set()
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()
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
    handler.server.vlm.closing.wait(30)


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
            if handler.server.vlm.closing.wait(0.02):
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
        handler.send(200, json.dumps(handler.protocol.reply(said, handler.server.vlm)).encode())

    return mishap


def huge(handler, spoken):
    """Ten megabytes of text."""
    says(text="grasp " * (10 * 2**20 // 6))(handler, spoken)


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request, client_address):
        """A client that went away is none."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    protocol = None

    def log_message(self, *arguments):
        pass

    def do_GET(self):  # the method a followed redirect may end in
        self.send(405, b"{}")

    def do_POST(self):
        vlm = self.server.vlm
        self.close_connection = True
        raw = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        received = Received(None, self.path, {k.lower(): v for k, v in self.headers.items()}, {})
        vlm.received.append(received)
        self.protocol = next((p for p in _PROTOCOLS if p.pattern.fullmatch(self.path)), None)
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
        self.protocol.check_key(self.headers, self.server.vlm.key)
        try:
            body = json.loads(raw)
        except ValueError as error:
            raise Refusal(
                400, f"We could not parse the JSON body of your request: {error}"
            ) from None
        self.protocol.check(body)
        return body

    def _check_lacks(self, body):
        for name in self.server.vlm.lacks:
            if self.protocol.has(body, name):
                raise Refusal(400, self.protocol.lacks(name), name)

    def key(self):
        value = self.headers.get(self.protocol.key_header)
        return value and value.removeprefix("Bearer ")

    def good(self, spoken):
        return json.dumps(self.protocol.reply(spoken, self.server.vlm)).encode()

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


def _want(condition, message, param=None):
    if not condition:
        raise Refusal(400, message, param)


def _check_schema(schema):
    """What strict structured output asks of a schema, with OpenAI and Anthropic."""
    _want(isinstance(schema, dict), "schema: must be an object", "response_format")
    if schema.get("type") == "object":
        _want(
            schema.get("additionalProperties") is False,
            "Invalid schema for response_format: 'additionalProperties' is required to be supplied "
            "and to be false.",
        )
        properties = schema.get("properties", {})
        _want(
            set(schema.get("required", ())) == set(properties),
            "Invalid schema for response_format: 'required' is required to be supplied and to be "
            "an array including every key in properties.",
        )
        for inner in properties.values():
            _check_schema(inner)
    elif schema.get("type") == "array":
        _check_schema(schema.get("items"))


class _OpenAi:
    name = "openai"
    pattern = re.compile(r"/v1/chat/completions")
    key_header = "Authorization"
    known = frozenset(
        [
            "model",
            "messages",
            "max_tokens",
            "max_completion_tokens",
            "response_format",
            "reasoning_effort",
            "n",
            "stop",
            "stream",
            "temperature",
            "top_p",
            "seed",
            "chat_template_kwargs",
        ]
    )

    @staticmethod
    def check_key(headers, key):
        if key is not None and headers.get("Authorization") != f"Bearer {key}":
            raise Refusal(401, "You didn't provide an API key, or not the right one.")

    @classmethod
    def check(cls, body):
        _want(isinstance(body, dict), "Invalid body: expected an object.")
        for name in set(body) - cls.known:
            raise Refusal(400, f"Unrecognized request argument supplied: {name}")
        _want(isinstance(body.get("model"), str) and body["model"], "you must provide a model")
        both = "max_tokens" in body and "max_completion_tokens" in body
        _want(not both, "Setting 'max_tokens' and 'max_completion_tokens' at the same time")
        for limit in ("max_tokens", "max_completion_tokens"):
            _want(isinstance(body.get(limit, 1), int), f"Invalid type for '{limit}'", limit)
        messages = body.get("messages")
        _want(isinstance(messages, list) and messages, "Missing required parameter: 'messages'.")
        for message in messages:
            _want(message.get("role") in ("user", "system", "assistant", "developer"), "role")
            for part in cls.parts(message):
                _want(part.get("type") in ("text", "image_url"), "Invalid value: 'type'")
                if part["type"] == "text":
                    _want(isinstance(part.get("text"), str), "Missing parameter: 'text'")
                else:
                    url = part.get("image_url")
                    _want(isinstance(url, dict), "Invalid type for 'image_url': an object")
                    known = str(url.get("url", "")).startswith("data:image/png;base64,")
                    _want(known, "image URLs are not currently supported, please use base64")
        if "response_format" in body:
            cls.check_format(body["response_format"])

    @staticmethod
    def check_format(wanted):
        _want(wanted.get("type") == "json_schema", "Invalid value: 'response_format.type'")
        schema = wanted.get("json_schema", {})
        _want(re.fullmatch(r"[\w-]{1,64}", str(schema.get("name", ""))), "json_schema.name")
        _want(
            "schema" in schema, "Missing required parameter: 'response_format.json_schema.schema'"
        )
        if schema.get("strict"):
            _check_schema(schema["schema"])

    @staticmethod
    def parts(message):
        content = message.get("content")
        if isinstance(content, str):
            return [{"type": "text", "text": content}]
        _want(isinstance(content, list) and content, "Invalid type for 'messages[0].content'")
        return content

    @classmethod
    def contents(cls, body):
        parts = [part for message in body["messages"] for part in cls.parts(message)]
        texts = [part["text"] for part in parts if part["type"] == "text"]
        urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
        return texts, [url.partition(",")[2] for url in urls]

    @staticmethod
    def has(body, name):
        return name in body

    @staticmethod
    def lacks(name):
        other = {
            "max_tokens": "max_completion_tokens",
            "max_completion_tokens": "max_tokens",
        }.get(name)
        hint = f" Use '{other}' instead." if other else ""
        return f"Unsupported parameter: '{name}' is not supported with this model.{hint}"

    @staticmethod
    def error(code, message, param):
        return {"error": {"message": message, "type": "error", "param": param, "code": None}}

    @staticmethod
    def reply(spoken, vlm):
        finish = {"refusal": "stop", "blocked": "content_filter"}.get(spoken.finish, spoken.finish)
        message = {"role": "assistant", "content": spoken.text, "refusal": spoken.refusal}
        if spoken.reasoning is not None:  # as vLLM says it, and as llama.cpp does
            message |= {"reasoning": spoken.reasoning, "reasoning_content": spoken.reasoning}
        return {
            "id": "chatcmpl-1",
            "object": "chat.completion",
            "created": 1_700_000_000,
            "model": vlm.model,
            "choices": [{"index": 0, "message": message, "finish_reason": finish}],
            "usage": {
                "prompt_tokens": 1000,
                "completion_tokens": 50,
                "total_tokens": 1050,
                "completion_tokens_details": {"reasoning_tokens": 30},
            },
        }


class _Gemini:
    name = "gemini"
    pattern = re.compile(r"/v1beta/models/[^/:]+:generateContent")
    key_header = "x-goog-api-key"
    known = frozenset(
        [
            "maxOutputTokens",
            "responseMimeType",
            "responseSchema",
            "responseJsonSchema",
            "thinkingConfig",
            "mediaResolution",
            "temperature",
            "topP",
            "topK",
            "seed",
        ]
    )

    @staticmethod
    def check_key(headers, key):
        given = headers.get("x-goog-api-key")
        if given is None:
            raise Refusal(403, "Method doesn't allow unregistered callers. Please use API Key.")
        if given != key:
            raise Refusal(400, "API key not valid. Please pass a valid API key.")

    @classmethod
    def check(cls, body):
        def known(value, names, where):
            for name in set(value) - set(names):
                raise Refusal(
                    400,
                    f'Invalid JSON payload received. Unknown name "{name}" at {where!r}: '
                    "Cannot find field.",
                )

        known(body, ("contents", "systemInstruction", "generationConfig", "safetySettings"), "")
        config = body.get("generationConfig", {})
        known(config, cls.known, "generation_config")
        thinking = config.get("thinkingConfig", {})
        known(thinking, ("thinkingLevel", "thinkingBudget", "includeThoughts"), "thinking_config")
        if {"responseSchema", "responseJsonSchema"} & set(config):
            mime = config.get("responseMimeType")
            _want(mime == "application/json", "response_mime_type must be application/json")
        contents = body.get("contents")
        _want(isinstance(contents, list) and contents, "* GenerateContentRequest.contents: empty")
        for content in contents:
            _want(content.get("role", "user") in ("user", "model"), "Please use a valid role")
            _want(content.get("parts"), "contents.parts must not be empty.")
            for part in content["parts"]:
                known(part, ("text", "inlineData", "inline_data"), "contents[0].parts[0]")
                _want(len(part) == 1, "oneof field 'data' is already set")
                blob = part.get("inlineData") or part.get("inline_data")
                if blob is not None:
                    mime = blob.get("mimeType") or blob.get("mime_type")
                    _want(mime == "image/png", f"Unsupported MIME type: {mime}")

    @staticmethod
    def contents(body):
        parts = [part for content in body["contents"] for part in content["parts"]]
        blobs = [part.get("inlineData") or part.get("inline_data") for part in parts]
        return [p["text"] for p in parts if "text" in p], [b["data"] for b in blobs if b]

    @staticmethod
    def has(body, name):
        return name in body.get("generationConfig", {})

    @staticmethod
    def lacks(name):
        return {
            "thinkingConfig": "Thinking level is not supported for this model.",
            "responseJsonSchema": "JSON mode is not enabled for this model",
        }.get(name, f"Unknown name {name}: Cannot find field.")

    @staticmethod
    def error(code, message, param):
        words = {400: "INVALID_ARGUMENT", 403: "PERMISSION_DENIED", 429: "RESOURCE_EXHAUSTED"}
        return {"error": {"code": code, "message": message, "status": words.get(code, "INTERNAL")}}

    @staticmethod
    def reply(spoken, vlm):
        body = {
            "usageMetadata": {
                "promptTokenCount": 1000,
                "candidatesTokenCount": 20,
                "thoughtsTokenCount": 30,
                "totalTokenCount": 1050,
            },
            "modelVersion": vlm.model,
            "responseId": "r-1",
        }
        if spoken.finish == "blocked":
            return {"promptFeedback": {"blockReason": "SAFETY"}, **body}
        finish = {"stop": "STOP", "length": "MAX_TOKENS", "refusal": "PROHIBITED_CONTENT"}
        candidate = {"finishReason": finish[spoken.finish], "index": 0}
        parts = []
        if spoken.reasoning is not None:
            parts.append({"text": spoken.reasoning, "thought": True})
        if spoken.text is not None:
            parts += [{"text": spoken.text}, {"thoughtSignature": "c2lnbmF0dXJl"}]
        content = {"role": "model", "parts": parts} if parts else {"role": "model"}
        return {"candidates": [{"content": content, **candidate}], **body}


class _Anthropic:
    name = "anthropic"
    pattern = re.compile(r"/v1/messages")
    key_header = "x-api-key"
    known = frozenset(
        ["model", "max_tokens", "messages", "system", "output_config", "thinking", "stream"]
    )

    @staticmethod
    def check_key(headers, key):
        if headers.get("x-api-key") != key:
            raise Refusal(401, "invalid x-api-key")
        _want("anthropic-version" in headers, "anthropic-version: header is required")

    @classmethod
    def check(cls, body):
        for name in set(body) - cls.known:
            raise Refusal(400, f"{name}: Extra inputs are not permitted")
        for name in ("model", "max_tokens", "messages"):
            _want(name in body, f"{name}: Field required")
        _want(isinstance(body["max_tokens"], int) and body["max_tokens"] > 0, "max_tokens: integer")
        _want(isinstance(body["messages"], list) and body["messages"], "messages: at least one")
        config = body.get("output_config", {})
        for name in set(config) - {"effort", "format"}:
            raise Refusal(400, f"output_config.{name}: Extra inputs are not permitted")
        if "format" in config:
            _want(config["format"].get("type") == "json_schema", "output_config.format.type")
            _check_schema(config["format"].get("schema"))
        for message in body["messages"]:
            _want(message.get("role") in ("user", "assistant"), "messages.0.role: Input should be")
            for block in cls.blocks(message):
                cls.check_block(block)
        _want(body["messages"][-1]["role"] == "user", "This model does not support prefill.")

    @staticmethod
    def check_block(block):
        if block.get("type") == "text":
            text = block.get("text")
            _want(isinstance(text, str) and text.strip(), "text content blocks must be non-empty")
        elif block.get("type") == "image":
            source = block.get("source", {})
            _want(source.get("type") == "base64", "messages.0.content.0.image.source.type")
            _want(source.get("media_type") == "image/png", "image.source.media_type: Input should")
        else:
            raise Refusal(400, "messages.0.content.0: Input tag does not match any of the expected")

    @staticmethod
    def blocks(message):
        content = message.get("content")
        if isinstance(content, str):
            return [{"type": "text", "text": content}]
        _want(isinstance(content, list) and content, "messages.0.content: Field required")
        return content

    @classmethod
    def contents(cls, body):
        blocks = [block for message in body["messages"] for block in cls.blocks(message)]
        texts = [block["text"] for block in blocks if block["type"] == "text"]
        return texts, [block["source"]["data"] for block in blocks if block["type"] == "image"]

    @staticmethod
    def has(body, name):
        first, _, rest = name.partition(".")
        return first in body and (not rest or rest in body[first])

    @staticmethod
    def lacks(name):
        return {
            "output_config.effort": "This model does not support the effort parameter.",
        }.get(name, f"{name}: Extra inputs are not permitted")

    @staticmethod
    def error(code, message, param):
        kinds = {
            400: "invalid_request_error",
            401: "authentication_error",
            429: "rate_limit_error",
            529: "overloaded_error",
        }
        error = {"type": kinds.get(code, "api_error"), "message": message}
        return {"type": "error", "error": error, "request_id": "req_1"}

    @staticmethod
    def reply(spoken, vlm):
        content = []
        if spoken.reasoning is not None:
            content.append({"type": "thinking", "thinking": spoken.reasoning, "signature": "c2ln"})
        if spoken.text is not None:
            content.append({"type": "text", "text": spoken.text})
        stop = {"stop": "end_turn", "length": "max_tokens"}.get(spoken.finish, "refusal")
        return {
            "id": "msg_1",
            "type": "message",
            "role": "assistant",
            "model": vlm.model,
            "content": content,
            "stop_reason": stop,
            "stop_sequence": None,
            "stop_details": {"type": "refusal", "category": None, "explanation": spoken.refusal}
            if stop == "refusal"
            else None,
            "usage": {
                "input_tokens": 1000,
                "output_tokens": 50,
                "output_tokens_details": {"thinking_tokens": 30},
            },
        }


_PROTOCOLS = (_OpenAi, _Gemini, _Anthropic)
