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

from tog_drake.benchmark.cells import Cell, cell_scenario
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.processes import in_job_order, in_processes
from tog_drake.errors import EpisodeError, InputError
from tog_drake.options import SelectorOptions, put_k
from tog_drake.pipeline import make_selector, make_view_scorer
from tog_drake.scenario import Scenario
from tog_drake.selector import Selector
from tog_drake.selectors.geometric import Geometric
from tog_drake.selectors.vlm.batch import Export, custom_id, how_to_send
from tog_drake.selectors.vlm.batch_answers import read_answers
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.request import QuestionPending, Request
from tog_drake.view_options import put_view
from tog_drake.view_scorers.coverage import Coverage
from tog_drake.view_scorers.vlm_compare import VlmCompare
from tog_drake.view_selection import ViewScorer, select_view
from tog_drake.world import build_world, look


@dataclass
class Exported:
    """What became of the episodes: each is decided, waiting, or over without a question."""

    decided: int = 0
    waiting: int = 0
    over: list[str] = field(default_factory=list)  # why, each with its episode
    questions: int = 0  # that wait for an answer; two episodes may wait for the same
    files: list[Path] = field(default_factory=list)  # of the batch
    how: str = ""  # to send them

    def count(self, looked: "_Looked", about: str) -> None:
        """Adds an episode, ``about`` which this is."""
        if looked.requests:
            self.waiting += 1
            self.how = how_to_send(looked.requests[-1])
        elif looked.problem:
            self.over.append(f"{about}: {looked.problem}")
        else:
            self.decided += 1


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
        options: whom to ask, and how.
        cassette: the file with the answers that there are.
        out: folder, see ``selectors.vlm.batch``.
        workers: processes.
        console: for the progress.

    Raises:
        InputError: a cell or an option makes no sense, or ``out`` holds answers not yet imported.
    """
    tape = Cassette(cassette, "export")
    # To hear now what is wrong:
    _deciders(cell_scenario(cells[0]), options, cells[0].method, cassette)
    _check_imported(out / "answers.jsonl", tape)
    export, exported = Export(out), Exported()
    with Progress(console=console) as progress:
        bar = progress.add_task("episodes", total=len(cells))
        work = partial(_look_at, options=options, cassette=cassette)
        alone = len(cells) == 1
        ended = in_processes(work, cells, workers)
        looked_at = map(work, cells) if alone else in_job_order(cells, ended)
        for cell, looked in zip(cells, looked_at, strict=True):
            about = f"{cell.scenario}, seed {cell.seed}: {cell.task}"
            for request in looked.requests:
                tape.add_pending(request)
                export.add(request, about)
            exported.count(looked, about)
            progress.advance(bar)
    export.finish()
    exported.questions, exported.files = len(export), export.files
    return exported


def _deciders(
    scenario: Scenario, options: SelectorOptions, method: Method, cassette: Path
) -> tuple[ViewScorer, Selector]:
    """Returns what the scenario is to be decided by, and takes it out of its pipeline: only here
    can it be asked for questions that wait."""
    config = scenario.pipeline
    options.apply(config, asks=False)
    put_k(config, method.k)
    put_view(config, method.view)
    scorer = make_view_scorer(config, scenario.random_seed, export=cassette)
    if isinstance(config.view_selection.scorer, VlmCompare):
        config.view_selection.scorer = Coverage()  # is not asked, and has the same cameras
    selector = make_selector(config, scenario.random_seed, export=cassette)
    config.selector = Geometric()  # is not asked
    return scorer, selector


def _look_at(cell: Cell, options: SelectorOptions, cassette: Path) -> _Looked:
    """Runs an episode as far as its choice."""
    scenario = cell_scenario(cell)
    try:
        scorer, selector = _deciders(scenario, options, cell.method, cassette)
        world = build_world(scenario, target=cell.object or None, task=cell.task)
        simulator = look(world, scenario, cell.task)
        context = world.pipeline.GetMyContextFromRoot(simulator.get_context())
        views, cloud, candidates = (
            world.pipeline.GetOutputPort(port).Eval(context)
            for port in ("views", "cloud", "candidates")
        )
        target = scenario.pipeline.view_selection.target
        selected = select_view(scorer, views, cloud, candidates, cell.task, target=target)
        selector.select(selected.view, cloud, candidates, cell.task)
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
