"""Selectors that do not read the task: what any other selector has to beat."""

from dataclasses import dataclass

import numpy as np
from pydrake.perception import PointCloud

from tog_drake.errors import NoChoice
from tog_drake.selector import choose
from tog_drake.task import read_task
from tog_drake.values import Candidates, Choice, View


@dataclass
class TopScore:
    """Picks the grasp of highest confidence, whatever the task says."""


@dataclass
class Random:
    """Picks one of the K candidates at random, whatever the task says."""


class TopScoreSelector:
    """The baseline without a task; of equal scores the first in the list."""

    def select(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Choice:
        _check(candidates, task)
        index = int(np.argmax(candidates.grasps.score))
        score = candidates.grasps.score[index]
        reason = (
            f"Highest confidence, {score:.2f}, of {len(candidates.grasps)} feasible grasps; "
            "the task is not read."
        )
        return choose(index, view, candidates, reason)


class RandomSelector:
    """Draws anew from ``seed`` in every call: the same inputs give the same choice."""

    def __init__(self, *, seed: int):
        self._seed = seed

    def select(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Choice:
        _check(candidates, task)
        drawn = int(np.random.default_rng(self._seed).integers(len(candidates)))
        reason = (
            f"Candidate {drawn + 1} of {len(candidates)}, drawn at random; the task is not read."
        )
        return choose(int(candidates.index[drawn]), view, candidates, reason)


def _check(candidates: Candidates, task: str) -> None:
    read_task(task)  # an empty task is an error for every selector alike
    if len(candidates) == 0:
        raise NoChoice("There is no candidate to choose from; move the object nearer.")
