"""The oracle: reads the simulated part labels. An upper bound, not a method.

What it reaches is what a perfect selector could reach with the same grasps. It cannot run on a
real robot, where nobody hands out the labels.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import QueryObject
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.compliance import PartLabels
from tog_drake.errors import NoChoice
from tog_drake.selector import choose
from tog_drake.values import Candidates, Choice, View

ORACLE_NOTE = "reads simulated part labels: an upper bound, not a method"
_SURE = 0.99  # share of the closing region that must lie on allowed parts


@dataclass
class Oracle:
    """Picks the best grasp on a part that the task allows, by simulated ground truth."""


class OracleSelector(LeafSystem):
    """Stands where GraspSelector stands, with one more port: the ground truth.

    .. pydrake_system::

        name: OracleSelector
        input_ports:
        - view
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
        self._view = self.DeclareAbstractInputPort("view", Value(View.empty()))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._task = self.DeclareAbstractInputPort("task", Value(""))
        self._truth = self.DeclareAbstractInputPort("cheat.query_object", Value(QueryObject()))
        ports = (self._view, self._candidates, self._task, self._truth)
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
                self._view.Eval(context),
                self._candidates.Eval(context),
                self._task.Eval(context),
                self._truth.Eval(context),
            )
        )


def choose_by_labels(
    labels: PartLabels,
    target: str,
    view: View,
    candidates: Candidates,
    task: str,
    query_object: QueryObject,
) -> Choice:
    """Returns the best grasp whose closing region lies on an allowed part of ``target``.

    Raises:
        NoChoice: if the task allows no part of the target, or no grasp lies on an allowed one.
    """
    grasps = candidates.grasps
    allowed = labels.objects[target].allowed(task)
    if not allowed:
        raise NoChoice(
            f"oracle: the task {task!r} allows no labelled part of {target}; its parts are "
            f"{', '.join(labels.objects[target].part_words)}"
        )
    regions = labels.closing_region(grasps, query_object)
    share = np.array(
        [
            sum(s for (model, part), s in r.items() if model == target and part in allowed)
            for r in regions
        ]
    )
    fits = share > _SURE
    if not fits.any():
        raise NoChoice(
            f"oracle: none of {len(grasps)} feasible grasps closes on "
            f"{' or '.join(sorted(allowed))} of {target}"
        )
    index = int(np.flatnonzero(fits)[0])  # grasps come best first
    reason = (
        f"Oracle, reading simulated labels: best of {fits.sum()} grasps on "
        f"{' or '.join(sorted(allowed))}."
    )
    part = max(regions[index].items(), key=lambda item: item[1])[0][1]
    worth = np.where(fits, grasps.score, -np.inf)
    return choose(index, view, candidates, reason, part=part, worth=worth)
