"""Keys live in the environment and nowhere else: they are taken out of whatever comes back."""

import os
import re
from typing import Any

_SECRET = re.compile(r"KEY|TOKEN|SECRET|PASSWORD|CREDENTIAL", re.IGNORECASE)
_SHORTEST = 8  # [character] a shorter value could be an ordinary word


def without_secrets(value: Any) -> Any:
    """Returns a JSON value or text in which nothing holds a secret of this process's environment.

    A secret is the value of a variable whose name speaks of a key, token, secret, password or
    credential. A server may send back what it was sent.
    """
    secrets = [
        content
        for name, content in os.environ.items()
        if _SECRET.search(name) and len(content) >= _SHORTEST
    ]
    return _cleaned(value, sorted(secrets, key=len, reverse=True))


def _cleaned(value: Any, secrets: list[str]) -> Any:
    if isinstance(value, str):
        for secret in secrets:
            value = value.replace(secret, "[removed]")
        return value
    if isinstance(value, dict):
        return {_cleaned(k, secrets): _cleaned(v, secrets) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_cleaned(item, secrets) for item in value]
    return value
