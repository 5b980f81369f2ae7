"""What is left of a run in its folder, so that it can be stopped at any moment and taken up again.

``run.json`` says what was asked for: all that decides a result, nothing else. ``episodes.jsonl``
has one line for every task of every episode that ended, in the order in which they ended; the lines
of one episode are written at once and are on the disk before the next. What a kill tore at the
end of the file is no line: it is cut off, and that episode is run again.
"""

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypedDict

from tog_drake.errors import InputError
from tog_drake.files import write_atomically

if TYPE_CHECKING:
    from tog_drake.record import EpisodeRecord

SCHEMA = "tog_drake/run/1"
"""Name and version of a run's folder; the number changes when a field changes its meaning."""
RUN, EPISODES, PICTURES = "run.json", "episodes.jsonl", "episodes"
SHARED = "shared"  # folder of what episodes share
LABELS = "labels.json"  # what people said of the grasps, see human_labels
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
    if (folder / EPISODES).exists():
        lines, _ = _whole_episodes((folder / EPISODES).read_bytes(), folder / EPISODES)
    return Run(folder, config, _in_run_order(lines))


class Journal:
    """The file of a run that is under way. Nobody else can write it meanwhile.

    ``lines`` are those so far, in the order of the run.
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
            self.lines = self._recover()
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
        self._file.write("".join(json.dumps(line) + "\n" for line in lines).encode())
        self._file.flush()
        os.fsync(self._file.fileno())
        self.lines = _in_run_order([*self.lines, *lines])

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
            (self.folder / LABELS).unlink(missing_ok=True)
        elif changed := differences(old, config):
            more = f"; and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else ""
            raise InputError(
                f"{self.folder} holds another run: {'; '.join(changed[:_SHOWN])}{more}. Valid: the "
                "same options, to go on with it; another --out; or --fresh, which deletes it"
            )
        else:
            return
        write_atomically(path, json.dumps(config, indent=1) + "\n")

    def _recover(self) -> list[Line]:
        self._file.seek(0)
        data = self._file.read()
        lines, size = _whole_episodes(data, self.folder / EPISODES)
        if size < len(data):
            self._file.truncate(size)
            os.fsync(self._file.fileno())
        return _in_run_order(lines)


def differences(was: Mapping[str, Any], asked: Mapping[str, Any]) -> list[str]:
    """Returns what distinguishes two configurations, each such as "seeds was 3, asked is 5"."""
    old, new = dict(_fields(was)), dict(_fields(asked))
    return [
        f"{name} was {old.get(name, 'not there')}, asked is {new.get(name, 'none')}"
        for name in dict.fromkeys([*old, *new])
        if old.get(name) != new.get(name)
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
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read: {error}; valid: another folder") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise InputError(f"{path} is of schema {schema!r}, not {SCHEMA}; valid: another folder")
    return dict(content)


def _whole_episodes(data: bytes, file: Path) -> tuple[list[Line], int]:
    """The lines of episodes that were written whole, and how many bytes these take.

    Only the last episode can be torn. Anything else that is no line is damage.
    """
    lines: list[Line] = []
    episode: list[Line] = []
    size = end = 0
    for raw in data.split(b"\n")[:-1]:  # after the last newline is nothing, or what was torn
        end += len(raw) + 1
        try:
            line: Line = json.loads(raw)
            cell = line["cell"]
            whole = cell["tasks"] == len(episode) + 1
            known = isinstance(line["record"], dict) and isinstance(cell["number"], int)
            known &= all(cell["name"] == before["cell"]["name"] for before in episode)
        except (ValueError, LookupError, TypeError, RecursionError):
            known = whole = False
        if not known:
            if end == len(data):
                break
            raise InputError(
                f"{file}: what ends at byte {end} is no line of a run; the file was damaged or "
                "changed. Valid: --fresh, another folder, or to delete that line"
            )
        episode.append(line)
        if whole:
            lines += episode
            episode, size = [], end
    return lines, size


def _in_run_order(lines: Sequence[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: line["cell"]["number"])  # stable: tasks as written
