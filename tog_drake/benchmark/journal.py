"""What is left of a run in its folder, so that it can be stopped at any moment and taken up again.

``run.json`` says what was asked for: all that decides a result, nothing else. ``episodes.jsonl``
has one line for every task of every episode that ended, in the order in which they ended; the lines
of one episode are written at once and are on the disk before the next. What a kill tore at the
end of the file is no line: it is cut off, and that episode is run again. ``rejected.jsonl`` has
such lines of episodes that do not count and will be run again, because a server did not take a
question: other questions of theirs may have been paid for.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypedDict

from tog_drake.benchmark.line_check import CONFIG, LINE, misfit
from tog_drake.errors import InputError
from tog_drake.files import write_atomically

if TYPE_CHECKING:
    from tog_drake.record import EpisodeRecord

SCHEMA = "tog_drake/run/1"
"""Name and version of a run's folder; the number changes when a field changes its meaning."""
RUN, EPISODES, REJECTED, PICTURES = "run.json", "episodes.jsonl", "rejected.jsonl", "episodes"
COMMAND = "command"
"""Field of a ``run.json``: the words that run the same again. It is not compared: others may say
the same, such as by another way to a file."""
SHARED = "shared"  # folder of what episodes share
LABELS = "labels.json"  # what people said of the grasps, see human_labels
MAX_RUN = 10_000_000  # [byte] of run.json; ours have a few thousand
MAX_LINE = 10_000_000  # [byte] of a line; ours have 3,000, and with a model some ten thousand
_SHOWN = 10  # differences between two configurations that a message tells


class CellRecord(TypedDict):
    """Which episode of a run it was, and which of its tasks the line tells of."""

    name: str  # of the episode, unique in its run: that of its folder in episodes/
    number: int  # of the episode in the order of the run, from 0
    tasks: int  # for how many tasks the episode is judged: as many lines have its name
    method: str  # the row of the table
    proposer: str | None  # as --proposers names it; null: the scenario's, as for all that follow
    k: str | None
    selector: str
    strategy: str | None
    vlm: str | None
    view: str | None  # as --views names who compares them
    scenario: str
    object: str
    seed: int
    task: str
    category: str  # of the task: use, handover, position, choose, or another of the suite
    beyond: str | None  # why no hand that opens 8 cm can do it, if so


class JudgeRecord(TypedDict):
    """What a model that was asked to judge said of the chosen grasp."""

    model: str
    complies: bool | None  # null: its answer was no use
    status: str
    cost: float | None  # [USD]; null: the price is not known
    seconds: float


class Line(TypedDict):
    """One line of ``episodes.jsonl``."""

    cell: CellRecord
    record: "EpisodeRecord"
    judge: JudgeRecord | None


@dataclass(frozen=True)
class Result:
    """What an episode leaves: it comes from whatever process or machine ran it as a whole."""

    lines: list[Line]  # one for each of its tasks
    files: dict[str, bytes] = field(default_factory=dict)  # by name, in its folder in episodes/


@dataclass(frozen=True)
class Run:
    """What a folder holds of a run, ended or not."""

    folder: Path
    config: dict[str, Any]  # run.json
    lines: list[Line]  # in the order of the run, however it was divided and resumed


def episode_folder(run: Path, line: Line) -> Path | None:
    """Returns the folder of a line's episode; None where its name would lead elsewhere."""
    name = line["cell"]["name"]
    return (
        run / PICTURES / name if name not in ("", ".", "..") and Path(name).name == name else None
    )


def read_run(folder: Path) -> Run:
    """Reads a run, also while it is under way.

    Raises:
        InputError: there is none, or its files were damaged.
    """
    config = _read_config(folder / RUN)
    if config is None:
        raise InputError(
            f"{folder} holds no run ({RUN} is missing); valid: the --out of a `tog eval`"
        )
    lines: list[Line] = []
    try:
        if (folder / EPISODES).exists():
            with (folder / EPISODES).open("rb") as file:
                lines, _ = _whole_episodes(file, folder / EPISODES)
    except OSError as error:
        raise InputError(f"{folder / EPISODES} cannot be read: {error.strerror}") from error
    return Run(folder, config, _in_run_order(lines))


class Journal:
    """The file of a run that is under way. Nobody else can write it meanwhile.

    ``lines`` are those so far, in the order of the run; ``rejected`` those that do not count.
    """

    def __init__(self, folder: Path, config: Mapping[str, Any], *, fresh: bool = False):
        """Begins a run, or takes it up where it was stopped.

        Args:
            folder: of the run.
            config: what it is asked for, as ``run.json`` is to hold it.
            fresh: whether to delete a run that is there.

        Raises:
            InputError: the folder holds another run or anything else by such names, or another
                process writes it.
        """
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._file: BinaryIO = (folder / EPISODES).open("a+b")
        try:
            self._lock()
            self._begin(json.loads(json.dumps(config)), fresh)
            self.lines = _recover(self._file, folder / EPISODES)
            self.rejected: list[Line] = []
            if (folder / REJECTED).exists():
                with (folder / REJECTED).open("r+b") as file:
                    self.rejected = _recover(file, folder / REJECTED)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, result: Result) -> None:
        """Writes all files and lines of one episode; when this returns, they are on the disk."""
        lines = result.lines
        for name, content in result.files.items():
            write_atomically(self.folder / PICTURES / lines[0]["cell"]["name"] / name, content)
        _write(self._file, lines)
        self.lines = _in_run_order([*self.lines, *lines])

    def reject(self, result: Result) -> None:
        """Writes the lines of an episode that does not count: the next start runs it again."""
        with (self.folder / REJECTED).open("ab") as file:
            _write(file, result.lines)
        self.rejected += result.lines

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(
                f"{self.folder} is being written by another `tog eval`; valid: to wait until it "
                "has ended, or another --out"
            ) from error

    def _begin(self, config: dict[str, Any], fresh: bool) -> None:
        path = self.folder / RUN
        old = _read_config(path)
        if old is None:
            if (self.folder / EPISODES).stat().st_size or (self.folder / PICTURES).exists():
                raise InputError(
                    f"{self.folder} holds {EPISODES} or {PICTURES}/ of something else (there is no "
                    f"{RUN}); valid: another --out"
                )
        elif fresh:  # the lines first: whatever is left of a run without them is a run not begun
            self._file.truncate(0)
            shutil.rmtree(self.folder / PICTURES, ignore_errors=True)
            shutil.rmtree(self.folder / SHARED, ignore_errors=True)
            for name in (LABELS, REJECTED):
                (self.folder / name).unlink(missing_ok=True)
        elif changed := differences(old, config):
            told = "; ".join(changed[:_SHOWN])
            more = f"; and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
            edited = old.get("program") != config.get("program")
            why = "The program is another than then: results may differ. " if edited else ""
            raise InputError(
                f"{self.folder} holds another run: {told}{more}. {why}Valid: the same options, "
                "program and files, to go on with it; another --out; or --fresh, which deletes it"
            )
        else:
            return
        write_atomically(path, json.dumps(config, indent=1) + "\n")


def _write(file: BinaryIO, lines: Sequence[Line]) -> None:
    """Writes lines at once. Raises InputError for one so long that it could not be read again."""
    written = [json.dumps(line).encode() + b"\n" for line in lines]
    if (longest := max(map(len, written))) > MAX_LINE:
        name = lines[0]["cell"]["name"]
        raise InputError(f"{name}: its line would have {longest} bytes; valid: {MAX_LINE}")
    file.write(b"".join(written))
    file.flush()
    os.fsync(file.fileno())


def _recover(file: BinaryIO, path: Path) -> list[Line]:
    """The lines of a file that is open for writing; what a kill tore at its end is cut off."""
    file.seek(0)
    lines, size = _whole_episodes(file, path)
    if size < file.seek(0, os.SEEK_END):
        file.truncate(size)
        os.fsync(file.fileno())
    return _in_run_order(lines)


def differences(was: Mapping[str, Any], asked: Mapping[str, Any]) -> list[str]:
    """Returns what distinguishes two configurations, each such as "seeds was 3, asked is 5"."""
    old, new = dict(_fields(was)), dict(_fields(asked))
    return [
        f"{name} was {old.get(name, 'not there')}, asked is {new.get(name, 'none')}"
        for name in dict.fromkeys([*old, *new])
        if name != COMMAND and old.get(name) != new.get(name)
    ]


def _fields(config: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Each field by its path, with its value as JSON."""
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from _fields(value, f"{above}{key}.")
        else:
            yield above + key, json.dumps(value)


def _read_config(path: Path) -> dict[str, Any] | None:
    """The content of a ``run.json``; None where there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_RUN + 1)
        if len(data) > MAX_RUN:
            raise InputError(f"{path} has more than {MAX_RUN} bytes; valid: another folder")
        content = json.loads(data)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read: {error}; valid: another folder") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise InputError(
            f"{path} is of schema {schema!r:.100}, not {SCHEMA}; valid: another folder"
        )
    if (wrong := misfit(content, CONFIG, RUN)) is not None:
        raise InputError(f"{path} is no {RUN} of a run: {wrong}; valid: another folder")
    return dict(content)


def _whole_episodes(file: BinaryIO, path: Path) -> tuple[list[Line], int]:
    """The lines of episodes that were written whole, and how many bytes these take.

    Only the last episode can be torn. Anything else that is no line is damage.

    Raises:
        InputError: naming file and line.
    """
    lines: list[Line] = []
    episode: list[Line] = []
    size = end = number = 0
    while (raw := file.readline(MAX_LINE + 1)).endswith(b"\n"):
        number, end = number + 1, end + len(raw)
        try:
            line = json.loads(raw)
        except (ValueError, RecursionError):
            if not file.read(1):
                break  # it is the last
            wrong: str | None = "it is no JSON"
        else:
            wrong = misfit(line, LINE, "line") or _out_of_place(line, episode)
        if wrong is not None:
            raise _damaged(path, number, wrong)
        episode.append(line)
        if line["cell"]["tasks"] == len(episode):
            lines += episode
            episode, size = [], end
    if len(raw) > MAX_LINE:
        raise _damaged(path, number + 1, f"it has more than {MAX_LINE} bytes")
    return lines, size


def _out_of_place(line: Line, episode: Sequence[Line]) -> str | None:
    """Says so where a line does not belong to the episode whose lines before it are given."""
    cell = line["cell"]
    if cell["tasks"] <= len(episode):
        return f"it is line {len(episode) + 1} of an episode of {cell['tasks']}"
    if any(before["cell"]["name"] != cell["name"] for before in episode):
        return f"the episode {episode[0]['cell']['name']!r:.100} before it is not whole"
    return None


def _damaged(path: Path, number: int, wrong: str) -> InputError:
    return InputError(
        f"{path}, line {number}: {wrong}; the file was damaged or changed. Valid: --fresh, another "
        "folder, or to delete that line"
    )


def _in_run_order(lines: Sequence[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: line["cell"]["number"])  # stable: tasks as written
