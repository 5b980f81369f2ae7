"""Runs the command ``tog`` in this process: what a shell would show, without starting Python."""

import logging
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from unittest.mock import patch

from tog_drake.cli import main


@dataclass(frozen=True)
class Done:
    """What a shell would show."""

    status: int
    out: str
    err: str


def tog(*arguments) -> Done:
    """Runs ``tog`` with ``arguments``; what it sets for its process is put back."""
    out, err = StringIO(), StringIO()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    filters = list(logging.getLogger("drake").filters)
    argv = ["tog", *map(str, arguments)]
    try:
        with patch.object(sys, "argv", argv), redirect_stdout(out), redirect_stderr(err):
            main()
        status = 0
    except SystemExit as ended:
        status = ended.code or 0
    finally:
        logging.getLogger("drake").filters[:] = filters
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return Done(status, out.getvalue(), err.getvalue())


def refused(done: Done, *words: str) -> None:
    """Asserts that wrong input ended as it should: one line that holds ``words``, status 2."""
    assert done.status == 2, done
    assert done.out == ""
    (line,) = done.err.splitlines()
    assert line.startswith("tog: ")
    for word in words:
        assert word in line
