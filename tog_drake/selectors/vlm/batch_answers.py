"""Answers that came from elsewhere, entered in a cassette: in any order, as many as there are.

A line is a result of a batch API, as its provider writes it, or ``{"custom_id", "answer"}`` as
people do.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tog_drake.errors import InputError, Unanswered
from tog_drake.http_post import MAX_BYTES
from tog_drake.selectors.vlm.api import Api
from tog_drake.selectors.vlm.batch import custom_id
from tog_drake.selectors.vlm.bodies import at, text_at
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.recorded import Recorded, Source, read_json
from tog_drake.visible_text import visible

MAX_FILE = 500_000_000  # [byte]
MAX_LINE = 2 * MAX_BYTES  # [byte] what is read of a server, with room for escapes and a frame
BY_HAND = "by hand"  # the model that answered


@dataclass(frozen=True)
class Given:
    """A line of a file of answers."""

    where: str  # file and line
    name: str  # custom_id, or the key of a cassette
    answer: str | None = None  # by hand; "" where it is left empty
    response: Any = None  # body of a response of status 200
    problem: str = ""  # why there is neither


@dataclass
class Imported:
    """What became of the answers in a file: each is counted once."""

    added: int = 0
    replaced: int = 0  # another answer by hand
    known: int = 0  # the same answer was there already
    empty: int = 0  # left empty by hand
    problems: list[str] = field(default_factory=list)  # of the others, each with its line
    answered: int = 0  # questions of the cassette
    pending: int = 0


def read_answers(path: Path) -> list[Given]:
    """Returns the answers in a file, in its order.

    Raises:
        InputError: it cannot be read, is too long, or has a line that is no answer; it is named.
    """
    try:
        with path.open("rb") as file:
            if path.stat().st_size > MAX_FILE:
                raise InputError(f"{path} is longer than {MAX_FILE} bytes, the most for answers")
            return list(_lines(file, path))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from error


def _lines(file: Any, path: Path) -> Iterator[Given]:
    number = 0
    while data := file.readline(MAX_LINE + 1):
        number += 1
        where = f"{path}, line {number}"
        if len(data) > MAX_LINE:
            raise InputError(f"{where} is longer than {MAX_LINE} bytes, the most for one answer")
        if data.strip():
            yield _given(read_json(data, where), where)


def _given(line: Any, where: str) -> Given:
    """Returns what a line says, whichever provider's or person's it is."""
    name = text_at(line, "custom_id") or text_at(line, "key")
    if not name:
        raise InputError(f"{where} names no question: custom_id (or key, from Gemini) is missing")
    if "answer" in line:
        return Given(where, name, answer=_text(line["answer"]))
    if "result" in line:  # Anthropic
        kind = text_at(line, "result", "type")
        if kind == "succeeded":
            return Given(where, name, response=at(line, "result", "message"))
        return Given(where, name, problem=_problem(kind, at(line, "result", "error")))
    if "key" in line and isinstance(line.get("response"), dict):  # Gemini
        return Given(where, name, response=line["response"])
    if at(line, "response", "status_code") == 200 and not line.get("error"):  # OpenAI
        return Given(where, name, response=at(line, "response", "body"))
    if {"response", "error", "status"} & set(line):
        error = line.get("error") or at(line, "response", "body", "error") or line.get("status")
        return Given(where, name, problem=_problem(at(line, "response", "status_code"), error))
    raise InputError(
        f'{where} is no answer; valid: {{"custom_id": ..., "answer": "..."}}, or a line of the '
        "results of OpenAI's, Google's or Anthropic's batches"
    )


def _text(answer: Any) -> str:
    """A person's answer: text, or JSON as it is, which spares the quotation marks in it."""
    if answer is None:
        return ""
    return answer.strip() if isinstance(answer, str) else json.dumps(answer)


def _problem(kind: Any, error: Any) -> str:
    said = text_at(error, "message") or text_at(error, "error", "message") or error or ""
    return visible(" ".join(f"{kind or 'no answer'} {said}".split()), limit=200)


def import_answers(
    cassette: Cassette, answers: Sequence[Given], *, replace_by_hand: bool = False
) -> Imported:
    """Enters answers in the cassette that holds their questions.

    A first answer stays, but for one by hand that another by hand is to replace.
    """
    questions = {custom_id(entry.key): entry for entry in cassette.questions}
    imported = Imported()
    for given in answers:
        name = custom_id(given.name)
        if given.answer == "":
            imported.empty += 1
        elif name not in questions:
            asked = visible(given.name, limit=100)
            imported.problems.append(f"{given.where}: no question {asked} is in {cassette.path}")
        elif given.problem:
            imported.problems.append(f"{given.where}: {given.problem}")
        else:
            _enter(cassette, questions, given, imported, replace_by_hand)
    imported.answered = sum(entry.response is not None for entry in cassette.questions)
    imported.pending = len(cassette.questions) - imported.answered
    return imported


def _enter(
    cassette: Cassette,
    questions: dict[str, Recorded],
    given: Given,
    imported: Imported,
    replace_by_hand: bool,
) -> None:
    """Enters one answer, and counts what became of it."""
    entry = questions[custom_id(given.name)]
    api: Api = entry.config()
    response = given.response if given.answer is None else said_by_hand(api, given.answer)
    try:
        api.read(response)
    except Unanswered as error:
        imported.problems.append(f"{given.where}: {error}")
        return
    source: Source = "batch" if given.answer is None else "hand"
    new = entry.response is None
    by_hand = entry.source == source == "hand" and entry.response != response
    corrected = not new and by_hand and replace_by_hand
    if new or corrected:
        answered = replace(entry, response=response, error=None, source=source, seconds=0.0)
        entry = questions[custom_id(given.name)] = cassette.enter(answered)
    if entry.response != response:
        corrects = "; --replace corrects an answer by hand" if by_hand else ""
        imported.problems.append(
            f"{given.where}: its question has another answer, which stays{corrects}"
        )
    elif corrected:
        imported.replaced += 1
    elif new:
        imported.added += 1
    else:
        imported.known += 1


def said_by_hand(api: Api, answer: str) -> dict[str, Any]:
    """Returns a person's answer as the API of a model would have sent it."""
    match api.provider:
        case "gemini":
            content = {"role": "model", "parts": [{"text": answer}]}
            candidate = {"content": content, "finishReason": "STOP"}
            return {"candidates": [candidate], "modelVersion": BY_HAND}
        case "anthropic":
            block = {"type": "text", "text": answer}
            return {"content": [block], "stop_reason": "end_turn", "model": BY_HAND}
        case _:
            message = {"role": "assistant", "content": answer}
            choice = {"index": 0, "message": message, "finish_reason": "stop"}
            return {"choices": [choice], "model": BY_HAND}
