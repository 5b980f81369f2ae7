"""What a URL says of the server behind it."""

import os
import re
from ipaddress import ip_address
from urllib.parse import urlsplit

from tog_drake.errors import InputError
from tog_drake.visible_text import quoted

# No user, password or query, and nothing that two readers of URLs could take for two hosts.
_URL = re.compile(r"https?://([\w.-]+|\[[0-9a-fA-F:.]+\])(:[0-9]{1,5})?(/[\w.~%:+/-]*)?", re.ASCII)


def is_plain_url(text: str) -> bool:
    """Whether it is an URL of scheme, host and path alone: without user, password or query."""
    return _URL.fullmatch(text) is not None


def official_or_mirror(official: str, variable: str) -> str:
    """Returns the URL of a folder of files: the official one, or that of the environment.

    Args:
        official: without a slash at its end.
        variable: the environment variable that names a mirror, where it is set.

    Raises:
        InputError: what it names is no URL of a folder.
    """
    given = os.environ.get(variable)
    if not given:
        return official
    try:
        parts = urlsplit(given)
        sound = parts.scheme in ("http", "https") and parts.hostname and not parts.query
    except ValueError:
        sound = False
    if not sound:
        raise InputError(f"{variable} {given!r:.120} is no URL of a folder; valid: {official}")
    return given.rstrip("/")


def host_of(url: str) -> str:
    """Returns host and port, fit for a message."""
    return quoted(urlsplit(url).netloc.rpartition("@")[2]).strip('"')


def is_loopback(url: str) -> bool:
    """Whether the URL's host is this machine."""
    host = urlsplit(url).hostname or ""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def is_private(url: str) -> bool:
    """Whether what is sent there can be read by its server alone: https, or this machine."""
    return urlsplit(url).scheme == "https" or is_loopback(url)
