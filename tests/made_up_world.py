"""A world in which an episode is a small calculation, for tests of what runs many of them.

``python made_up_world.py DIR WORKERS SECONDS`` runs such a benchmark as ``tog eval`` does.
"""

import hashlib
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from run_folder import make_exchange, make_line

from tog_drake.benchmark.journal import SCHEMA, Journal, Result

CONFIG = {"schema": SCHEMA, "suite": "made up", "methods": ["oracle"], "seeds": 3}
CELLS = 40


@dataclass(frozen=True)
class MadeUpCell:
    """As much of a cell as is run here."""

    number: int
    tasks: int = 1

    @property
    def name(self):
        return f"{self.number:05d}-made-up"


def cells(count=CELLS):
    """Cells of one, two or three tasks."""
    return [MadeUpCell(n, 1 + n % 3) for n in range(count)]


@dataclass(frozen=True)
class MadeUpWork:
    """Makes of a cell what its number says, after a while; ``troubles`` befall some of them."""

    seconds: float = 0.0
    troubles: tuple[tuple[int, str], ...] = ()
    cost: float | None = None  # [USD] of a question to a model
    folder: Path | None = None  # where each begin of a cell is noted

    def __call__(self, cell):
        if self.folder is not None:
            with (self.folder / cell.name).open("a") as file:
                file.write("x")
        time.sleep(self.seconds)
        trouble = dict(self.troubles).get(cell.number)
        if trouble == "raises":
            raise ZeroDivisionError("one by nothing")
        if trouble == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        digest = hashlib.sha256(cell.name.encode()).digest()
        if trouble == "breaks":  # and says so itself, with what it has asked
            return self._lines(cell, "broken", b"\0\0", message="a defect")
        outcome = trouble or ("lifted", "slipped", "no_grasp")[digest[0] % 3]
        return self._lines(cell, outcome, digest)

    def others(self, cell):
        return []

    def broken(self, cell, broken):
        return self._lines(cell, "broken", b"\0\0", message=broken.message)

    def _lines(self, cell, outcome, digest, **changes):
        exchanges = [] if self.cost is None else [make_exchange(cost=self.cost)]
        return Result(
            [
                make_line(
                    cell.number,
                    outcome,
                    complies=bool((digest[1] + task) % 2),
                    exchanges=exchanges,
                    name=cell.name,
                    tasks=cell.tasks,
                    task=f"task {task}",
                    **changes,
                )
                for task in range(cell.tasks)
            ]
        )


def main(folder, workers, seconds):
    """Runs or resumes the benchmark in ``folder``."""
    from tog_drake.benchmark.runner import evaluate

    signal.signal(signal.SIGINT, signal.default_int_handler)  # as tog: it may be ignored above
    work = MadeUpWork(float(seconds))
    with Journal(Path(folder), CONFIG) as journal:
        evaluate(cells(), work, journal, workers=int(workers), console=Console(width=180))


if __name__ == "__main__":
    main(*sys.argv[1:])
