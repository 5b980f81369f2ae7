"""A server on this machine, while a ``with`` lasts: what those of the tests have in common."""

import threading
from http.server import ThreadingHTTPServer


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def handle_error(self, request, client_address):
        """A client that went away is none."""


class LoopbackServer:
    """Serves with a handler class, which finds this object as ``self.server.owner``.

    ``closing`` is set when the ``with`` ends, so that a handler that hangs can end too. ``port`` 0
    takes any that is free.
    """

    def __init__(self, handler, *, port=0):
        self.closing = threading.Event()
        self._http = _Http(("127.0.0.1", port), handler)
        self._http.owner = self
        self.port = self._http.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._thread = threading.Thread(
            target=self._http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True
        )

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, kind, error, trace):
        self.closing.set()
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()
