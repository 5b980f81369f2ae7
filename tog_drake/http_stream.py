"""A GET whose answer comes piece by piece, from a server that may be slow, gone or misleading."""

import queue
import threading
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any
from urllib.parse import urljoin, urlsplit

from tog_drake.errors import InputError
from tog_drake.urls import host_of, is_loopback
from tog_drake.visible_text import quoted

if TYPE_CHECKING:
    from requests import Response

CONNECT = 10.0  # [s] until there is a connection
PATIENCE = 30.0  # [s] for the headers, then for each CHUNK: 2 kB/s at least
CHUNK = 65_536  # [bytes]
REDIRECTS = 5

Arriving = Generator[Any, None, None]  # the response when its headers are there, then its bytes


class Unreachable(InputError):
    """There is no connection to ``host``: nothing else need be tried there."""

    def __init__(self, url: str, why: str):
        super().__init__(f"there is no connection for {url} ({why})")
        self.host = host_of(url)


class Again(Exception):
    """A failure that may pass: what to raise at the last attempt, and how long to wait [s]."""

    def __init__(self, failure: InputError, delay: float | None = None):
        super().__init__(str(failure))
        self.failure = failure
        self.delay = delay


def ask(url: str, headers: dict[str, str]) -> "tuple[Response, Arriving]":
    """Asks, there also where it is redirected to; returns the answer, and its bytes to come.

    The bytes are as sent: nothing is decoded. Close what they come from when it is left early.

    Raises:
        Again: there is no connection, it is too slow, or it is cut; the bytes raise it, too.
        InputError: the URL is none, or the server redirects to where nobody should follow.
    """
    for _ in range(REDIRECTS + 1):
        arriving = _arriving(url, headers)
        response = next(arriving)
        if response.status_code not in (301, 302, 303, 307, 308):
            return response, arriving
        arriving.close()
        url = _redirected(url, response.headers.get("Location", ""))
    raise InputError(f"{host_of(url)} redirects more than {REDIRECTS} times")


def _redirected(url: str, location: str) -> str:
    """Returns where to go; raises InputError unless that is https, or the same on this machine."""
    try:
        there = urljoin(url, location)
        target = urlsplit(there)
        local = is_loopback(url) and (target.scheme, target.hostname) == ("http", _name(url))
        if target.hostname and (target.scheme == "https" or local):
            return there
    except ValueError:
        pass
    raise InputError(f"{host_of(url)} redirects to {quoted(location)}; only https is followed")


def _name(url: str) -> str | None:
    return urlsplit(url).hostname


def _arriving(url: str, headers: dict[str, str]) -> Arriving:
    """Yields the response, then its bytes.

    They are waited for in a thread, which is left behind when patience ends: a server that sends a
    byte now and then never lets a socket time out.
    """
    arrived: queue.Queue[Any] = queue.Queue(maxsize=16)
    left = threading.Event()

    def give(item: Any) -> bool:
        while not left.is_set():
            try:
                arrived.put(item, timeout=0.2)
                return True
            except queue.Full:
                continue
        return False

    threading.Thread(
        target=_receive, args=(url, headers, give), name="tog-download", daemon=True
    ).start()
    begun = False
    try:
        while (item := arrived.get(timeout=PATIENCE)) is not None:
            if isinstance(item, Exception):
                raise _meant(item, url, begun) from None
            yield item
            begun = True
    except queue.Empty:
        raise Again(InputError(f"{host_of(url)} is too slow: {url}")) from None
    finally:
        left.set()


def _receive(url: str, headers: dict[str, str], give: Callable[[Any], bool]) -> None:
    """In the thread: gives the response, its bytes and None, or what went wrong."""
    import requests

    try:
        with requests.Session() as session:
            session.trust_env = not is_loopback(url)  # no proxy on the way to this machine
            # Or it reads the whole body of a redirect, however long that is.
            session.get_redirect_target = lambda resp: None  # type: ignore[method-assign]
            with session.get(
                url,
                headers=headers,
                timeout=(CONNECT, 2 * PATIENCE),  # ends the thread; who waits has long gone
                allow_redirects=False,
                stream=True,
            ) as response:
                give(response)
                for chunk in response.raw.stream(CHUNK, decode_content=False):
                    if not give(chunk):
                        return
        give(None)
    except Exception as error:  # of requests, or of what it stands on and does not always wrap
        give(error)


def _meant(error: Exception, url: str, begun: bool) -> Exception:
    kind = type(error).__name__
    if begun:
        return Again(
            InputError(
                f"{url}: the connection was cut before the end ({kind}). What has arrived is kept: "
                "the same command later goes on from there"
            )
        )
    if isinstance(error, ValueError):  # requests' own for a bad URL among them
        return InputError(f"{quoted(url)} cannot be asked for ({kind})")
    return Again(Unreachable(url, kind))
