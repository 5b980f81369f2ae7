"""API keys: taken from the environment, sent to whom they belong, shown nowhere.

A provider's own key goes to that provider and to servers on this machine. Every other server gets
the key in ``VLM_API_KEY``, or in another variable that is named for it: a scenario from somebody
else cannot send a provider's key elsewhere.
"""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from urllib.parse import urlsplit

from tog_drake.errors import InputError
from tog_drake.urls import is_loopback, is_private

_VARIABLE = re.compile(r"[A-Z][A-Z0-9_]*_API_KEY")
_PUBLIC_HEADERS = frozenset({"accept", "accept-encoding", "anthropic-version", "content-type"})
_SHORTEST = 8  # characters; a shorter "key" is a placeholder such as "EMPTY", which is no secret
HIDDEN = "[key]"
ELSEWHERE = "VLM_API_KEY"  # of a server that is no provider's own
_OWNERS = {  # variable of a provider's key -> the host that it is sent to
    "OPENAI_API_KEY": "api.openai.com",
    "GOOGLE_API_KEY": "generativelanguage.googleapis.com",
    "GEMINI_API_KEY": "generativelanguage.googleapis.com",
    "ANTHROPIC_API_KEY": "api.anthropic.com",
}


class NoKey(InputError):
    """A server wants a key, and the environment has none for it."""


def key_variables(named: str | None, own: Sequence[str], url: str) -> tuple[str, ...]:
    """Returns the environment variables in which the key for ``url`` is looked for, in order.

    Args:
        named: the variable that the user wants; None: the usual ones.
        own: variables of the provider whose protocol is spoken.
        url: of the server.

    Raises:
        InputError: the variable that is named holds the key of another host.
    """
    host = urlsplit(url).hostname
    local = is_loopback(url)
    if named is None:
        return tuple(own) if local or host in {_OWNERS[v] for v in own} else (ELSEWHERE,)
    owner = _OWNERS.get(named, host)
    if owner != host and not local:
        raise InputError(
            f"key_variable {named}: its key belongs to {owner} and is not sent to {host}; valid: "
            f"another variable that ends in _API_KEY, or none for {ELSEWHERE}"
        )
    return (named,)


def read_key(variable: str, url: str) -> str | None:
    """Returns the key in the environment variable, or None where there is none to be sent.

    None also where ``url`` is neither https nor on this machine: others could read the key.

    Raises:
        InputError: the variable's name or what it holds cannot be that of a key.
    """
    if not _VARIABLE.fullmatch(variable):
        raise InputError(
            f"key_variable {variable!r} is no name of a key; valid: one that ends in _API_KEY"
        )
    key = os.environ.get(variable, "").strip()
    if not key.isascii() or not key.isprintable() or " " in key:
        raise InputError(f"what {variable} holds cannot be a key: it has blanks or odd characters")
    return key if key and is_private(url) else None


def require_key(variables: Iterable[str], url: str) -> str:
    """Returns the first key there is among the variables; raises NoKey where none is.

    Raises InputError where others could read it on its way to ``url``.
    """
    variables = tuple(variables)
    for variable in variables:
        if key := read_key(variable, url):
            return key
    if not is_private(url):
        raise InputError(f"a key is not sent to {url}; valid: https, or a server on this machine")
    raise NoKey(f"no key: set the environment variable {' or '.join(variables)}")


def secrets_in(headers: Mapping[str, str]) -> list[str]:
    """Returns the values of the headers that are not public, without their scheme (Bearer)."""
    values = (v for k, v in headers.items() if k.lower() not in _PUBLIC_HEADERS)
    return [word for value in values for word in value.split() if len(word) >= _SHORTEST]


def redact(text: str, secrets: Iterable[str]) -> str:
    """Returns the text with ``[key]`` for every stretch of a secret of 8 characters or more."""
    stretches = {
        secret[i : i + _SHORTEST].lower()
        for secret in secrets
        for i in range(len(secret) - _SHORTEST + 1)
    }
    lower = text.lower()
    hidden: list[tuple[int, int]] = []
    for stretch in stretches:
        start = lower.find(stretch)
        while start >= 0:
            hidden.append((start, start + _SHORTEST))
            start = lower.find(stretch, start + 1)
    if not hidden:
        return text
    shown: list[str] = []
    end = 0
    for first, last in sorted(hidden):
        if first > end or not shown:
            shown += [text[end:first], HIDDEN]
        end = max(end, last)
    return "".join([*shown, text[end:]])
