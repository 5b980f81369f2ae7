"""What the APIs have in common: looking into JSON that anybody may have written, and sparing what
a server does not take."""

import re
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

_NOT_TAKEN = re.compile(
    r"(not|n't|only)( \w+)? (support|permitted|allowed|available|enabled|compatible|implemented)"
    r"|unsupported|unavailable|unknown|unrecogni[sz]ed|unexpected|deprecated|cannot find|invalid",
    re.IGNORECASE,
)
"""How servers say that they do not take a parameter, rather than that something else is wrong."""

MOST_TOKENS = 10**9  # a count from there on is nonsense

Path = tuple[str, ...]


def at(value: Any, *path: str | int) -> Any:
    """Returns what lies there in parsed JSON, None where nothing does."""
    for step in path:
        if isinstance(value, dict) and isinstance(step, str):
            value = value.get(step)
        elif isinstance(value, list) and isinstance(step, int):
            value = value[step] if 0 <= step < len(value) else None
        else:
            return None
    return value


def text_at(value: Any, *path: str | int) -> str:
    """The same where only text makes sense; "" for anything else."""
    found = at(value, *path)
    return found if isinstance(found, str) else ""


def short_at(value: Any, *path: str | int) -> str:
    """The same for a name or a reason: no more than 500 characters of it."""
    return text_at(value, *path)[:500]


def count_at(value: Any, *path: str | int) -> int | None:
    """The same where only a number of tokens makes sense; None for anything else."""
    found = at(value, *path)
    return found if type(found) is int and 0 <= found < MOST_TOKENS else None


def token_counts(
    input_tokens: int | None, output_tokens: int | None, reasoning: int | None
) -> dict[str, int] | None:
    """Returns the counts that are known, by name; ``output`` holds the reasoning too."""
    counts = {"input": input_tokens, "output": output_tokens, "reasoning": reasoning}
    known = {name: count for name, count in counts.items() if count is not None}
    return known or None


def spare(
    body: Mapping[str, Any], complaint: str, optional: Mapping[str, tuple[Path, ...]]
) -> tuple[dict[str, Any], str] | None:
    """Leaves out what a server does not take, if it names something that can be spared.

    Args:
        body: a request that was answered with status 400.
        complaint: what the server said.
        optional: by what it is called in a complaint (a regular expression), where that lies.

    Returns:
        The request without it, and its name; None where the complaint is about something else.
    """
    if not _NOT_TAKEN.search(complaint):
        return None
    named = []
    for called, paths in optional.items():
        match = re.search(called, complaint, re.IGNORECASE)
        if match and any(at(body, *path) is not None for path in paths):
            named.append((match.start(), paths))
    if not named:
        return None
    _, paths = min(named)  # the first; later ones are what the server would take instead
    amended: dict[str, Any] = deepcopy(dict(body))
    for path in paths:
        _remove(amended, path)
    return amended, ".".join(paths[0])


def _remove(body: dict[str, Any], path: Path) -> None:
    """Removes what lies at ``path``, and what is left empty around it."""
    *above, last = path
    holder = at(body, *above)
    if isinstance(holder, dict):
        holder.pop(last, None)
        if above and not holder:
            _remove(body, tuple(above))
