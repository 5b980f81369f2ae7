"""Many episodes: every object, seed and task with each selector, and the table of successes."""

import json
from collections import Counter
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

from tog_drake.cameras import with_noise
from tog_drake.compliance import ObjectParts
from tog_drake.drawing import decision_image, encode_png
from tog_drake.episode import Episode, load_objects, run_episode
from tog_drake.errors import InputError, TogError
from tog_drake.files import write_atomically
from tog_drake.judge import complies
from tog_drake.options import SelectorOptions
from tog_drake.record import EpisodeRecord, selector_name
from tog_drake.scenario import Scenario, load_scenario, scenario_files
from tog_drake.terminal import keep_drake_quiet

CLUTTER = ("Household", "Kitchen", "Tools")
"""The scenarios of several objects; every other one holds a single object."""

# What is asked of an object, by the kind of task.
TASKS = {
    "use": "use the {object}",
    "handover": "hand me the {object}",
    "part": "pick up the {object} by its {part}",
}
# They do not read the task: one episode serves every task, and is judged for each.
_TASK_BLIND = ("top-score", "random")

DEFAULT = SelectorOptions()

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

    @property
    def name(self) -> str:
        """What tells it from others, fit for a file's name."""
        scenario = Path(self.scenario).stem
        words = [self.selector, scenario, self.object, str(self.seed), *self.tasks[0].split()]
        return "-".join(words).lower()


def scenario_names(names: Iterable[str]) -> list[str]:
    """Returns scenarios by name; `objects` and `clutter` stand for all of that kind."""
    groups = {
        "objects": [name for name in scenario_files() if name not in CLUTTER],
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
        objects = load_objects(load_scenario(scenario, text))
        if not objects:
            raise InputError(f"scenario {scenario} holds no labelled object")
        for selector in selectors:
            for name, labels in objects.items():
                for seed in seeds:
                    said = tuple(_tasks(labels, tasks, seed))
                    told = [said] if selector in _TASK_BLIND else [(task,) for task in said]
                    cells += [
                        Cell(scenario, name, selector, seed, t, noise, text) for t in told if t
                    ]
    return cells


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
    work: Callable[[Cell], T], cells: Sequence[Cell], workers: int
) -> Generator[T, None, None]:
    """Returns what ``work`` makes of each cell, in their order.

    Raises:
        TogError: a process died; and whatever ``work`` raises.
    """
    for start in range(0, len(cells), _BATCH):
        yield from _run_batch(work, cells[start : start + _BATCH], workers)


def _run_batch(
    work: Callable[[Cell], T], cells: Sequence[Cell], workers: int
) -> Generator[T, None, None]:
    """Works in new processes: a diagram's memory is not all given back."""
    context = get_context("forkserver")
    with ProcessPoolExecutor(workers, context, initializer=keep_drake_quiet) as pool:
        try:
            yield from pool.map(work, cells)
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
    scenario = load_scenario(cell.scenario, cell.text)
    scenario.random_seed = cell.seed
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


def summarize(records: Sequence[EpisodeRecord]) -> list[dict[str, str | int | float]]:
    """Returns success rates by selector and scenario, and a row "all" for each selector.

    ``grasp`` and ``strict`` (turned by no more than 10° in the hand) are shares of the ``n``
    episodes that were run, ``task`` and ``both`` of the ``tasks`` that they were judged for: as
    many, but for a selector that does not read the task. An episode that ended early counts as a
    failure of each. ``_low`` and ``_high`` bound them with 95 % confidence (Wilson 1927).
    """
    rows: list[dict[str, str | int | float]] = []
    selectors = dict.fromkeys(map(selector_name, records))
    scenarios = dict.fromkeys(record["scenario"] for record in records)
    for selector in selectors:
        of_selector = [r for r in records if selector_name(r) == selector]
        for scenario in (*scenarios, None):
            chosen = [r for r in of_selector if scenario in (None, r["scenario"])]
            if chosen:
                rows.append(_row(selector, scenario or "all", chosen))
    return rows


def _row(
    selector: str, scenario: str, records: Sequence[EpisodeRecord]
) -> dict[str, str | int | float]:
    runs = list(records)
    if selector in _TASK_BLIND:  # one run, however many tasks it is judged for
        runs = list({(r["scenario"], r["object"], r["seed"]): r for r in records}.values())
    row: dict[str, str | int | float] = {
        "selector": selector,
        "scenario": scenario,
        "n": len(runs),
        "tasks": len(records),
    }
    successes = {
        "grasp": [r["grasp_success"] for r in runs],
        "strict": [r["strict_success"] for r in runs],
        "task": [r["task_compliance"] for r in records],
        "both": [r["combined_success"] for r in records],
    }
    for name, values in successes.items():
        count = sum(map(bool, values))
        row[name] = count / len(values)
        row[f"{name}_low"], row[f"{name}_high"] = wilson(count, len(values))
    row["collisions"] = sum(bool(r["collisions"]) for r in runs)
    row["failures"] = _failures(runs)
    return row


def _failures(records: Sequence[EpisodeRecord]) -> str:
    """Returns such as "1 slipped, 6 no_choice (unreachable 5, refused 1), by fallback 2 (empty 2)".

    In brackets is what became of the questions to a model. What the fallback chose is not the
    model's merit, whatever came of it.
    """
    outcomes = Counter(r["outcome"] for r in records if r["outcome"] != "lifted")
    said = [
        f"{n} {outcome}" + _statuses([r for r in records if r["outcome"] == outcome == "no_choice"])
        for outcome, n in outcomes.items()
    ]
    replaced = [r for r in records if r["vlm"] is not None and r["vlm"]["fallback"]]
    if replaced:
        said.append(f"by fallback {len(replaced)}" + _statuses(replaced))
    return ", ".join(said)


def _statuses(records: Sequence[EpisodeRecord]) -> str:
    counts = Counter(r["vlm"]["status"] for r in records if r["vlm"] and r["vlm"]["status"])
    told = ", ".join(f"{status} {n}" for status, n in counts.most_common())
    return f" ({told})" if told else ""


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Returns the 95 % confidence interval of a rate (Wilson 1927)."""
    from scipy.stats import binomtest  # slow to import

    interval = binomtest(successes, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)
