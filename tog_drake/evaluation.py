"""Many episodes: every object, seed and task with each selector."""

import json
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

from tog_drake.assets.library import asset_names
from tog_drake.cameras import with_noise
from tog_drake.drawing import decision_image, encode_png
from tog_drake.episode import Episode, load_objects, run_episode
from tog_drake.errors import InputError, TogError
from tog_drake.files import write_atomically
from tog_drake.judge import complies
from tog_drake.object_parts import ObjectParts
from tog_drake.options import SelectorOptions
from tog_drake.record import EpisodeRecord
from tog_drake.scenario import Scenario, load_scenario, scenario_files
from tog_drake.suite import SCENARIO, load_suite, suite_files
from tog_drake.summary import TASK_BLIND
from tog_drake.terminal import keep_drake_quiet

CLUTTER = ("Household", "Kitchen", "Tools")
"""The scenarios of several objects; every other one holds a single object."""
SCANNED = ("Tog29", "Tog29Bottles", "Tog29Toys")
"""Scenarios of imported objects."""

# What is asked of an object, by the kind of task.
TASKS = {
    "use": "use the {object}",
    "handover": "hand me the {object}",
    "part": "pick up the {object} by its {part}",
}
DEFAULT = SelectorOptions()

Job = TypeVar("Job")
T = TypeVar("T")
_BATCH = 20  # episodes between two renewals of the workers


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
    """Returns scenarios by name; `objects` and `clutter` stand for all of that kind."""
    groups = {
        "objects": [name for name in scenario_files() if name not in CLUTTER + SCANNED],
        "clutter": list(CLUTTER),
    }
    return [scenario for name in names for scenario in groups.get(name, [name])]


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


def evaluate(
    cells: Sequence[Cell],
    *,
    workers: int,
    out: Path,
    console: Console,
    options: SelectorOptions = DEFAULT,
) -> list[EpisodeRecord]:
    """Runs the episodes in ``workers`` processes; the records come in the order of the cells.

    Every finished episode is a line of ``out/episodes.jsonl`` at once, and one that failed leaves
    a picture of what was seen and chosen in ``out/failures``; pictures of an earlier run go away.

    Args:
        cells: the episodes.
        workers: processes.
        out: folder.
        console: for the progress.
        options: how a model is asked; they hold for the cells of the selector "vlm".

    Raises:
        InputError: a model cannot be asked so; nothing has been run then.
        TogError: if an episode cannot be run at all, naming it, or the server does not take the
            questions (a wrong key, a wrong model): every further episode would end likewise.
    """
    for cell in {(cell.scenario, cell.selector): cell for cell in cells}.values():
        _configured(cell, options)
    records: list[EpisodeRecord] = []
    out.mkdir(parents=True, exist_ok=True)
    for picture in (out / "failures").glob("*.png"):
        picture.unlink()
    with (
        (out / "episodes.jsonl").open("w", encoding="utf-8") as file,
        Progress(console=console) as progress,
        closing(in_processes(partial(_run, out=out, options=options), cells, workers)) as results,
    ):
        bar = progress.add_task("episodes", total=len(cells))
        for judged in results:
            records += judged
            file.write("".join(json.dumps(record) + "\n" for record in judged))
            file.flush()
            _check_taken(judged[0])
            progress.advance(bar)
    return records


def _check_taken(record: EpisodeRecord) -> None:
    """Raises TogError where the server did not take a question."""
    vlm = record["vlm"]
    if vlm is not None and vlm["status"] == "rejected":
        said = [record["message"] or "", *(e["message"] for e in vlm["exchanges"])]
        raise TogError(
            f"{record['scenario']}, seed {record['seed']}: {vlm['model']} does not take the "
            f"question, so the rest is not run: {said[-1]}"
        )


def in_processes(
    work: Callable[[Job], T], jobs: Sequence[Job], workers: int
) -> Generator[T, None, None]:
    """Returns what ``work`` makes of each job, in their order.

    Raises:
        TogError: a process died; and whatever ``work`` raises.
    """
    for start in range(0, len(jobs), _BATCH):
        yield from _run_batch(work, jobs[start : start + _BATCH], workers)


def _run_batch(
    work: Callable[[Job], T], jobs: Sequence[Job], workers: int
) -> Generator[T, None, None]:
    """Works in new processes: a diagram's memory is not all given back."""
    context = get_context("forkserver")
    with ProcessPoolExecutor(workers, context, initializer=keep_drake_quiet) as pool:
        try:
            yield from pool.map(work, jobs)
        except BrokenProcessPool as error:
            raise TogError(
                "a worker process died, perhaps for want of memory; try fewer --workers"
            ) from error
        except BaseException:  # Ctrl-C too: else the pool would wait for episodes under way
            for process in active_children():
                process.terminate()
            raise


def cell_scenario(cell: Cell) -> Scenario:
    """Returns the scenario of a cell, but for the selector, which the caller puts in."""
    scenario = load_scenario(cell.scenario, cell.text, seed=cell.seed)
    if cell.asset:
        scenario.asset = cell.object
    if cell.noise:
        scenario.cameras = with_noise(scenario.cameras)
    return scenario


def _configured(cell: Cell, options: SelectorOptions) -> Scenario:
    """Returns the scenario of a cell with its selector; what the scenario says of it stays."""
    scenario = cell_scenario(cell)
    of_cell = options if cell.selector == "vlm" else DEFAULT
    replace(of_cell, selector=cell.selector).apply(scenario.pipeline)
    return scenario


def _run(cell: Cell, out: Path, options: SelectorOptions) -> list[EpisodeRecord]:
    try:
        scenario = _configured(cell, options)
        episode = run_episode(scenario, name=cell.scenario, task=cell.tasks[0], target=cell.object)
    except InputError as error:
        raise InputError(f"{cell.name}: {error}") from error
    if not episode.record["grasp_success"]:
        _save_picture(out / "failures" / f"{cell.name}.png", episode)
    labels = load_objects(scenario)[cell.object]
    return [_judged_for(task, episode.record, labels) for task in cell.tasks]


def _save_picture(path: Path, episode: Episode) -> None:
    decision = episode.decision
    if decision.view is not None:
        image = decision_image(decision.view, decision.candidates, decision.choice)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, encode_png(image))


def _judged_for(task: str, record: EpisodeRecord, labels: ObjectParts) -> EpisodeRecord:
    """The record of the same episode, had the robot been told another task: it reads none."""
    if task == record["task"]:
        return record
    allowed = labels.allowed(task)
    judged = record.copy()
    judged["task"] = task
    judged["allowed"] = None if allowed is None else sorted(allowed)
    judged["task_compliance"] = complies(record["held"], allowed)
    judged["combined_success"] = (
        None if allowed is None else record["grasp_success"] and judged["task_compliance"]
    )
    return judged
