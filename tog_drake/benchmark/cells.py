"""Which episodes a suite is made of: every object, seed and task with each selector."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from tog_drake.assets.library import asset_names
from tog_drake.benchmark.suite import SCENARIO, load_suite, suite_files
from tog_drake.benchmark.tables import TASK_BLIND
from tog_drake.cameras import with_noise
from tog_drake.episode import load_objects
from tog_drake.errors import InputError
from tog_drake.object_parts import ObjectParts
from tog_drake.scenario import Scenario, load_scenario, scenario_files

CLUTTER = ("Household", "Kitchen", "Tools")
"""The scenarios of several objects; every other one holds a single object."""
SCANNED_CLUTTER = ("Tog29Household", "Tog29Kitchen", "Tog29Tools")
"""The same of imported objects."""
SCANNED = ("Tog29", "Tog29Bottles", "Tog29Toys", *SCANNED_CLUTTER)
"""Scenarios of imported objects."""

# What is asked of an object, by the kind of task.
TASKS = {
    "use": "use the {object}",
    "handover": "hand me the {object}",
    "part": "pick up the {object} by its {part}",
}


@dataclass(frozen=True)
class Cell:
    """One episode to run, and every task that it is judged for."""

    scenario: str
    object: str  # model instance
    selector: str
    seed: int
    tasks: tuple[str, ...]  # the first is what the robot is told
    noise: bool
    text: str | None  # YAML over the scenario
    asset: bool = False  # whether the object takes the place of that of the scenario

    @property
    def name(self) -> str:
        """What tells it from others, fit for a file's name."""
        scenario = Path(self.scenario).stem
        words = [self.selector, scenario, self.object, str(self.seed), *self.tasks[0].split()]
        return "-".join(words).lower()


def scenario_names(names: Iterable[str]) -> list[str]:
    """Returns scenarios by name; `objects`, `clutter`, `clutter-scans` stand for all of a kind."""
    groups = {
        "objects": [name for name in scenario_files() if name not in CLUTTER + SCANNED],
        "clutter": list(CLUTTER),
        "clutter-scans": list(SCANNED_CLUTTER),
    }
    return [scenario for name in names for scenario in groups.get(name, [name])]


def scenario_of(object_: str) -> str:
    """Returns the scenario that holds this object alone, spelled as people do.

    Raises:
        InputError: there is none.
    """
    plain = {name.lower(): name for name in scenario_names(["objects"])}
    found = plain.get(object_.replace("_", "").replace(" ", "").lower())
    if found is None:
        raise InputError(f"unknown object {object_!r}; valid: {', '.join(plain)}")
    return found


def make_cells(
    scenarios: Sequence[str],
    selectors: Sequence[str],
    seeds: Sequence[int],
    *,
    tasks: Sequence[str],
    noise: bool = False,
    text: str | None = None,
) -> list[Cell]:
    """Returns the episodes to run, in a fixed order.

    Every labelled object of a scenario is asked for, as each seed puts it down. A task of the
    kind "part" names the parts in turn, by the seed.

    Raises:
        InputError: if a scenario or a kind of task is unknown, or a scenario has no object.
    """
    unknown = [kind for kind in tasks if kind not in TASKS]
    if unknown:
        raise InputError(f"unknown kind of task {unknown[0]!r}; valid: {', '.join(TASKS)}")
    cells = []
    for scenario in scenarios:
        if scenario in suite_files():
            cells += _suite_cells(scenario, selectors, seeds, noise, text)
            continue
        objects = load_objects(load_scenario(scenario, text))
        if not objects:
            raise InputError(f"scenario {scenario} holds no labelled object")
        for selector in selectors:
            for name, labels in objects.items():
                for seed in seeds:
                    said = tuple(_tasks(labels, tasks, seed))
                    cells += [
                        Cell(scenario, name, selector, seed, told, noise, text)
                        for told in _told(selector, said)
                    ]
    return cells


def _suite_cells(
    suite: str, selectors: Sequence[str], seeds: Sequence[int], noise: bool, text: str | None
) -> list[Cell]:
    trials = load_suite(suite_files()[suite])
    missing = {trial.object for trial in trials} - set(asset_names())
    if missing:
        raise InputError(
            f"the suite {suite} needs objects that are not imported: {', '.join(sorted(missing))}; "
            f"`tog assets fetch --suite {suite}` or `tog assets add-dir DIR` brings them in"
        )
    said: dict[tuple[str, str], list[str]] = {}
    for trial in trials:
        said.setdefault((trial.scenario, trial.object), []).append(trial.task)
    return [
        Cell(scenario, name, selector, seed, told, noise, text, asset=scenario == SCENARIO)
        for selector in selectors
        for (scenario, name), tasks in said.items()
        for seed in seeds
        for told in _told(selector, tasks)
    ]


def _told(selector: str, said: Sequence[str]) -> list[tuple[str, ...]]:
    """The tasks of each episode: all in one, where the selector does not read them."""
    return [tuple(said)] if selector in TASK_BLIND and said else [(task,) for task in said]


def _tasks(labels: ObjectParts, kinds: Sequence[str], seed: int) -> Iterator[str]:
    name = labels.object.replace("_", " ")
    parts = list(labels.part_words)
    part = parts[seed % len(parts)].replace("_", " ")
    for kind in kinds:
        if kind == "part" or labels.tasks.get(kind):
            yield TASKS[kind].format(object=name, part=part)


def cell_scenario(cell: Cell) -> Scenario:
    """Returns the scenario of a cell, but for the selector, which the caller puts in."""
    scenario = load_scenario(cell.scenario, cell.text, seed=cell.seed)
    if cell.asset:
        scenario.asset = cell.object
    if cell.noise:
        scenario.cameras = with_noise(scenario.cameras)
    return scenario
