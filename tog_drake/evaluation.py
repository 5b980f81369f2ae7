"""Many episodes: every object, seed and task with each selector, and the table of successes."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import active_children, get_context

from rich.console import Console
from rich.progress import Progress

from tog_drake.episode import load_objects, run_episode
from tog_drake.errors import InputError, TogError
from tog_drake.pipeline import SELECTORS
from tog_drake.record import EpisodeRecord
from tog_drake.scenario import load_scenario
from tog_drake.terminal import keep_drake_quiet

# What is asked for each intent that an object is labelled for; {} is what the object is.
_TASKS = {"use": "use the {}", "handover": "hand me the {}"}

_BATCH = 20  # episodes between two renewals of the workers


@dataclass(frozen=True)
class _Cell:
    """One episode to run."""

    scenario: str
    task: str
    selector: str
    seed: int


def evaluate(
    scenarios: Sequence[str],
    selectors: Sequence[str],
    seeds: Sequence[int],
    *,
    workers: int,
    console: Console,
) -> list[EpisodeRecord]:
    """Runs all episodes in ``workers`` processes; the records come in a fixed order.

    Each object is put down as each seed says, and asked for by each intent of its labels.

    Raises:
        InputError: if a scenario is unknown, or has not one object.
    """
    cells = [
        _Cell(scenario, task, selector, seed)
        for selector in selectors
        for scenario in scenarios
        for task in _tasks(scenario)
        for seed in seeds
    ]
    records: list[EpisodeRecord] = []
    with Progress(console=console) as progress:
        bar = progress.add_task("episodes", total=len(cells))
        for start in range(0, len(cells), _BATCH):
            for record in _run_batch(cells[start : start + _BATCH], workers):
                records.append(record)
                progress.advance(bar)
    return records


def _run_batch(cells: list[_Cell], workers: int) -> Iterator[EpisodeRecord]:
    """Runs some episodes in new processes: a diagram's memory is not all given back."""
    context = get_context("forkserver")
    with ProcessPoolExecutor(workers, context, initializer=keep_drake_quiet) as pool:
        try:
            yield from pool.map(_run, cells)
        except BrokenProcessPool as error:
            raise TogError(
                "a worker process died, perhaps for want of memory; try fewer --workers"
            ) from error
        except BaseException:  # Ctrl-C too: else the pool would wait for episodes under way
            for process in active_children():
                process.terminate()
            raise


def _tasks(scenario: str) -> list[str]:
    objects = load_objects(load_scenario(scenario))
    if len(objects) != 1:
        raise InputError(
            f"scenario {scenario} holds {len(objects)} labelled objects "
            f"({', '.join(objects) or 'none'}); only scenarios of one object can be compared"
        )
    (labels,) = objects.values()
    name = labels.object.replace("_", " ")
    return [text.format(name) for intent, text in _TASKS.items() if labels.tasks.get(intent)]


def _run(cell: _Cell) -> EpisodeRecord:
    scenario = load_scenario(cell.scenario)
    scenario.random_seed = cell.seed
    scenario.pipeline.selector = SELECTORS[cell.selector]()
    return run_episode(scenario, name=cell.scenario, task=cell.task).record


def summarize(records: Sequence[EpisodeRecord]) -> list[dict[str, str | int | float]]:
    """Returns success rates by selector and scenario, and a row "all" for each selector.

    ``grasp``, ``task`` and ``both`` are shares of all episodes; an episode that ended early
    counts as a failure of each.
    """
    rows: list[dict[str, str | int | float]] = []
    selectors = dict.fromkeys(record["selector"]["kind"] for record in records)
    scenarios = dict.fromkeys(record["scenario"] for record in records)
    for selector in selectors:
        of_selector = [r for r in records if r["selector"]["kind"] == selector]
        for scenario in (*scenarios, None):
            chosen = [r for r in of_selector if scenario in (None, r["scenario"])]
            if not chosen:
                continue
            failures: dict[str, int] = {}
            for outcome in (r["outcome"] for r in chosen if r["outcome"] != "lifted"):
                failures[outcome] = failures.get(outcome, 0) + 1
            rows.append(
                {
                    "selector": selector,
                    "scenario": scenario or "all",
                    "n": len(chosen),
                    "grasp": sum(bool(r["grasp_success"]) for r in chosen) / len(chosen),
                    "task": sum(bool(r["task_compliance"]) for r in chosen) / len(chosen),
                    "both": sum(bool(r["combined_success"]) for r in chosen) / len(chosen),
                    "failures": ", ".join(f"{n} {outcome}" for outcome, n in failures.items()),
                }
            )
    return rows
