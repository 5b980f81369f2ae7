"""One POST to a server that may be slow, broken, overloaded or hostile.

Whatever the server does, the caller gets JSON or ``Unanswered`` before the deadline: the exchange
runs in a thread that is left behind when time is up, since a server that sends a byte now and then
never lets a socket time out.
"""

import json
import queue
import re
import threading
import time
from collections.abc import Mapping
from email.utils import parsedate_to_datetime
from math import isfinite
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.bodies import at, text_at
from tog_drake.selectors.vlm.keys import redact, secrets_in
from tog_drake.urls import host_of, is_loopback
from tog_drake.visible_text import quoted

if TYPE_CHECKING:
    from requests import Response

CONNECT = 10.0  # [s] until there is a connection
SILENCE = 300.0  # [s] without a byte; a local model may take minutes to its first
MAX_BYTES = 4 * 2**20  # of a response; a long answer has some 10 kB
ATTEMPTS = 4
# The delays of the openai and anthropic clients, without their jitter: one robot is no herd.
FIRST_DELAY = 0.5  # [s] doubled each time
LONGEST_DELAY = 8.0  # [s] unless the server asks for more
RETRYABLE = frozenset({408, 409, 429, 500, 502, 503, 504, 529})


class Rejected(Unanswered):
    """The server does not take the request: ``code`` is its HTTP status, ``complaint`` why."""

    def __init__(self, message: str, code: int, complaint: str = ""):
        super().__init__("rejected", message)
        self.code = code
        self.complaint = complaint


class _Again(Exception):
    """A failure that may pass: what to raise at the last attempt, when the server said to retry."""

    def __init__(self, failure: Unanswered, delay: float | None = None, code: int | None = None):
        super().__init__()
        self.failure = failure
        self.delay = delay  # [s]
        self.code = code  # HTTP status; None: the connection failed


def post(
    url: str,
    headers: Mapping[str, str],
    body: Mapping[str, Any],
    *,
    deadline: float,
    attempts: int = ATTEMPTS,
    retryable: frozenset[int] = RETRYABLE,
    hints: Mapping[int, str] | None = None,
) -> Any:
    """Sends JSON and returns the JSON of the answer, asking again where that may help.

    Args:
        url: is not followed elsewhere: a redirect is an error.
        headers: those with the key among them; Content-Type is added.
        body: of the request.
        deadline: of everything together, on the clock of ``time.monotonic`` [s].
        attempts: at most, the first included.
        retryable: HTTP statuses after which it is asked again; as after a failed connection.
        hints: what may help, by HTTP status; by default what helps with a language model.

    Raises:
        Rejected: the server does not take the request.
        Unanswered: timed_out, unreachable or too_long. No message holds any part of a
            key, even where the server repeats it.
    """
    data = json.dumps(body).encode()
    attempt = 0
    while True:
        try:
            return _within(deadline, url, headers, data)
        except _Again as again:
            delay, failure, code = again.delay, again.failure, again.code
        except Rejected as rejected:
            hint = _hint(rejected.code, url) if hints is None else hints.get(rejected.code, "")
            raise Rejected(f"{rejected}{hint}", rejected.code, rejected.complaint) from None
        attempt += 1
        if attempt == attempts or (code is not None and code not in retryable):
            raise failure
        asked_to_wait = delay is not None
        if delay is None:
            delay = min(FIRST_DELAY * 2 ** (attempt - 1), LONGEST_DELAY)
        left = deadline - time.monotonic()
        if delay >= left:
            raise Unanswered(
                "timed_out" if asked_to_wait or left <= 0.0 else failure.status,
                f"{failure}; the next attempt would be in {delay:.3g} s, and {left:.3g} s are left",
            )
        time.sleep(delay)


def _within(deadline: float, url: str, headers: Mapping[str, str], data: bytes) -> Any:
    """One attempt, in a thread; raises Unanswered where it is not over in time."""
    outcome: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def work() -> None:
        try:
            outcome.put((_attempt(deadline, url, headers, data), None))
        except Exception as error:
            outcome.put((None, error))

    left = deadline - time.monotonic()
    try:
        if left <= 0.0:
            raise queue.Empty
        threading.Thread(target=work, name="tog-request", daemon=True).start()
        answer, error = outcome.get(timeout=left)
    except queue.Empty:
        raise Unanswered("timed_out", f"no answer of {host_of(url)} within the deadline") from None
    if error is not None:
        raise error from None
    return answer


def _attempt(deadline: float, url: str, headers: Mapping[str, str], data: bytes) -> Any:
    import requests

    # A second more than is left: it is the caller who says that time is up, not the socket.
    left = max(deadline - time.monotonic(), 0.0) + 1.0
    sent = {**headers, "Content-Type": "application/json", "Accept-Encoding": "identity"}
    # What requests says of an error may hold headers and so keys; its kind says enough.
    try:
        with requests.Session() as session:
            session.trust_env = not is_loopback(url)  # no proxy on the way to this machine
            session.auth = _keep  # or requests puts what a .netrc says in place of the key
            with session.post(
                url,
                data=data,
                headers=sent,
                timeout=(min(CONNECT, left), min(SILENCE, left)),
                allow_redirects=False,
                stream=True,
            ) as response:
                text = _text_of(response, deadline)
    except requests.exceptions.SSLError as error:
        what = f"{host_of(url)} does not speak https; is it http://?"
        if "CERTIFICATE" in str(error).upper():
            what = f"the certificate of {host_of(url)} is not valid"
        raise Unanswered("unreachable", what) from None
    except ValueError as error:  # errors of requests among them
        message = f"{host_of(url)} cannot be asked ({type(error).__name__}); is its URL right?"
        raise Unanswered("rejected", message) from None
    except (Unanswered, _Again):
        raise
    except Exception as error:  # of requests, or of what it stands on and does not always wrap
        message = f"no connection to {host_of(url)} ({type(error).__name__}); is it running?"
        raise _Again(Unanswered("unreachable", message)) from None
    return _judge(response, text, url, secrets_in(headers))


def _keep(request: Any) -> Any:
    return request


def _text_of(response: "Response", deadline: float) -> str:
    """Reads the response as it comes in, no more of it than ``MAX_BYTES``."""
    from requests import RequestException

    received = bytearray()
    try:
        for chunk in response.iter_content(8192):
            received += chunk
            if len(received) > MAX_BYTES:
                raise Unanswered("too_long", f"the answer is longer than {MAX_BYTES} bytes")
            if time.monotonic() > deadline:
                raise Unanswered("timed_out", "the answer is not complete at the deadline")
    except RequestException as error:
        message = f"the connection was cut in the answer ({type(error).__name__})"
        raise _Again(Unanswered("unreachable", message)) from None
    return received.decode("utf-8", errors="replace")


def _judge(response: "Response", text: str, url: str, secrets: list[str]) -> Any:
    """Returns the JSON of a good response; raises what the others mean."""
    code = response.status_code
    if 300 <= code < 400:
        there = _quoted(response.headers.get("Location", "nowhere"), secrets)
        message = f"{host_of(url)} redirects (status {code}) to {there}; give the right URL"
        raise Rejected(message, code)
    try:
        parsed = json.loads(text, parse_float=_finite, parse_constant=_finite)
        body = _cleaned(parsed, secrets)
    except (ValueError, RecursionError):
        body = None
    if code == 200:
        if body is None:
            said = _quoted(text, secrets)
            message = (
                f"{host_of(url)} answers with something else than JSON: {said}; is its URL right?"
            )
            raise Unanswered("unreachable", message)
        return body
    complaint = _complaint(body, text)
    message = f"{host_of(url)} answers with status {code}: {_quoted(complaint, secrets)}"
    if code in RETRYABLE and response.headers.get("x-should-retry") != "false":
        raise _Again(Unanswered("unreachable", message), _asked_delay(response, body), code)
    if code >= 500:
        raise Unanswered("unreachable", message)
    raise Rejected(message, code, _quoted(complaint, secrets, 1000))


def _hint(code: int, url: str) -> str:
    if code == 404 and urlsplit(url).path.endswith("/chat/completions"):
        return "; are the URL (most end in /v1) and the model's name right?"
    return _HINTS.get(code, "")


_HINTS = {
    401: "; is the key right, and sent over https?",
    403: "; may the key use this model?",
    404: "; are the URL and the model's name right?",
    413: "; smaller or fewer images may help",
}


def _complaint(body: Any, text: str) -> str:
    """Finds what is wrong in the error of any server; the parameter's name comes first."""
    body = at(body, 0) or body
    error = at(body, "error")
    for where in (error, body):
        message = text_at(where, "message") or (where if isinstance(where, str) else "")
        cause = text_at(where, "metadata", "raw")  # OpenRouter's, of the provider behind it
        if message:
            return ": ".join(filter(None, (text_at(where, "param"), message, cause)))
    return re.sub(r"<[^<>]{0,1000}>", " ", text[:20_000])  # of a page: tags say little


def _asked_delay(response: "Response", body: Any) -> float | None:
    """How long the server wants to be left alone [s]: in a header, or Gemini's RetryInfo."""
    headers = response.headers
    asked = [(headers.get("retry-after-ms", ""), 0.001), (headers.get("retry-after", ""), 1.0)]
    details = at(at(body, 0) or body, "error", "details")
    for detail in details if isinstance(details, list) else []:
        if text_at(detail, "@type").endswith("RetryInfo"):
            asked.append((text_at(detail, "retryDelay").removesuffix("s"), 1.0))
    for value, unit in asked:
        try:
            delay = float(value) * unit
        except ValueError:
            delay = _until(value)
        if isfinite(delay) and delay >= 0.0:
            return delay
    return None


def _finite(text: str) -> float:
    """Reads a number of JSON; NaN and 1e999 could not be written as JSON again."""
    number = float(text)
    if not isfinite(number):
        raise ValueError(f"{text} is no number of JSON")
    return number


def _until(date: str) -> float:
    """Returns the time until an HTTP date [s], NaN where it is none."""
    try:
        return max(parsedate_to_datetime(date).timestamp() - time.time(), 0.0)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _cleaned(value: Any, secrets: list[str], depth: int = 100) -> Any:
    """Returns the JSON without keys and without halves of surrogate pairs, which no file takes.

    Raises ValueError where it is nested more than ``depth`` deep.
    """
    if depth < 0:
        raise ValueError("nested too deeply")
    if isinstance(value, str):
        return redact(value.encode("utf-8", "replace").decode(), secrets)
    if isinstance(value, list):
        return [_cleaned(item, secrets, depth - 1) for item in value]
    if isinstance(value, dict):
        return {_cleaned(k, secrets): _cleaned(v, secrets, depth - 1) for k, v in value.items()}
    return value


def _quoted(text: str, secrets: list[str], limit: int = 200) -> str:
    return quoted(redact(text[: 20 * limit], secrets), limit)
