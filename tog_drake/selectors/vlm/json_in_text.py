"""JSON in what a model said: alone, in a fence, or between other words, and not quite JSON.

The text is anybody's: everything here takes time in proportion to its length, and nothing recurses
deeper than ``MAX_DEPTH``.
"""

import ast
import json
import re
import warnings
from typing import Any

MAX_DEPTH = 32  # brackets in brackets; an answer needs 4
MAX_VALUES = 32  # of the last values in a text that are looked at
MAX_PYTHON = 4_000  # characters of what is read as Python where it is no JSON

_OPENS = {"]": "[", "}": "{"}
_INTERESTING = re.compile(r'[\[\]{}"\\\n]')
_FENCE = re.compile(r"^[ \t]{0,3}```[a-zA-Z0-9]{0,10}[ \t]{0,9}$", re.MULTILINE)
_BETWEEN = re.compile(r"[\s,;]*")


def find_values(text: str) -> list[Any]:
    """Returns the lists and objects in ``text``, the last first.

    Where there are fenced blocks with such values, only the values of the last such block count.
    Values that follow each other with nothing but commas between them are one list.
    """
    fences = list(_FENCE.finditer(text))
    for start, end in zip(fences[-2::-1], fences[:0:-1], strict=True):
        values = _values(text[start.end() : end.start()])
        if values:
            return values
    return _values(text)


def is_cut_off(text: str) -> bool:
    """Whether ``text``, or the fenced block that it ends with, begins as JSON but does not end."""
    fences = list(_FENCE.finditer(text))
    body = text[fences[-1].end() :] if len(fences) % 2 else text
    body = body.lstrip()
    return body.startswith(("{", "[")) and not any(start == 0 for start, _ in _spans(body))


def _values(text: str) -> list[Any]:
    spans = _spans(text)[-MAX_VALUES:]
    runs: list[list[Any]] = []
    previous_end = None
    for start, end in spans:
        value = _load(text[start:end])
        if value is None:
            previous_end = None
            continue
        if previous_end is not None and _BETWEEN.fullmatch(text, previous_end, start):
            runs[-1].append(value)
        else:
            runs.append([value])
        previous_end = end
    return [run[0] if len(run) == 1 else run for run in reversed(runs)]


def _spans(text: str) -> list[tuple[int, int]]:
    """Returns where the outermost balanced brackets begin and end, in order.

    A bracket that is never closed does not hide what comes after it. Brackets in strings do not
    count; a string ends with its line, so that one quotation mark in prose hides no more than that.
    """
    open_at: list[tuple[str, int, int]] = []  # bracket, place, how deep anything in it goes
    spans: list[tuple[int, int]] = []
    in_string = False
    skip = -1
    for match in _INTERESTING.finditer(text):
        mark, place = match.group(), match.start()
        if place == skip:
            continue
        if in_string:
            if mark == "\\":
                skip = place + 1
            in_string = mark not in '"\n'
        elif mark == '"':
            in_string = bool(open_at)
        elif mark in "[{":
            open_at.append((mark, place, 1))
        elif mark in _OPENS:
            if not open_at or open_at[-1][0] != _OPENS[mark]:
                open_at.clear()
                continue
            _, start, depth = open_at.pop()
            if open_at:
                outer, outer_start, outer_depth = open_at[-1]
                open_at[-1] = (outer, outer_start, max(outer_depth, depth + 1))
            while spans and spans[-1][0] > start:
                spans.pop()
            if depth <= MAX_DEPTH:
                spans.append((start, place + 1))
    return spans


def _load(text: str) -> Any:
    """Returns the value that ``text`` writes as JSON, nearly JSON or Python; None for nothing."""
    for candidate in (text, re.sub(r",(\s*[\]}])", r"\1", text)):
        try:
            return json.loads(candidate, parse_constant=_refuse_constant)
        except (ValueError, RecursionError):
            pass
    if len(text) > MAX_PYTHON:
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the model's backslashes
            value = ast.literal_eval(text)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None
    return value if isinstance(value, (dict, list)) else None


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON")
