"""What a URL says of the server behind it."""

import re
from ipaddress import ip_address
from urllib.parse import urlsplit

from tog_drake.visible_text import quoted

# No user, password or query, and nothing that two readers of URLs could take for two hosts.
_URL = re.compile(r"https?://([\w.-]+|\[[0-9a-fA-F:.]+\])(:[0-9]{1,5})?(/[\w.~%:+/-]*)?", re.ASCII)


def is_plain_url(text: str) -> bool:
    """Whether it is an URL of scheme, host and path alone: without user, password or query."""
    return _URL.fullmatch(text) is not None


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
