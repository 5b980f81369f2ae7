"""A server on this machine that hands out files as S3 and Gazebo Fuel do, or misbehaves::

with AssetServer({"/google/thing.tgz": data}) as server:
    server.misbehave(cut(1000), status(503))  # the next two requests
    server.asked  # (path, Range) of each request
"""

import contextlib
import hashlib
import re
from http.server import BaseHTTPRequestHandler

from loopback import LoopbackServer


class AssetServer(LoopbackServer):
    """The server, while the ``with`` lasts.

    Args:
        files: by their path.
        tags: whether answers carry an ETag.
        ranges: whether the rest of a file can be asked for.
    """

    def __init__(self, files, *, tags=True, ranges=True):
        super().__init__(_Handler)
        self.files, self.tags, self.ranges = dict(files), tags, ranges
        self.asked = []
        self._script = iter(())

    def misbehave(self, *mishaps):
        """The next requests meet these, one each (None: a good answer)."""
        self._script = iter(mishaps)

    def next_mishap(self):
        return next(self._script, None)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *arguments):
        pass

    def do_GET(self):
        assets = self.server.owner
        self.close_connection = True
        assets.asked.append((self.path, self.headers.get("Range")))
        mishap = assets.next_mishap()
        with contextlib.suppress(OSError):
            if mishap is not None:
                mishap(self)
            elif self.path not in assets.files:
                self.answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
            else:
                self.good()

    def good(self, first=None, length=None):
        """The file or its rest; of it the ``first`` bytes alone, and with a wrong ``length``."""
        data = self.server.owner.files[self.path]
        tag = f'"{hashlib.md5(data).hexdigest()}"'
        start = self._start(tag, len(data))
        code, headers = 200, {}
        if start is not None:
            code = 206
            headers["Content-Range"] = f"bytes {start}-{len(data) - 1}/{len(data)}"
            data = data[start:]
        if self.server.owner.tags:
            headers["ETag"] = tag
        self.head(code, len(data) if length is None else length, headers)
        self.wfile.write(data if first is None else data[:first])

    def _start(self, tag, size):
        match = re.fullmatch(r"bytes=(\d+)-", self.headers.get("Range", ""))
        if not match or not self.server.owner.ranges or int(match[1]) >= size:
            return None
        return int(match[1]) if self.headers.get("If-Range") in (None, tag) else None

    def answer(self, code, data, headers=None):
        self.head(code, len(data), headers or {})
        self.wfile.write(data)

    def head(self, code, length, headers):
        self.send_response(code)
        self.send_header("Connection", "close")
        if length is not None:
            self.send_header("Content-Length", str(length))
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()


# Mishaps: each takes the handler in place of a good answer.


def cut(after):
    """The connection ends after so many bytes."""
    return lambda handler: handler.good(first=after)


def claims(length):
    """The whole file, under a Content-Length of another size; None: under none."""
    return lambda handler: handler.good(length=length)


def status(code, headers=None, body=b"the server said so"):
    return lambda handler: handler.answer(code, body, headers)


def redirect(location):
    return lambda handler: handler.answer(302, b"", {"Location": location})


def html(handler):
    page = b"<!DOCTYPE html><html><head><title>Welcome to our hotel</title></head></html>"
    handler.answer(200, page, {"Content-Type": "text/html"})


def hang(handler):
    """Takes the request and says nothing."""
    handler.server.owner.closing.wait(20)


def trickle(handler):
    """A byte now and then: no socket ever times out."""
    data = handler.server.owner.files[handler.path]
    handler.head(200, len(data), {})
    for i in range(len(data)):
        handler.wfile.write(data[i : i + 1])
        if handler.server.owner.closing.wait(0.02):
            return


def wrong_range(handler):
    """A rest, but not the one that was asked for."""
    data = handler.server.owner.files[handler.path]
    handler.answer(206, data[:100], {"Content-Range": f"bytes 0-99/{len(data)}"})


def cut_chunked(handler):
    """Half of it, where the length is not told but every piece is announced."""
    data = handler.server.owner.files[handler.path]
    handler.head(200, None, {"Transfer-Encoding": "chunked"})
    handler.wfile.write(b"%x\r\n%s" % (len(data), data[: len(data) // 2]))


def chunked(handler):
    data = handler.server.owner.files[handler.path]
    handler.head(200, None, {"Transfer-Encoding": "chunked"})
    handler.wfile.write(b"%x\r\n%s\r\n0\r\n\r\n" % (len(data), data))
