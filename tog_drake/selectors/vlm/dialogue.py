"""The questions of one decision and the model's answers, in order.

The client sends, ``answers`` reads; here a question whose answer is no use is put once more,
and every exchange is kept for the record.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace

from tog_drake.errors import Unanswered
from tog_drake.selectors import prompts
from tog_drake.selectors.vlm import answers
from tog_drake.selectors.vlm.client import Asked, Client
from tog_drake.selectors.vlm.profiles import Profile
from tog_drake.selectors.vlm.question import (
    Answer,
    Image,
    Message,
    Options,
    Points,
    Question,
    Reply,
)
from tog_drake.values import Exchange

REPAIRABLE = frozenset(
    {"unreadable", "ambiguous", "out_of_range", "empty", "truncated", "off_image", "off_object"}
)
"""After these a model is asked once more: it was willing, but what it said is no use."""
MORE_TOKENS = 4  # times as many, where the first answer was truncated
_EXCERPT = 300  # characters of an unusable answer that are quoted
_heard: ContextVar[list[Exchange] | None] = ContextVar("_heard", default=None)


@contextmanager
def all_exchanges() -> Iterator[list[Exchange]]:
    """Collects what is asked meanwhile, by whomever, also where nothing else comes of it."""
    collected: list[Exchange] = []
    before = _heard.set(collected)
    try:
        yield collected
    finally:
        _heard.reset(before)


class Dialogue:
    """The questions of one decision: asks within its deadline and keeps every exchange."""

    def __init__(self, client: Client, profile: Profile, *, max_tokens: int, deadline: float):
        """Args: ``deadline`` by ``time.monotonic`` [s]; ``max_tokens`` of each answer."""
        self._client = client
        self._profile = profile
        self._max_tokens = max_tokens
        self._deadline = deadline
        self.exchanges: tuple[Exchange, ...] = ()

    def ask(self, question: Question) -> Answer:
        """Returns the model's answer, to a repair question where the first is no use.

        Raises Unanswered where neither can be used.
        """
        try:
            return self._exchange(question, self._max_tokens)
        except Unanswered as error:
            if error.status not in REPAIRABLE:
                raise
            first = error
        repair = prompts.load("repair")
        said = (self.exchanges[-1].answer or "")[-_EXCERPT:]
        text = repair.render(problem=str(first), answer=said)
        again = replace(question, prompt=repair.version, parts=(*question.parts, text))
        more = MORE_TOKENS if first.status == "truncated" else 1
        try:
            return self._exchange(again, more * self._max_tokens)
        except Unanswered as second:
            raise Unanswered(second.status, f"{first}; asked again: {second}") from second

    def _exchange(self, question: Question, max_tokens: int) -> Answer:
        """Asks once, and notes what came of it."""
        message = Message(
            parts=(*question.parts, answers.instruction(self._profile, question.expects)),
            schema=answers.schema(self._profile, question.expects),
            max_tokens=max_tokens,
            prompt=question.prompt,
        )
        started = time.monotonic()
        asked: Asked | None = None
        answer: Answer | None = None
        try:
            asked = self._client.ask(message, self._deadline)
            answer = _read(asked.reply, self._profile, question.expects)
            question.check(answer)
        except Unanswered as error:
            self._note(question, message, asked, error, time.monotonic() - started, answer)
            raise
        self._note(question, message, asked, None, asked.seconds, answer)
        return answer

    def _note(
        self,
        question: Question,
        message: Message,
        asked: Asked | None,
        error: Unanswered | None,
        seconds: float,
        answer: Answer | None = None,
    ) -> None:
        reply = None if asked is None else asked.reply
        replayed = self._client.replays if asked is None else asked.replayed
        if asked is None and replayed is not None:
            seconds = 0.0  # to look it up is no latency of the model
        text, images = _shown(message.parts)
        exchange = Exchange(
            prompt=question.prompt,
            text=text,
            images=images,
            marks=dict(question.marks),
            key=self._client.key(message) if asked is None else asked.key,
            answer=None if reply is None else reply.text,
            status="ok" if error is None else error.status,
            message="" if error is None else str(error),
            model=None if reply is None else reply.model,
            seconds=seconds if asked is None else asked.seconds,
            tokens=None if reply is None else reply.tokens,
            cost=None if asked is None else asked.cost,
            points=answer if isinstance(answer, dict) else {},
            replayed=replayed,
        )
        self.exchanges += (exchange,)
        if (heard := _heard.get()) is not None:
            heard.append(exchange)


def _read(reply: Reply, profile: Profile, expects: Options | Points) -> Answer:
    """Returns the answer in a reply. One that was cut off is not read: a 1 may be half of a 12."""
    if reply.finish == "refusal":
        said = (reply.refusal or reply.text)[:_EXCERPT]
        raise Unanswered("refused", f"the model refused: {said}" if said else "the model refused")
    if reply.finish == "length":
        raise Unanswered("truncated", "the model ran out of tokens before it had answered")
    return answers.read(reply.text, profile, expects)


def _shown(parts: tuple[str | Image, ...]) -> tuple[str, tuple[Image, ...]]:
    """The text of a message with "[image 1]" and so on in it, and its images."""
    images: list[Image] = []
    texts: list[str] = []
    for part in parts:
        if isinstance(part, str):
            texts.append(part)
        else:
            images.append(part)
            texts.append(f"[image {len(images)}]")
    return "\n\n".join(texts), tuple(images)
