"""The questions of a run or a suite, written down without a model being asked.

Every episode is run as far as its question: rendered, perceived, filtered, but nothing is moved.
What the cassette knows by now is taken from it, so that strategies of several rounds get on to
their next question.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tog_drake.episode import build_world, look
from tog_drake.errors import EpisodeError, InputError
from tog_drake.evaluation import Cell, cell_scenario, in_processes
from tog_drake.options import SelectorOptions
from tog_drake.selectors.vlm.batch import Export, custom_id, how_to_send
from tog_drake.selectors.vlm.batch_answers import read_answers
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.request import QuestionPending, Request


@dataclass
class Exported:
    """What became of the episodes: each is decided, waiting, or over without a question."""

    decided: int = 0
    waiting: int = 0
    over: list[str] = field(default_factory=list)  # why, each with its episode
    questions: int = 0  # that wait for an answer; two episodes may wait for the same
    files: list[Path] = field(default_factory=list)  # of the batch
    how: str = ""  # to send them


@dataclass(frozen=True)
class _Looked:
    """How far an episode came; with neither questions nor a problem, it has its choice."""

    requests: tuple[Request, ...] = ()
    problem: str = ""


def export_questions(
    cells: Sequence[Cell],
    options: SelectorOptions,
    *,
    cassette: Path,
    out: Path,
    workers: int,
    console: Console,
) -> Exported:
    """Writes the questions that wait for an answer into ``out`` and into the cassette.

    Args:
        cells: the episodes.
        options: whom to ask, and how, with the same cassette as its ``export``.
        cassette: the file with the answers that there are.
        out: folder, see ``selectors.vlm.batch``.
        workers: processes.
        console: for the progress.

    Raises:
        InputError: a cell or an option makes no sense, or ``out`` holds answers that were not
            imported yet.
    """
    options.apply(cell_scenario(cells[0]).pipeline)  # to hear now what is wrong
    tape = Cassette(cassette, "export")
    _check_imported(out / "answers.jsonl", tape)
    export, exported = Export(out), Exported()
    with Progress(console=console) as progress:
        bar = progress.add_task("episodes", total=len(cells))
        work = partial(_look_at, options=options)
        looked_at = in_processes(work, cells, workers) if len(cells) > 1 else map(work, cells)
        for cell, looked in zip(cells, looked_at, strict=True):
            about = f"{cell.scenario}, seed {cell.seed}: {cell.tasks[0]}"
            for request in looked.requests:
                tape.add_pending(request)
                export.add(request, about)
                exported.how = how_to_send(request)
            if looked.requests:
                exported.waiting += 1
            elif looked.problem:
                exported.over.append(f"{about}: {looked.problem}")
            else:
                exported.decided += 1
            progress.advance(bar)
    export.finish()
    exported.questions, exported.files = len(export), export.files
    return exported


def _look_at(cell: Cell, options: SelectorOptions) -> _Looked:
    """Runs an episode as far as its choice."""
    scenario = cell_scenario(cell)
    options.apply(scenario.pipeline)
    try:
        world = build_world(scenario, target=cell.object or None, task=cell.tasks[0])
        simulator = look(world, scenario, cell.tasks[0])
        pipeline = world.pipeline
        context = pipeline.GetMyContextFromRoot(simulator.get_context())
        pipeline.GetOutputPort("choice").Eval(context)
    except QuestionPending as pending:
        return _Looked(requests=pending.requests)
    except EpisodeError as error:
        return _Looked(problem=str(error))
    except InputError as error:
        raise InputError(f"{cell.name}: {error}") from error
    return _Looked()


def _check_imported(file: Path, cassette: Cassette) -> None:
    """Raises InputError where answers would be overwritten that the cassette does not have."""
    if not file.exists():
        return
    waiting = {custom_id(q.key) for q in cassette.questions if q.response is None}
    if any(given.answer and custom_id(given.name) in waiting for given in read_answers(file)):
        raise InputError(
            f"{file} holds answers that were not imported: run `tog vlm import {file}` first, or "
            "name another --out"
        )
