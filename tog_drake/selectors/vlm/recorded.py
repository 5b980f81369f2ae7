"""One line of a cassette: a question and what came of it.

It has the shape of a line of OpenAI's batch files::

    {"custom_id": key, "method": "POST", "url": "/v1/chat/completions", "body": {...},
     "response": {"status_code": 200, "body": {...}} or null,
     "error": {"code": "timed_out", "message": "..."} or null,
     "tog": {"model", "profile", "max_tokens", "effort", "prompt", "source", "seconds", "opencv",
             "time"}}

A line with neither response nor error is a question that waits for its answer. In ``body`` each
image is "sha256:<hex>", the hash of its raw pixels.
"""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from math import isfinite
from typing import Any, Literal, NoReturn, get_args

from tog_drake.errors import InputError
from tog_drake.selectors.vlm.request import Request, image_token
from tog_drake.selectors.vlm.specification import ModelConfig, check_model, read_specification
from tog_drake.values import AnswerStatus

Source = Literal["asked", "batch", "hand"]  # by tog_drake itself, by a batch API, by a person

MAX_LINE = 32_000_000  # [byte]; images are not in it
_KEY = re.compile(r"[0-9a-f]{64}(#[1-9][0-9]{0,5})?")
_VERSION = re.compile(r"[\w.+-]{0,40}", re.ASCII)


@dataclass(frozen=True)
class Recorded:
    """A question in a cassette, and what came of it: a response, an error, or nothing yet."""

    key: str
    url: str  # path
    body: dict[str, Any]  # of the request, images as tokens
    model: str  # specification
    profile: str
    prompt: str
    response: Any = None  # the body of a response of status 200; None: there is none
    error: tuple[AnswerStatus, str] | None = None  # why there is none, and what was said
    source: Source = "asked"
    seconds: float = 0.0  # latency
    max_tokens: int = 4096  # of the model's config; that of a body may be a repair's
    effort: str | None = None  # likewise
    opencv: str = ""  # version that drew the images: another draws letters differently

    @staticmethod
    def of(request: Request) -> "Recorded":
        """Returns a question that waits for its answer."""
        body = request.api.body(request.message, image_token)
        path, prompt = request.api.path(), request.message.prompt
        return Recorded(
            request.key,
            path,
            body,
            request.model,
            request.profile,
            prompt,
            max_tokens=request.api.max_tokens,
            effort=request.api.effort,
            opencv=opencv_version(),
        )

    def config(self) -> ModelConfig:
        """Returns the model that was asked, with the settings on which the key depends.

        Raises:
            InputError: what the line says of it makes no sense.
        """
        config = read_specification(self.model, self.profile)
        config.max_tokens, config.effort = self.max_tokens, self.effort
        check_model(config)
        return config

    @property
    def pending(self) -> bool:
        return self.response is None and self.error is None


def write_entry(entry: Recorded) -> bytes:
    """Returns the line of an entry, with its newline and the time."""
    code = entry.error
    line = {
        "custom_id": entry.key,
        "method": "POST",
        "url": entry.url,
        "body": entry.body,
        "response": None
        if entry.response is None
        else {"status_code": 200, "body": entry.response},
        "error": None if code is None else {"code": code[0], "message": code[1]},
        "tog": {
            "model": entry.model,
            "profile": entry.profile,
            "max_tokens": entry.max_tokens,
            "effort": entry.effort,
            "prompt": entry.prompt,
            "source": entry.source,
            "seconds": round(entry.seconds, 3),
            "opencv": entry.opencv,
            "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        },
    }
    return json.dumps(line).encode() + b"\n"


def read_entry(data: bytes, where: str) -> Recorded:
    """Returns a line of a cassette; ``where`` names it in errors.

    Raises:
        InputError: it is too long, no JSON, or not of the shape above.
    """
    if len(data) > MAX_LINE:
        raise InputError(f"{where} is longer than {MAX_LINE} bytes, the most for one exchange")
    line = read_json(data, where)
    try:
        response, error, tog = line["response"], line["error"], line["tog"]
        entry = Recorded(
            key=line["custom_id"],
            url=line["url"],
            body=line["body"],
            response=None if response is None else response["body"],
            error=None if error is None else (error["code"], error["message"]),
            model=tog["model"],
            profile=tog["profile"],
            prompt=tog["prompt"],
            source=tog["source"],
            seconds=float(tog["seconds"]),
            max_tokens=tog["max_tokens"],
            effort=tog["effort"],
            opencv=tog["opencv"],
        )
        wrong = list(_wrong(entry, response))
    except (KeyError, TypeError, ValueError, OverflowError) as problem:
        raise InputError(f"{where} is no line of a cassette: {problem!r:.200}") from problem
    if wrong:
        raise InputError(f"{where} is no line of a cassette: {', '.join(wrong)}")
    return entry


def _wrong(entry: Recorded, response: Any) -> Iterator[str]:
    """What is wrong with an entry, field by field."""
    if not (isinstance(entry.key, str) and _KEY.fullmatch(entry.key)):
        yield "custom_id is no key of a question"
    if not isinstance(entry.body, dict):
        yield "body is no object"
    texts = (entry.url, entry.model, entry.profile, entry.prompt)
    if not all(isinstance(text, str) for text in texts):
        yield "url, model, profile or prompt is no text"
    if entry.source not in get_args(Source):
        yield f"source is none of {', '.join(get_args(Source))}"
    if not (isfinite(entry.seconds) and entry.seconds >= 0):
        yield "seconds is no duration"
    if type(entry.max_tokens) is not int or not isinstance(entry.effort, str | None):
        yield "max_tokens is no number or effort no text"
    if not (isinstance(entry.opencv, str) and _VERSION.fullmatch(entry.opencv)):
        yield "opencv is no version"
    if response is not None and response["status_code"] != 200:
        yield "a response is not of status 200"
    if response is not None and entry.response is None:
        yield "a response is empty"
    if entry.error is not None and not (
        entry.error[0] in get_args(AnswerStatus) and isinstance(entry.error[1], str)
    ):
        yield "error has no known code or no message"


def opencv_version() -> str:
    """Returns the version of OpenCV that draws the images here."""
    import cv2

    return cv2.__version__


def read_json(data: bytes, where: str) -> Any:
    """Returns the JSON value in ``data``. Raises InputError, and nothing else, if there is none."""

    def refuse(name: str) -> NoReturn:
        raise ValueError(f"{name} is no number of JSON")

    try:
        return json.loads(data.decode("utf-8"), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where} is not valid JSON: {error!s:.200}") from error
