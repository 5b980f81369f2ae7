"""Questions to a model and its answers in a file: asked once, replayed as often as one likes.

A cassette is a file of lines as in ``recorded``. Of several lines of one key the last holds, but
for a response, which is final, unless it was given by hand and is corrected by hand. Each image
lies once in ``<stem>.images/<hex>.png`` beside the cassette. Headers are never written, and
whatever part of a key a server sends back is taken out by ``http_post``: there is no key in a
cassette.
"""

import fcntl
import logging
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, NoReturn

from tog_drake.errors import InputError, Unanswered
from tog_drake.selectors.vlm.recorded import (
    MAX_LINE,
    Recorded,
    opencv_version,
    read_entry,
    write_entry,
)
from tog_drake.selectors.vlm.request import QuestionPending, Request, save_images
from tog_drake.selectors.vlm.specification import ModelConfig

Mode = Literal["record", "replay", "export"]
"""record: what has no answer yet is asked, and added. replay: it is an error. export: it is
collected, to be asked elsewhere."""
_SHOWN = 4  # of what a cassette holds, in a message
MAX_FILE = 1_000_000_000  # [byte]

_log = logging.getLogger(__name__)


class NotRecorded(InputError):
    """A cassette that is replayed has no answer to the question that was asked."""


class Cassette:
    """The exchanges of a file. Several processes may record in the same one.

    What any of them has added since is found as well.
    """

    def __init__(self, path: Path | str, mode: Mode):
        """Reads the file.

        Raises:
            InputError: it cannot be read, holds a broken line, or is missing and to be replayed.
        """
        self.path = Path(path)
        self.mode = mode
        self._known: dict[str, Recorded] = {}
        self._offset = 0  # [byte] up to which the file has been read, whole lines
        self._lines = 0  # as many as these
        if mode == "replay" and not self.path.is_file():
            raise InputError(
                f"there is no cassette {self.path} to replay; record one with --record {self.path}"
            )
        self._read_on()

    @property
    def questions(self) -> tuple[Recorded, ...]:
        """All of them, in the order in which they were first asked."""
        return tuple(self._known.values())

    @property
    def image_folder(self) -> Path:
        return self.path.parent / f"{self.path.stem}.images"

    def model(self) -> ModelConfig:
        """Returns the model that was asked.

        Raises:
            InputError: there is none, or more than one.
        """
        models = {
            f"{entry.model} ({entry.profile}, max_tokens {entry.max_tokens}, effort "
            f"{entry.effort or 'not given'})": entry
            for entry in self._known.values()
        }
        if len(models) == 1:
            return models.popitem()[1].config()
        if not models:
            raise InputError(f"{self.path} is empty; record some questions with --record")
        raise InputError(
            f"{self.path} holds questions to {len(models)} models: {', '.join(sorted(models))}; "
            "say which with --vlm, or as the model of a scenario"
        )

    def lookup(self, request: Request) -> Recorded | None:
        """Returns a question with its response; None: it is to be asked.

        Raises:
            Unanswered: it was asked in vain, and that is replayed.
            InputError: what is recorded on was answered by another model or server.
            NotRecorded: it has no answer, and nobody may be asked.
            QuestionPending: it has no answer, and is to be asked elsewhere.
        """
        found = self._known.get(request.key)
        if found is None or found.response is None:
            self._read_on()
            found = self._known.get(request.key)
        if found is not None and found.response is not None:
            if self.mode == "record" and found.model != request.model:
                raise InputError(
                    f"{self.path} has the answer of {found.model} to a question to "
                    f"{request.model}; valid: another file for --record, or --replay {self.path}"
                )
            return found
        if self.mode == "replay":
            self._refuse(request, found)
        if self.mode == "export":
            raise QuestionPending((request,))
        return None

    def add(self, request: Request, response: Any, *, seconds: float) -> Recorded:
        """Enters the body of a response of status 200.

        Returns:
            What the cassette holds now and a replay will see: another process may have been
            faster with the same question.
        """
        save_images(self.image_folder, request)
        return self.enter(replace(Recorded.of(request), response=response, seconds=seconds))

    def add_error(self, request: Request, error: Unanswered, *, seconds: float) -> None:
        """Enters that a question was asked in vain: a replay ends likewise."""
        save_images(self.image_folder, request)
        said = (error.status, str(error))
        self.enter(replace(Recorded.of(request), error=said, seconds=seconds))

    def add_pending(self, request: Request) -> None:
        """Enters a question that waits for its answer."""
        save_images(self.image_folder, request)
        self.enter(Recorded.of(request))

    def enter(self, entry: Recorded) -> Recorded:
        """Adds a line, unless it says nothing new; returns what the cassette holds now.

        Raises:
            InputError: the line is too long.
            OSError: the file cannot be written to.
        """
        data = write_entry(entry)
        if len(data) > MAX_LINE:
            raise InputError(
                f"{self.path}: an exchange of {len(data)} bytes is too long; at most {MAX_LINE}"
            )
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            end = self._read_lines()
            if not _says_more(entry, self._known.get(entry.key)):
                return self._known[entry.key]
            if end == "torn":
                os.ftruncate(file.fileno(), self._offset)  # whoever wrote it has ended
            elif end == "open":
                data = b"\n" + data
            left = memoryview(data)
            while left:  # one write, but on a disk that takes no more
                left = left[os.write(file.fileno(), left) :]
            os.fsync(file.fileno())
            self._read_lines()
        return self._known[entry.key]

    def _refuse(self, request: Request, found: Recorded | None) -> NoReturn:
        if found is not None and found.error is not None:
            raise Unanswered(*found.error)
        what = f"the question {request.message.prompt} of key {request.key}"
        if found is not None:
            raise NotRecorded(
                f"{self.path}: {what} still waits for its answer: give it with `tog vlm import`, "
                f"or ask the model with --record {self.path}"
            )
        if not self._known:
            raise NotRecorded(
                f"{self.path} is empty: no answer to {what}. Ask with --record {self.path} in "
                "place of --replay"
            )
        raise NotRecorded(
            f"{self.path} has no answer to {what}: it was not asked with this scene, seed, task, "
            "strategy, rendering, model, max_tokens and effort. Ask with "
            f"--record {self.path} in place of --replay. It holds {self._contents()}"
            + self._drawn_elsewhere()
        )

    def _contents(self) -> str:
        """Which prompts of which models there are, in a few words."""
        held = sorted({f"{entry.prompt} of {entry.model}" for entry in self._known.values()})
        more = f" and {len(held) - _SHOWN} more" if len(held) > _SHOWN else ""
        return ", ".join(held[:_SHOWN]) + more

    def _drawn_elsewhere(self) -> str:
        """Says so where another version of OpenCV drew the images: its letters differ."""
        here = opencv_version()
        others = {entry.opencv for entry in self._known.values()} - {here}
        if not others:
            return ""
        return f". Its images were drawn with OpenCV {', '.join(sorted(others))}; here is {here}"

    def _read_on(self) -> None:
        """Reads what has been added since, when nobody is in the middle of a line."""
        if not self.path.exists():
            return
        try:
            with self.path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH)
                self._read_lines()
        except OSError as error:
            raise InputError(f"{self.path} cannot be read: {error.strerror}") from error

    def _read_lines(self) -> Literal["", "torn", "open"]:
        """Reads on; returns how the last line ends: a whole one may lack its newline."""
        with self.path.open("rb") as file:
            if os.fstat(file.fileno()).st_size > MAX_FILE:
                raise InputError(f"{self.path} is longer than {MAX_FILE} bytes, the most for one")
            file.seek(self._offset)
            while data := file.readline(MAX_LINE + 1):
                where = f"{self.path}, line {self._lines + 1}"
                ended = data.endswith(b"\n")
                try:
                    self._know(read_entry(data, where) if data.strip() else None)
                except InputError:
                    if ended or len(data) > MAX_LINE:
                        raise
                    _warn_torn(where)
                    return "torn"
                if not ended:
                    return "open"
                self._offset += len(data)
                self._lines += 1
        return ""

    def _know(self, entry: Recorded | None) -> None:
        if entry is not None and _says_more(entry, self._known.get(entry.key)):
            self._known[entry.key] = entry


@cache  # once, however many read the file: the options are tried before the run
def _warn_torn(where: str) -> None:
    _log.warning("%s is torn, perhaps by a process that was killed; left out", where)


def _says_more(entry: Recorded, known: Recorded | None) -> bool:
    """Whether a line changes what is known of its question."""
    if known is None:
        return True
    if known.source == entry.source == "hand" and entry.response is not None:
        return bool(entry.response != known.response)
    return known.response is None and not entry.pending
