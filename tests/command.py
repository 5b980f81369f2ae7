"""Runs the command ``tog`` in this process: what a shell would show, without starting Python."""

import logging
import os
import re
import shlex
import signal
import subprocess
import sys
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from unittest.mock import patch

import typer

from tog_drake.cli import app, main


def _leaves(group, *path):
    """Every command that does something, by what is typed: "run", "vlm check"."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from _leaves(command, *path, name)
        else:
            yield " ".join((*path, name)), command


COMMANDS = dict(_leaves(typer.main.get_command(app)))


def checked(line: str) -> str:
    """Returns which command a line is, such as "vlm check".

    Raises where it names none, an option is unknown, or a required one is missing.
    """
    program, *words = shlex.split(line, comments=True)
    assert program == "tog", line
    words = [word for word in words if word != "--debug"]
    for n in (1, 2):
        name = " ".join(words[:n])
        if name in COMMANDS:
            COMMANDS[name].make_context(name, words[n:])
            return name
    raise AssertionError(f"no command of tog: {line}")


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


@contextmanager
def tog_serve(*arguments):
    """``tog serve proposer`` in a process of its own; yields its URL, and ends it by Ctrl-C."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tog_drake.cli", "serve", "proposer", "--port", "0", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        line = process.stdout.readline()
        found = re.search(r"http://\S+/propose", line)
        assert found, line + process.stderr.read()
        yield found[0]
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=60)
        assert (process.returncode, told) == (130, "interrupted\n")
    finally:
        process.kill()
        process.communicate()
