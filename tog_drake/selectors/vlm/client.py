"""Asks one model, through its API or out of a cassette."""

import base64
import logging
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from tog_drake.drawing import encode_png
from tog_drake.errors import Unanswered
from tog_drake.http_post import Rejected, post
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.prices import load_prices
from tog_drake.selectors.vlm.question import Image, Message, Reply
from tog_drake.selectors.vlm.request import Request
from tog_drake.selectors.vlm.specification import ModelConfig, check_model, specification

_log = logging.getLogger(__name__)
_NOT_UNDERSTOOD = (400, 422)  # HTTP status of a request with a parameter that is not taken


@dataclass(frozen=True)
class Asked:
    """What came of a question."""

    reply: Reply
    key: str  # of the question, under which a cassette has it
    seconds: float  # latency, that of the recording where it was replayed
    cost: float | None  # [USD]; None where price or tokens are not known
    replayed: str | None = field(compare=False)
    """The cassette that had the reply; None: the model was asked."""


class Client:
    """Asks one model, and counts how often it is asked the same."""

    def __init__(self, api: ModelConfig, *, profile: str, cassette: Cassette | None = None):
        """Nothing is sent yet.

        Args:
            api: the model, and how to reach it.
            profile: name of the profile by which it points; a cassette notes it.
            cassette: where questions are looked up and, where it is recorded, answers are kept.

        Raises:
            InputError: the config makes no sense, or the table of prices that the user gave
                cannot be read.
        """
        check_model(api)
        self._api = api
        self._profile = profile
        self._cassette = cassette
        self._prices = load_prices()
        self._times: Counter[str] = Counter()  # how often each question was asked
        self._complaints: dict[str, str] = {}  # parameter -> how the server refused it

    def check_key(self) -> None:
        """Raises InputError where the model will be asked for sure, and its key is missing."""
        if self._cassette is None:
            self._api.headers()

    def ask(self, message: Message, deadline: float) -> Asked:
        """Asks, with all the retries that there is time for.

        Args:
            message: the question; the same one again is another question to a cassette.
            deadline: on the clock of ``time.monotonic`` [s].

        Raises:
            Unanswered: nothing came, or nothing that is a reply.
            InputError: the key is missing, or the cassette has no answer and nobody may be asked.
        """
        request = self._request(message, again=True)
        entry = None if self._cassette is None else self._cassette.lookup(request)
        if entry is not None:
            response, seconds = entry.response, entry.seconds
        else:
            response, seconds = self._send(request, deadline)
        reply = self._api.read(response)
        model = reply.model or self._api.model
        return Asked(
            reply=reply,
            key=request.key,
            seconds=seconds,
            cost=self._prices.cost(self._api.url(), model, reply.tokens),
            replayed=None if entry is None or self._cassette is None else str(self._cassette.path),
        )

    @property
    def model(self) -> str:
        """Its name, as it is asked for."""
        return self._api.model

    @property
    def replays(self) -> str | None:
        """The cassette, where all answers and failures come from it; else None."""
        cassette = self._cassette
        return str(cassette.path) if cassette is not None and cassette.mode == "replay" else None

    def key(self, message: Message) -> str:
        """Returns the key under which ``message`` was asked last."""
        return self._request(message).key

    def _request(self, message: Message, *, again: bool = False) -> Request:
        """Returns the question as it was asked last, or as it is asked now."""
        model = specification(self._api)
        first = Request.make(self._api, message, model=model, profile=self._profile)
        self._times[first.key] += again
        times = self._times[first.key]
        if times <= 1:
            return first
        return Request.make(self._api, message, model=model, profile=self._profile, repeat=times)

    def _send(self, request: Request, deadline: float) -> tuple[Any, float]:
        """Returns the body of the response and the seconds that it took; the cassette gets both."""
        started = time.monotonic()
        try:
            response = self._post(self._api.body(request.message, _base64_png), deadline)
        except Unanswered as error:
            if self._cassette is not None:
                self._cassette.add_error(request, error, seconds=time.monotonic() - started)
            raise
        seconds = time.monotonic() - started
        if self._cassette is not None:
            entry = self._cassette.add(request, response, seconds=seconds)
            return entry.response, entry.seconds
        return response, seconds

    def _post(self, body: dict[str, Any], deadline: float) -> Any:
        """Sends a request, again without each parameter that the server names and can be spared."""
        for complaint in self._complaints.values():
            amended = self._api.amend(body, complaint)
            body = body if amended is None else amended[0]
        while True:
            try:
                return post(self._api.url(), self._api.headers(), body, deadline=deadline)
            except Rejected as rejected:
                if rejected.code not in _NOT_UNDERSTOOD:
                    raise
                amended = self._api.amend(body, rejected.complaint)
                if amended is None or amended[1] in self._complaints:
                    raise
                body, name = amended
                self._complaints[name] = rejected.complaint
                _log.warning("%s does not take %s: asked without", specification(self._api), name)


def _base64_png(image: Image) -> str:
    return base64.b64encode(encode_png(image)).decode()
