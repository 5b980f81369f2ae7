"""A server that proposes grasps to whoever asks it as ``propose_protocol`` says.

POST /propose asks; GET /healthz tells which proposer answers. One proposal is made at a time; who
comes in the meantime waits. It is for this machine, or for a network whose users are trusted: it
asks for no key and speaks plain HTTP.
"""

import json
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tog_drake.errors import TogError
from tog_drake.proposers.answered import Answerer, passed_on
from tog_drake.proposers.propose_protocol import (
    SCHEMA,
    BadRequest,
    Request,
    answer_body,
    read_answer,
    read_request,
)
from tog_drake.values import Grasps

MAX_REQUEST = 100_000_000  # [bytes]; a view of 1920 × 1080 with its cloud has about 20 million
MAX_CLIENTS = 16  # at a time; more are turned away
READING = 60.0  # [s] for a request to arrive, headers and body
SILENCE = 10.0  # [s] without a byte of it
WAITING = 300.0  # [s] until it is one's turn

Propose = Callable[[Request], Grasps]


class ProposerServer(ThreadingHTTPServer):
    """Answers requests until it is shut down.

    Args:
        address: host and port; of port 0 the system picks a free one, see ``server_port``.
        answerer: who proposes, as answers and /healthz tell it.
        propose: makes the grasps; it is not called by two threads at a time.
        say: takes a line about each request.

    Raises:
        OSError: the address cannot be listened on.
    """

    daemon_threads = True
    request_queue_size = MAX_CLIENTS

    def __init__(
        self,
        address: tuple[str, int],
        answerer: Answerer,
        propose: Propose,
        say: Callable[[str], None],
    ):
        self.answerer, self.say = answerer, say
        self._propose = propose
        self._turn = threading.Lock()
        self.parsing = threading.Lock()  # JSON takes several times the memory of its bytes
        self._places = threading.BoundedSemaphore(MAX_CLIENTS)
        super().__init__(address, _Handler)

    def propose(self, request: Request) -> Grasps:
        """Returns the grasps, when it is the request's turn; raises TimeoutError if it never is."""
        if not self._turn.acquire(timeout=WAITING):
            raise TimeoutError
        try:
            return self._propose(request)
        finally:
            self._turn.release()

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no error of the server."""


class _Refused(Exception):
    """A request that is not answered with grasps."""

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status = status


class _Handler(BaseHTTPRequestHandler):
    server: ProposerServer
    timeout = SILENCE

    def setup(self) -> None:
        super().setup()
        # A client that sends a byte now and then would never let the socket time out.
        self._arriving = threading.Timer(READING, self._stop_reading)
        self._arriving.daemon = True
        self._arriving.start()

    def finish(self) -> None:
        self._arriving.cancel()
        super().finish()

    def _stop_reading(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RD)

    def log_message(self, format: str, *args: Any) -> None:
        """The server says what there is to say."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What the base class refuses, such as another method, is told as JSON, too."""
        self._send(code, _error(message or self.responses.get(code, ("",))[0]))

    def do_GET(self) -> None:
        if self.path == "/healthz":
            self._send(
                200, {"status": "ok", "schema": SCHEMA, "proposer": self.server.answerer.name}
            )
        else:
            self._send(404, _error("there is nothing here; valid: GET /healthz, POST /propose"))

    def do_POST(self) -> None:
        start = time.monotonic()
        try:
            request = self._request()
            body = self._answer(request)
            said = f"{len(body['scores'])} grasps on {request.cloud.size()} points"
            status = 200
        except _Refused as refused:
            status, body, said = refused.status, _error(str(refused)), str(refused)
        self._send(status, body)
        self.server.say(f"{status}: {said}, {time.monotonic() - start:.2f} s")

    def _request(self) -> Request:
        data = self._body()  # first, or who is refused might still be sending and not hear why
        if self.path != "/propose":
            raise _Refused(404, "there is nothing here; valid: POST /propose, GET /healthz")
        if self.headers.get_content_type() != "application/json":
            # A page in a browser on this machine can send other types without being asked.
            raise _Refused(415, "Content-Type must be application/json")
        try:
            with self.server.parsing:
                return read_request(json.loads(data))
        except BadRequest as error:
            raise _Refused(400, str(error)) from None
        except (ValueError, RecursionError):
            raise _Refused(400, f"the body is no JSON; valid: a request of {SCHEMA}") from None

    def _body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise _Refused(411, "Content-Length must say how many bytes there are")
        if len(length) > 12 or int(length) > MAX_REQUEST:
            raise _Refused(413, f"the body has {length:.20} bytes; valid: at most {MAX_REQUEST}")
        try:
            received = self.rfile.read(int(length))
        except TimeoutError:
            received = b""
        if len(received) < int(length):
            raise _Refused(408, f"the {length} bytes of the body did not arrive in time")
        self._arriving.cancel()
        return received

    def _answer(self, request: Request) -> dict[str, Any]:
        try:
            grasps = self.server.propose(request)
            body = answer_body(grasps, passed_on(self.server.answerer, grasps))
            read_answer(body)  # hears what the client would
            return body
        except TimeoutError:
            raise _Refused(503, "too many requests are waiting; ask again later") from None
        except TogError as error:
            raise _Refused(422, str(error)) from error
        except Exception as error:
            raise _Refused(500, f"the proposer failed: {type(error).__name__}: {error}") from error

    def _send(self, status: int, body: dict[str, Any]) -> None:
        data = json.dumps(body, allow_nan=False).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def _error(message: str) -> dict[str, Any]:
    return {"error": {"message": message}}
