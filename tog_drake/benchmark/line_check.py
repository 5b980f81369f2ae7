"""Whether what a run's folder holds is what the tables and the page take it for.

Each shape below names the fields that are read somewhere; what else there is does not matter, so
that a run of an older version is read as long as it has them.
"""

import reprlib
from dataclasses import dataclass
from types import NoneType
from typing import Any, get_args

MAX_INT = 2**63  # beyond it a number is of no table, and as a float perhaps none


_WORDS = {
    str: "text",
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    NoneType: "null",
    dict: "an object",
    list: "a list",
}


@dataclass(frozen=True)
class Each:
    """An object of any names, or a list of any length, all of whose values are of one shape."""

    kind: type
    value: Any


@dataclass(frozen=True)
class Maybe:
    """Null, or of a shape."""

    value: Any


@dataclass(frozen=True)
class Later:
    """Not there in a run of an older version."""

    value: Any


_SHARES = Each(dict, float)  # part, or pair of bodies -> number
_EXCHANGE = {
    "prompt": str,
    "text": str,
    "marks": Each(dict, int),
    "points": Each(dict, (float, float)),
    "answer": str | None,
    "status": str,
    "message": str,
    "seconds": float,
    "tokens": Maybe(Each(dict, int)),
    "cost": float | None,
    "replayed": str | None,
}
_CELL = {
    "name": str,
    "number": int,
    "tasks": int,
    "method": str,
    "proposer": str | None,
    "k": str | None,
    "selector": str,
    "strategy": str | None,
    "vlm": str | None,
    "view": Later(str | None),
    "scenario": str,
    "object": str,
    "seed": int,
    "task": str,
    "category": str,
    "beyond": str | None,
}
_RECORD = {
    "proposer": {"kind": str},
    "counts": {"proposed": int | None, "candidates": int | None},
    "rejected": Each(dict, int),
    "view_selection": Later(Maybe({"camera": str, "candidates_visible": Each(dict, int)})),
    "choice": Maybe({"index": int, "planned_index": int | None, "part": str | None, "reason": str}),
    "vlm": Maybe({"status": str | None, "fallback": str | None}),
    "attempts": Each(list, {"exchanges": Each(list, _EXCHANGE)}),
    "outcome": str,
    "message": str | None,
    "grasp_success": bool | None,
    "task_compliance": bool | None,
    "combined_success": bool | None,
    "strict_success": bool | None,
    "held": _SHARES,
    "collisions": Maybe(_SHARES),
    "closes_on": Maybe(_SHARES),
    "chosen_closes_on": Later(Maybe(_SHARES)),
    "allowed": Maybe(Each(list, str)),
    "motion": Maybe({"note": str}),
    "seconds": Each(dict, float | None),
}
_JUDGE = {
    "model": str,
    "complies": bool | None,
    "status": str,
    "cost": float | None,
    "seconds": float,
}
LINE = {"cell": _CELL, "record": _RECORD, "judge": Maybe(_JUDGE)}
"""Of a line of ``episodes.jsonl``."""
CONFIG = {
    "schema": str,
    "suite": str,
    "command": Later(Each(list, str)),
    "methods": Later(Each(list, str)),
    "seeds": Later(int),
    "noise": Later(bool),
    "scenario_text": Later(str | None),
    "judge": Later(str | None),
    "asked": Later(Maybe(Each(dict, str | int | float | bool | None))),
    "program": Later(str),
    "files": Later(Each(dict, str)),
    "scenarios": Later(Each(dict, str)),
    "objects": Later(Each(dict, str)),
}
"""Of ``run.json``."""


def misfit(value: Any, shape: Any, name: str) -> str | None:
    """Returns what of a value is not of a shape, such as "record.held is 3"; None: all is.

    Args:
        value: as JSON reads it.
        shape: a type or a union of them; a mapping of fields; a tuple of so many shapes; or one of
            the classes above.
        name: of the value, for the message.
    """
    if isinstance(shape, Maybe):
        return None if value is None else misfit(value, shape.value, name)
    if isinstance(shape, Later):
        return misfit(value, shape.value, name)
    if isinstance(shape, Each | dict | tuple):
        return _misfit_within(value, shape, name)
    kinds = get_args(shape) or (shape,)
    if type(value) not in kinds and not (type(value) is int and float in kinds):
        return (
            f"{name} is {reprlib.repr(value)}; valid: {' or '.join(_WORDS[kind] for kind in kinds)}"
        )
    if type(value) is int and abs(value) >= MAX_INT:
        return f"{name} is a number of {len(str(abs(value)))} digits"
    if type(value) is str and not _is_text(value):
        return f"{name} holds half a character"
    return None


def _misfit_within(value: Any, shape: Any, name: str) -> str | None:
    """The same of what has parts: says what of the first that does not fit."""
    kind: Any = shape.kind if isinstance(shape, Each) else list
    if isinstance(shape, dict):
        kind = dict
    if not isinstance(value, kind):
        return f"{name} is {reprlib.repr(value)}; valid: {_WORDS[kind]}"
    if isinstance(shape, dict):
        wanted = {field: of for field, of in shape.items() if field in value}
        missing = [f for f, of in shape.items() if f not in value and not isinstance(of, Later)]
        if missing:
            return f"{name} lacks {missing[0]}"
        parts = [(f"{name}.{field}", value[field], of) for field, of in wanted.items()]
    elif isinstance(shape, tuple):
        if len(value) != len(shape):
            return f"{name} has {len(value)} entries; valid: {len(shape)}"
        parts = [(f"{name}[{i}]", value[i], of) for i, of in enumerate(shape)]
    else:
        items = value.items() if isinstance(value, dict) else enumerate(value)
        parts = [(f"{name}[{reprlib.repr(key)}]", part, shape.value) for key, part in items]
        if isinstance(value, dict) and not all(map(_is_text, value)):
            return f"a name in {name} holds half a character"
    return next(filter(None, (misfit(part, of, where) for where, part, of in parts)), None)


def _is_text(text: str) -> bool:
    """Whether it can be written; JSON may hold half of a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True
