"""Runs the cells of a benchmark that have not been run yet, whatever stopped it before."""

import hashlib
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tog_drake.benchmark.cells import Cell, model_hashes, worlds_of
from tog_drake.benchmark.costs import exchanges
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.journal import SCHEMA, Journal, Line, Result
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.processes import Broken, in_processes
from tog_drake.benchmark.suite import Suite
from tog_drake.errors import NoProposal, TogError
from tog_drake.scenario import scenario_files
from tog_drake.terminal import say

_WITHOUT_PRICE = (
    "--max-cost cannot be kept, because the price of an answer is not known; valid: without it, or "
    "with a file of prices, which TOG_PRICES names"
)


class Stopped(TogError):
    """Every further episode would end like the last, which tells of no method."""


class CellWork(Protocol):
    """What runs a cell, in whatever process of whatever machine."""

    def __call__(self, cell: Cell) -> Result: ...

    def broken(self, cell: Cell, broken: Broken) -> Result:
        """Returns what is to be told of a cell in which the program failed."""
        ...


Parallel = Callable[
    [Callable[[Cell], Result], Iterable[Cell], int],
    Generator[tuple[Cell, Result | Broken], None, None],
]


def run_config(
    suite: Suite,
    methods: Sequence[Method],
    cells: Sequence[Cell],
    work: EpisodeWork,
    *,
    seeds: int,
) -> dict[str, Any]:
    """Returns all that decides the results of a run, the content of its ``run.json``.

    Raises:
        InputError: a scenario or an object is not there, or a method cannot be run on it.
    """
    for cell in {(cell.scenario, cell.method): cell for cell in cells}.values():
        work.configured(cell)
    options, first = work.options, cells[0]
    asked = ("profile", "rendering", "votes", "fallback", "replay", "deadline")
    scenarios = sorted({cell.scenario for cell in worlds_of(cells)})
    return {
        "schema": SCHEMA,
        "suite": suite.name,
        "suite_sha256": suite.sha256,
        "methods": [method.name for method in methods],
        "seeds": seeds,
        "noise": first.noise,
        "side-cameras": first.views.side_cameras,
        "fuse": first.views.fuse,
        "target": first.views.target,
        "scenario_text": first.text,
        "asked": {name: _plain(getattr(options, name)) for name in asked},
        "checkpoint": None if work.checkpoint is None else _sha256(work.checkpoint),
        "judge": work.judge,
        "version": version("tog_drake"),
        "scenarios": {name: _sha256(scenario_files().get(name, Path(name))) for name in scenarios},
        "objects": model_hashes(cells),
    }


def _plain(value: object) -> object:
    return str(value) if isinstance(value, Path) else value


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def evaluate(
    cells: Sequence[Cell],
    work: CellWork,
    journal: Journal,
    *,
    workers: int,
    console: Console,
    limit: int | None = None,
    max_cost: float | None = None,
    parallel: Parallel = in_processes,
) -> str | None:
    """Runs the cells that the journal has no lines of; says why not all, or returns None.

    Args:
        cells: of the whole run.
        work: makes lines of a cell.
        journal: gets them as they come.
        workers: how many cells at once.
        console: for the progress.
        limit: episodes of this time.
        max_cost: [USD] that models may cost, with what they have cost in this run before; episodes
            under way when it is reached end.
        parallel: how to work on several cells at once, see ``in_processes``.

    Raises:
        Stopped: a server takes no question, or no price is known; what ended is in the journal.
            A question that was not taken is no line, so that it is asked again the next time.
        InputError: an episode cannot be run at all, naming it.
    """
    done = {line["cell"]["name"] for line in journal.lines}
    pending = [cell for cell in cells if cell.name not in done]
    state = _State(max_cost, len(pending) if limit is None else limit)
    state.count(journal.lines)
    if not pending:
        return None
    try:
        with (
            _progress(console) as progress,
            closing(parallel(work, state.wanted(pending), workers)) as ended,
        ):
            bar = progress.add_task("episodes", total=len(cells), completed=len(done), said="")
            for cell, ending in ended:
                result = work.broken(cell, ending) if isinstance(ending, Broken) else ending
                if trouble := next(filter(None, map(_not_taken, result.lines)), None):
                    state.trouble = state.trouble or trouble
                    continue
                journal.append(result)
                done.add(cell.name)
                state.count(result.lines)
                progress.update(bar, advance=1, said=state.said)
    finally:  # Ctrl-C too
        if len(done) < len(cells):
            say(
                console,
                f"{len(done)} of {len(cells)} episodes are in {journal.folder}; the same command "
                "again goes on from there",
            )
    if state.trouble is not None:
        raise Stopped(state.trouble)
    return state.enough() if len(done) < len(cells) else None


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[said]}"),
        console=console,
        speed_estimate_period=600.0,
    )


@dataclass
class _State:
    """How far a run has come."""

    max_cost: float | None
    limit: int
    begun: int = 0
    cost: float = 0.0  # [USD]
    failed: Counter[str] = field(default_factory=Counter)
    trouble: str | None = None

    def wanted(self, cells: Iterable[Cell]) -> Iterator[Cell]:
        """Gives cells as long as there is a reason to run them."""
        for cell in cells:
            if self.trouble is not None or self.enough() is not None:
                return
            self.begun += 1
            yield cell

    def enough(self) -> str | None:
        """Why no further episode is begun, if so."""
        if self.max_cost is not None and self.cost >= self.max_cost:
            return f"--max-cost {self.max_cost:g} is reached: models have cost ${self.cost:.4f}"
        return f"--limit {self.limit} is reached" if self.begun >= self.limit else None

    def count(self, lines: Sequence[Line]) -> None:
        """Adds lines, all of those of an episode together."""
        counted: set[str] = set()
        for line in lines:
            record, name = line["record"], line["cell"]["name"]
            if record["outcome"] != "lifted" and name not in counted:
                self.failed[record["outcome"]] += 1
            elif record["outcome"] == "lifted" and record["task_compliance"] is False:
                self.failed["wrong part"] += 1
            costs, unpriced = model_costs(line, answers=name not in counted)
            self.cost += sum(costs)
            if unpriced and self.max_cost is not None:
                self.trouble = _WITHOUT_PRICE
            counted.add(name)

    @property
    def said(self) -> str:
        failures = ", ".join(f"{n} {reason}" for reason, n in self.failed.most_common())
        cost = f"${self.cost:.4f}" if self.cost else ""
        return "; ".join(part for part in (failures, cost) if part)


def model_costs(line: Line, *, answers: bool = True) -> tuple[list[float], bool]:
    """Returns what models cost [USD] for a line, and whether something of unknown price was asked.

    Args:
        line: of the journal.
        answers: whether to count those of the decision, which several lines of an episode share.
    """
    asked = [exchange for exchange in exchanges(line) if exchange["replayed"] is None]
    costs = [e["cost"] for e in asked if answers and e["tokens"] is not None]
    if line["judge"] is not None and line["judge"]["status"] not in ("timed_out", "unreachable"):
        costs.append(line["judge"]["cost"])
    known = [cost for cost in costs if cost is not None]
    return known, len(known) < len(costs)


def _not_taken(line: Line) -> str | None:
    """Says what is wrong where a server did not take a question, or proposed nothing of use."""
    record, judge = line["record"], line["judge"]
    where = f"{record['scenario']}, seed {record['seed']}"
    if record["outcome"] == NoProposal.outcome:
        return f"{where}: the rest is not run: {record['message']}"
    vlm = record["vlm"]
    if vlm is not None and vlm["status"] == "rejected":
        said = [record["message"] or "", *(e["message"] for e in vlm["exchanges"])]
        return (
            f"{where}: {vlm['model']} does not take the question, so the rest is not run: "
            f"{said[-1]}"
        )
    if judge is not None and judge["status"] == "rejected":
        return f"{where}: {judge['model']} does not take the question, so the rest is not run"
    return None
