"""One cell, run: the lines that the journal gets of it, and the files that show what happened."""

import gzip
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.benchmark.cells import Cell, cell_scenario
from tog_drake.benchmark.human_labels import PICTURE
from tog_drake.benchmark.identity import digests, others
from tog_drake.benchmark.journal import JudgeRecord, Line, Result
from tog_drake.benchmark.judging import grasp_pictures, vlm_judge
from tog_drake.benchmark.processes import Broken, broken_by
from tog_drake.benchmark.suite import Trial
from tog_drake.decision import Decision
from tog_drake.drawing import decision_image, encode_jpg, encode_png
from tog_drake.episode import Episode, enter_compliance, run_episode
from tog_drake.errors import InputError
from tog_drake.object_parts import ObjectParts
from tog_drake.options import SelectorOptions
from tog_drake.pipeline import used_cameras
from tog_drake.record import EpisodeRecord, new_record
from tog_drake.scenario import Scenario
from tog_drake.selectors.vlm.dialogue import all_exchanges
from tog_drake.sharing import SharedWork, program_digest
from tog_drake.values import Exchange
from tog_drake.visualization import make_meshcat
from tog_drake.vlm_record import exchange_records, exchanges_of
from tog_drake.world import load_objects


@dataclass(frozen=True)
class EpisodeWork:
    """How the cells of a run are run."""

    shared: Path  # folder of what episodes share, on the machine that runs them
    options: SelectorOptions = field(default_factory=SelectorOptions)  # how a model is asked
    checkpoint: Path | None = None  # weights, for the proposers that have any
    judge: str | None = None  # a model that judges besides, such as "vlm:gemini:NAME"
    replays: bool = False  # whether each is recorded, to be played in a browser
    program: str = field(default_factory=program_digest)  # found out once, where the run begins
    asked: Mapping[str, Any] = field(default_factory=dict)  # the content of run.json

    def configured(self, cell: Cell) -> Scenario:
        """Returns the scenario of a cell with its method.

        Raises:
            InputError: it cannot be run so.
        """
        scenario = cell_scenario(cell)
        cell.method.apply(scenario.pipeline, self.options, self.checkpoint)
        used_cameras(scenario.pipeline, scenario.cameras)
        return scenario

    def others(self, cell: Cell) -> list[str]:
        """Says what of the program and of a cell's files is other here than where the run began.

        Raises:
            InputError: the cell cannot be run here.
        """
        if program_digest() != self.program:
            return ["program"]
        return others(self.asked, digests([cell], self.configured))

    def __call__(self, cell: Cell) -> Result:
        """Runs a cell; what it asked before it broke is in the record, for it has its price.

        Raises InputError with the cell's name.
        """
        with all_exchanges() as exchanges:
            try:
                return self._run(cell)
            except InputError as error:
                raise InputError(f"{cell.name}: {error}") from error
            except (Exception, SystemExit) as error:  # by the latter Drake ends, or what it calls
                return self.broken(cell, broken_by(error), exchanges)

    def _run(self, cell: Cell) -> Result:
        scenario = self.configured(cell)
        labels = load_objects(scenario)[cell.object]
        episode = run_episode(
            scenario,
            name=cell.scenario,
            task=cell.task,
            target=cell.object,
            meshcat=make_meshcat() if self.replays else None,
            shared=SharedWork(self.shared, self.program),
        )
        lines = [
            Line(
                cell=cell.record(trial),
                record=_judged_for(trial.task, episode.record, labels),
                judge=self._judged(episode.decision, trial),
            )
            for trial in cell.trials
        ]
        return Result(lines, files_of(episode))

    def _judged(self, decision: Decision, trial: Trial) -> JudgeRecord | None:
        return None if self.judge is None else vlm_judge(self.judge).judge(decision, trial.task)

    def broken(self, cell: Cell, broken: Broken, exchanges: Sequence[Exchange] = ()) -> Result:
        """Returns the lines of a cell in which the program itself failed, and why.

        ``exchanges`` are those with models before, as far as they are known.
        """
        scenario = self.configured(cell)
        labels = load_objects(scenario)[cell.object]
        record = new_record(Decision(), scenario.pipeline, task=cell.task, seed=cell.seed)
        record["scenario"], record["object"] = cell.scenario, cell.object
        record["outcome"], record["message"] = "broken", broken.message
        record["attempts"][0]["exchanges"] = exchange_records(exchanges)
        record["grasp_success"] = record["strict_success"] = False
        record["noise"] = cell.noise
        lines = [
            Line(cell=cell.record(t), record=_judged_for(t.task, record, labels), judge=None)
            for t in cell.trials
        ]
        return Result(lines, {"traceback.txt": broken.traceback.encode()})


def _judged_for(task: str, record: EpisodeRecord, labels: ObjectParts) -> EpisodeRecord:
    """The record of the same episode, had the robot been told another task: it reads none."""
    judged = record.copy()
    judged["task"] = task
    enter_compliance(judged, labels.allowed(task))
    return judged


def files_of(episode: Episode) -> dict[str, bytes]:
    """Returns what shows an episode, by the names of the files.

    ``view.jpg`` is what was seen and decided, ``grasp.jpg`` the hand that was chosen, alone, as
    people and models judge it. ``sent-N.png`` are the images that a model was shown
    at the last look, ``grasps.npz`` has the feasible grasps (arrays as of ``Grasps``; the rows
    ``candidates`` (K,); the row ``chosen``, −1: none), ``replay.html.gz`` plays the episode.
    """
    decision, files = episode.decision, {}
    if decision.shown is not None:
        image = decision_image(decision.shown, decision.candidates, decision.choice)
        files["view.jpg"] = encode_jpg(image)
    if (pictures := grasp_pictures(decision)) is not None:
        files[PICTURE] = encode_jpg(pictures[1])
    sent = [image for exchange in exchanges_of(decision) for image in exchange.images]
    for number, image in enumerate(sent, 1):
        files[f"sent-{number}.png"] = encode_png(image, compression=6)
    if decision.feasible_grasps is not None:
        files["grasps.npz"] = _grasps(decision)
    if episode.replay is not None:
        files["replay.html.gz"] = gzip.compress(episode.replay.encode(), mtime=0)
    return files


def _grasps(decision: Decision) -> bytes:
    grasps, candidates, choice = decision.feasible_grasps, decision.candidates, decision.choice
    assert grasps is not None
    data = io.BytesIO()
    np.savez_compressed(
        data,
        X_WG=grasps.X_WG,
        width=grasps.width,
        score=grasps.score,
        p_WContact=grasps.p_WContact,
        candidates=np.zeros(0, np.int64) if candidates is None else candidates.index,
        chosen=-1 if choice is None else choice.index,
    )
    return data.getvalue()
