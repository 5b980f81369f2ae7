"""What a URL says of the server behind it."""

from ipaddress import ip_address
from urllib.parse import urlsplit

from tog_drake.visible_text import quoted


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
