"""Which episodes a run is made of: every method on every trial of a suite, with each seed."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tog_drake.assets.library import asset_names
from tog_drake.benchmark.journal import CellRecord
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.suite import SCENARIO, Suite, Trial
from tog_drake.cameras import with_noise
from tog_drake.errors import InputError
from tog_drake.resources import scenario_files
from tog_drake.scenario import Scenario, load_scenario
from tog_drake.view_options import ViewOptions

CLUTTER = ("Household", "Kitchen", "Tools")
"""The scenarios of several objects; every other one holds a single object."""
SCANNED_CLUTTER = ("Tog29Household", "Tog29Kitchen", "Tog29Tools")
"""The same of imported objects."""
SCANNED = ("Tog29", "Tog29Bottles", "Tog29Toys", *SCANNED_CLUTTER)
"""Scenarios of imported objects."""
SEVERAL_CAMERAS = ("side_cameras", "MugHandleHidden", "BottleFromAbove")
"""Scenarios about views, of objects that have scenarios of their own."""
_NAME = 80  # characters of a cell's name, in which only its number must be unique


@dataclass(frozen=True)
class Cell:
    """One episode to run, and every trial that it is judged for."""

    number: int  # in the order of the run
    method: Method
    seed: int
    trials: tuple[Trial, ...]  # of one object in one scenario; the first is what the robot is told
    noise: bool = False
    text: str | None = None  # YAML over the scenario
    views: ViewOptions = field(default_factory=ViewOptions)  # the cameras, the same for all methods

    @property
    def scenario(self) -> str:
        return self.trials[0].scenario

    @property
    def object(self) -> str:
        """The model instance; "" where the task tells."""
        return self.trials[0].object

    @property
    def task(self) -> str:
        """What the robot is told."""
        return self.trials[0].task

    @property
    def name(self) -> str:
        """What tells it from others, fit for a file's name."""
        words = (self.method.name, Path(self.scenario).stem, self.object, self.seed, self.task)
        told = re.sub(r"[^a-z0-9]+", "-", "-".join(map(str, words)).lower())
        return f"{self.number:05d}-{told[:_NAME].strip('-')}"

    def record(self, trial: Trial) -> CellRecord:
        """Returns what a line of the journal says of the cell, judged for one of its trials."""
        return CellRecord(
            name=self.name,
            number=self.number,
            tasks=len(self.trials),
            method=self.method.name,
            proposer=self.method.proposer,
            k=self.method.k,
            selector=self.method.selector,
            strategy=self.method.strategy,
            vlm=self.method.vlm,
            view=self.method.view,
            scenario=self.scenario,
            object=self.object,
            seed=self.seed,
            task=trial.task,
            category=trial.category,
            beyond=trial.beyond,
        )


def make_cells(
    suite: Suite,
    methods: Sequence[Method],
    seeds: Sequence[int],
    *,
    noise: bool = False,
    text: str | None = None,
    views: ViewOptions | None = None,
) -> list[Cell]:
    """Returns the episodes to run, in a fixed order: method, object, seed, task.

    A method that does not read the task runs once for all tasks on an object.

    Raises:
        InputError: objects of the suite are not imported.
    """
    _check_imported(suite)
    placed: dict[tuple[str, str], list[Trial]] = {}
    for trial in suite.trials:
        placed.setdefault((trial.scenario, trial.object), []).append(trial)
    cells: list[Cell] = []
    for method in methods:
        for trials in placed.values():
            for seed in seeds:
                asked = [trial.at(seed) for trial in trials]
                told = [[trial] for trial in asked] if method.reads_task else [asked]
                for each in told:
                    n = len(cells)
                    cells.append(
                        Cell(n, method, seed, tuple(each), noise, text, views or ViewOptions())
                    )
    return cells


def _check_imported(suite: Suite) -> None:
    wanted = {trial.object for trial in suite.trials if trial.scenario == SCENARIO}
    if missing := wanted - set(asset_names()):
        raise InputError(
            f"the suite {suite.name} needs objects that are not imported: "
            f"{', '.join(sorted(missing))}; `tog assets fetch --suite {suite.name}` or `tog assets "
            "add-dir DIR` brings them in"
        )


def cell_scenario(cell: Cell) -> Scenario:
    """Returns the scenario of a cell, without its method."""
    scenario = load_scenario(cell.scenario, cell.text, seed=cell.seed)
    if cell.scenario == SCENARIO and cell.object:
        scenario.asset = cell.object
    cell.views.apply(scenario)
    if cell.noise:
        scenario.cameras = with_noise(scenario.cameras)
    return scenario


def worlds_of(cells: Iterable[Cell]) -> list[Cell]:
    """Returns one cell of each world that a run needs, whatever the seed."""
    return list({(cell.scenario, cell.object): cell for cell in cells}.values())


def scenario_of(object_: str) -> str:
    """Returns the scenario that holds this object alone, spelled as people do.

    Raises:
        InputError: there is none.
    """
    several = {*CLUTTER, *SCANNED, *SEVERAL_CAMERAS}
    plain = {name.lower(): name for name in scenario_files() if name not in several}
    found = plain.get(object_.replace("_", "").replace(" ", "").lower())
    if found is None:
        raise InputError(f"unknown object {object_!r}; valid: {', '.join(plain)}")
    return found
