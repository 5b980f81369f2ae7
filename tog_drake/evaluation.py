"""Many episodes, run and judged."""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tog_drake.benchmark.cells import Cell, cell_scenario
from tog_drake.benchmark.processes import in_processes
from tog_drake.drawing import decision_image, encode_png
from tog_drake.episode import Episode, load_objects, run_episode
from tog_drake.errors import InputError, NoProposal, TogError
from tog_drake.files import write_atomically
from tog_drake.judge import complies
from tog_drake.object_parts import ObjectParts
from tog_drake.options import ProposerOptions, SelectorOptions
from tog_drake.record import EpisodeRecord
from tog_drake.scenario import Scenario

DEFAULT = SelectorOptions()
OF_SCENARIO = ProposerOptions()


class Stopped(TogError):
    """The rest is not run; ``records`` are of the episodes before the one that told why."""

    def __init__(self, message: str, records: Sequence[EpisodeRecord]):
        super().__init__(message)
        self.records = records


def evaluate(
    cells: Sequence[Cell],
    *,
    workers: int,
    out: Path,
    console: Console,
    options: SelectorOptions = DEFAULT,
    proposer: ProposerOptions = OF_SCENARIO,
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
        proposer: who proposes grasps, in all cells.

    Raises:
        InputError: a model cannot be asked so; nothing has been run then.
        TogError: if an episode cannot be run at all, naming it.
        Stopped: the server does not take the questions (a wrong key, a wrong model): every further
            episode would end likewise. Or the server that proposes grasps gave none that can be
            used: that tells of no method.
    """
    for cell in {(cell.scenario, cell.selector): cell for cell in cells}.values():
        _configured(cell, options, proposer)
    records: list[EpisodeRecord] = []
    out.mkdir(parents=True, exist_ok=True)
    for picture in (out / "failures").glob("*.png"):
        picture.unlink()
    run = partial(_run, out=out, options=options, proposer=proposer)
    with (
        (out / "episodes.jsonl").open("w", encoding="utf-8") as file,
        Progress(console=console) as progress,
        closing(in_processes(run, cells, workers)) as results,
    ):
        bar = progress.add_task("episodes", total=len(cells))
        for judged in results:
            file.write("".join(json.dumps(record) + "\n" for record in judged))
            file.flush()
            _check_taken(judged[0], records)
            records += judged
            progress.advance(bar)
    return records


def _check_taken(record: EpisodeRecord, before: Sequence[EpisodeRecord]) -> None:
    """Raises Stopped where a server did not take a question, or proposed nothing of use."""
    if record["outcome"] == NoProposal.outcome:
        raise Stopped(
            f"{record['scenario']}, seed {record['seed']}: the rest is not run: "
            f"{record['message']}",
            before,
        )
    vlm = record["vlm"]
    if vlm is not None and vlm["status"] == "rejected":
        said = [record["message"] or "", *(e["message"] for e in vlm["exchanges"])]
        raise Stopped(
            f"{record['scenario']}, seed {record['seed']}: {vlm['model']} does not take the "
            f"question, so the rest is not run: {said[-1]}",
            before,
        )


def _configured(cell: Cell, options: SelectorOptions, proposer: ProposerOptions) -> Scenario:
    """Returns the scenario of a cell with selector and proposer; what it says of them stays."""
    scenario = cell_scenario(cell)
    of_cell = options if cell.selector == "vlm" else DEFAULT
    replace(of_cell, selector=cell.selector).apply(scenario.pipeline)
    proposer.apply(scenario.pipeline)
    return scenario


def _run(
    cell: Cell, out: Path, options: SelectorOptions, proposer: ProposerOptions
) -> list[EpisodeRecord]:
    try:
        scenario = _configured(cell, options, proposer)
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
