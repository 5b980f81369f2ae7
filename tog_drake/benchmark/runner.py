"""Runs the cells of a benchmark that have not been run yet, whatever stopped it before."""

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tog_drake.benchmark.cells import Cell
from tog_drake.benchmark.costs import exchanges
from tog_drake.benchmark.journal import Journal, Line, Result
from tog_drake.benchmark.processes import Broken, in_processes
from tog_drake.errors import NoProposal, TogError
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

    def others(self, cell: Cell) -> list[str]:
        """Says what is other here than where the run began; see ``cluster``."""
        ...

    def broken(self, cell: Cell, broken: Broken) -> Result:
        """Returns what is to be told of a cell in which the program failed."""
        ...


Parallel = Callable[
    [Callable[[Cell], Result], Iterable[Cell], int],
    Generator[tuple[Cell, Result | Broken], None, None],
]


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
        max_cost: [USD] that models may cost, with what they have cost in this run before, also for
            episodes that broke or do not count. Episodes under way when it is reached end. What a
            process had asked that was killed is not known.
        parallel: how to work on several cells at once, see ``in_processes``.

    Raises:
        Stopped: a server takes no question, or no price is known; what ended is in the journal.
            A question that was not taken is no line, so that it is asked again the next time.
        InputError: an episode cannot be run at all, naming it.
    """
    state = _State(journal, work, max_cost, limit)
    pending = [cell for cell in cells if cell.name not in state.done]
    if not pending:
        return None
    try:
        with (
            _progress(console, len(cells), state) as tell,
            closing(parallel(work, state.wanted(pending), workers)) as ended,
        ):
            for cell, ending in ended:
                state.enter(cell, ending)
                tell()
    finally:  # Ctrl-C too
        if missing := len(cells) - len(state.done):
            say(
                console,
                f"{len(cells) - missing} of {len(cells)} episodes are in {journal.folder}; the "
                "same command again goes on from there",
            )
    if state.trouble is not None:
        raise Stopped(state.trouble)
    return state.enough() if missing else None


@contextmanager
def _progress(console: Console, total: int, state: "_State") -> Iterator[Callable[[], None]]:
    """Shows how far a run is; yields what shows it anew."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        TextColumn("{task.fields[said]}"),
    )
    with Progress(*columns, console=console, speed_estimate_period=600.0) as progress:
        bar = progress.add_task("episodes", total=total, completed=len(state.done), said="")
        yield lambda: progress.update(bar, completed=len(state.done), said=state.said)


class _State:
    """How far a run has come."""

    def __init__(self, journal: Journal, work: CellWork, max_cost: float | None, limit: int | None):
        self._journal, self._work = journal, work
        self._max_cost, self._limit = max_cost, limit
        self._begun = 0
        self._cost = 0.0  # [USD]
        self._failed: Counter[str] = Counter()
        self.done: set[str] = set()  # names of episodes
        self.trouble: str | None = None  # why no other is begun
        self._count(journal.lines)
        self._pay(journal.rejected)

    def enter(self, cell: Cell, ending: Result | Broken) -> None:
        """Writes down how an episode ended."""
        result = self._work.broken(cell, ending) if isinstance(ending, Broken) else ending
        if trouble := next(filter(None, map(_not_taken, result.lines)), None):
            self.trouble = self.trouble or trouble
            self._journal.reject(result)
            self._pay(result.lines)
        else:
            self._journal.append(result)
            self._count(result.lines)

    def wanted(self, cells: Iterable[Cell]) -> Iterator[Cell]:
        """Gives cells as long as there is a reason to run them."""
        for cell in cells:
            if self.trouble is not None or self.enough() is not None:
                return
            self._begun += 1
            yield cell

    def enough(self) -> str | None:
        """Why no further episode is begun, if so."""
        if self._max_cost is not None and self._cost >= self._max_cost:
            return f"--max-cost {self._max_cost:g} is reached: models have cost ${self._cost:.4f}"
        if self._limit is not None and self._begun >= self._limit:
            return f"--limit {self._limit} is reached"
        return None

    def _count(self, lines: Sequence[Line]) -> None:
        """Adds lines, all of those of an episode together."""
        for line in lines:
            record, name = line["record"], line["cell"]["name"]
            if record["outcome"] != "lifted" and name not in self.done:
                self._failed[record["outcome"]] += 1
            elif record["outcome"] == "lifted" and record["task_compliance"] is False:
                self._failed["wrong part"] += 1
            self.done.add(name)
        self._pay(lines)

    def _pay(self, lines: Sequence[Line]) -> None:
        """Adds what models cost, whether or not anything came of it."""
        last: str | None = None
        for line in lines:
            name = line["cell"]["name"]
            costs, unpriced = model_costs(line, answers=name != last)
            self._cost += sum(costs)
            if unpriced and self._max_cost is not None:
                self.trouble = self.trouble or _WITHOUT_PRICE
            last = name

    @property
    def said(self) -> str:
        """The failures and the cost, for the progress."""
        failures = ", ".join(f"{n} {reason}" for reason, n in self._failed.most_common())
        cost = f"${self._cost:.4f}" if self._cost else ""
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
