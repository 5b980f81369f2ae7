"""The oracle: reads the simulated part labels. An upper bound, not a method.

What it reaches is what a perfect selector could reach with the same grasps. It cannot run on a
real robot, where nobody hands out the labels.
"""

from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import QueryObject
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.compliance import PartLabels
from tog_drake.errors import NoChoice, NoGrasp
from tog_drake.labelled_surface import Shares
from tog_drake.selector import choose
from tog_drake.values import (
    Array,
    Candidates,
    Choice,
    FeasibleGrasps,
    Grasps,
    SelectedView,
    View,
)

ORACLE_NOTE = "reads simulated part labels: an upper bound, not a method"
_SURE = 0.99  # share of the closing region on allowed parts from which the score decides ...
_ENOUGH = 0.8  # ... and the least share that is taken; where none is sure, the greatest
_SLIDE = 0.006  # [m] that pads may slide on a scanned object
_MOSTLY = 0.5  # share of the closing region from which a grasp is one of the target
_SEEN = 0.004  # [m] a point of the cloud belongs to the object that is not farther than this


@dataclass
class Oracle:
    """Picks the best grasp on a part that the task allows, by simulated ground truth."""


class OracleSelector(LeafSystem):
    """Stands where GraspSelector stands, and reads the ground truth.

    It reads the proposals too, to say why there is nothing to choose.

    .. pydrake_system::

        name: OracleSelector
        input_ports:
        - selected_view
        - cloud
        - grasps
        - candidates
        - task
        - cheat.query_object
        output_ports:
        - choice
    """

    def __init__(self, labels: PartLabels, target: str):
        super().__init__()
        self._labels = labels
        self._target = target
        self._view = self.DeclareAbstractInputPort("selected_view", Value(SelectedView.none()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._grasps = self.DeclareAbstractInputPort("grasps", Value(Grasps.empty()))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._task = self.DeclareAbstractInputPort("task", Value(""))
        self._truth = self.DeclareAbstractInputPort("cheat.query_object", Value(QueryObject()))
        ports = (
            self._view, self._cloud, self._grasps, self._candidates, self._task, self._truth
        )  # fmt: skip
        self.DeclareAbstractOutputPort(
            "choice",
            alloc=lambda: Value(Choice.none()),
            calc=self._CalcChoice,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcChoice(self, context: Context, output: Value) -> None:
        output.set_value(
            choose_by_labels(
                self._labels,
                self._target,
                self._view.Eval(context).view,
                self._cloud.Eval(context),
                self._grasps.Eval(context),
                self._candidates.Eval(context),
                self._task.Eval(context),
                self._truth.Eval(context),
            )
        )


def choose_by_labels(
    labels: PartLabels,
    target: str,
    view: View,
    cloud: PointCloud,
    proposed: Grasps,
    candidates: Candidates,
    task: str,
    query_object: QueryObject,
) -> Choice:
    """Returns the best grasp whose closing region lies on an allowed part of ``target``.

    Raises:
        NoGrasp: if no feasible grasp is on the target, saying how much of it is seen and proposed.
        NoChoice: if the task says to leave things alone, or no grasp lies on an allowed part.
    """
    grasps = candidates.grasps
    regions = labels.closing_region(grasps, query_object)
    if not _on(target, regions).any():
        raise NoGrasp(_why_none(labels, target, cloud, proposed, grasps, query_object))
    allowed = labels.objects[target].allowed(task)
    if allowed is None:  # the task does not say, so any part will do
        allowed = frozenset(labels.objects[target].part_words)
    if not allowed:
        raise NoChoice(
            f"oracle: the task {task!r} allows no labelled part of {target}; its parts are "
            f"{', '.join(labels.objects[target].part_words)}"
        )
    share = _share(regions, {(target, part) for part in allowed})
    fits = share >= _ENOUGH
    if not fits.any():
        raise NoChoice(
            f"oracle: none of {len(grasps)} feasible grasps closes on "
            f"{' or '.join(sorted(allowed))} of {target}"
        )
    # One that is sure beats one that is not; of the sure ones the best score does. Surest is one
    # whose surroundings are allowed, too: on a slope the pads slide before they hold.
    around = _share(
        labels.closing_region(grasps, query_object, beside=_SLIDE),
        {(target, part) for part in allowed},
    )
    worth = np.where(share > _SURE, 1.0 + grasps.score, share)
    worth += around > _SURE
    worth = np.where(fits, worth, -np.inf)
    index = int(np.argmax(worth))
    reason = (
        f"Oracle, reading simulated labels: best of {fits.sum()} grasps on "
        f"{' or '.join(sorted(allowed))}."
    )
    part = max(regions[index].items(), key=lambda item: item[1])[0][1]
    return choose(index, view, candidates, reason, part=part, worth=worth)


def _share(regions: list[Shares], parts: Set[tuple[str, str]]) -> Array:
    """The share of each closing region that lies on ``parts``, (N,)."""
    return np.array([sum(share for part, share in r.items() if part in parts) for r in regions])


def _on(target: str, regions: list[Shares]) -> NDArray[np.bool_]:
    """Which closing regions lie mostly on the target, (N,)."""
    parts = {part for region in regions for part in region if part[0] == target}
    return np.asarray(_share(regions, parts) > _MOSTLY)


def _why_none(
    labels: PartLabels,
    target: str,
    cloud: PointCloud,
    proposed: Grasps,
    feasible: Grasps,
    query_object: QueryObject,
) -> str:
    """Says how much of the target was seen, how many grasps were proposed on it, what fell."""
    parts, nearest = labels.nearest_part(cloud.xyzs().T.astype(float), query_object, _SEEN)
    seen = sum(int((nearest == i).sum()) for i, (model, _) in enumerate(parts) if model == target)
    on_it = int(_on(target, labels.closing_region(proposed, query_object)).sum())
    why = f"{seen} of the cloud's {cloud.size()} points are on it (hidden?)"
    if on_it > 0:
        why = f"all {on_it} grasps proposed on it were rejected"
        if isinstance(feasible, FeasibleGrasps):
            counts = [f"{reason} {count}" for reason, count in feasible.rejected.items() if count]
            why += f" (rejected of all {len(proposed)}: {', '.join(counts)})"
    elif seen > 0:
        why += f" and none of the {len(proposed)} grasps proposed"
    return f"oracle: none of {len(feasible)} feasible grasps is on {target}: {why}"
