"""Chooses the grasp that the task asks for.

Selectors differ in what they read: scores alone (``selectors/baselines.py``), words and the shape
of the cloud (``selectors/geometric.py``), or simulated labels (``selectors/oracle.py``).
"""

from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.pinhole import project
from tog_drake.values import Candidates, Choice, ChoiceStatus, View


class Selector(Protocol):
    """Anything that can choose a grasp for a task."""

    def select(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Choice:
        """Returns the choice; it may be any row of ``candidates.grasps``.

        What could not be resolved is said in the choice's ``status``. Raises NoChoice where the
        selector cannot tell at all, InputError where the task is empty.
        """
        ...


def choose(
    index: int,
    view: View,
    candidates: Candidates,
    reason: str,
    *,
    status: ChoiceStatus = "ok",
    part: str | None = None,
) -> Choice:
    """Returns the choice of row ``index`` of ``candidates.grasps``, with its contact's pixel."""
    grasp = candidates.grasps.take(np.array([index]))
    u, v = project(grasp.p_WContact, view.intrinsics, view.X_WC)[0]
    pixel = (float(u), float(v))
    return Choice(index=index, grasp=grasp, reason=reason, status=status, part=part, pixel=pixel)


class GraspSelector(LeafSystem):
    """Chooses the grasp that the task asks for.

    .. pydrake_system::

        name: GraspSelector
        input_ports:
        - view
        - cloud
        - candidates
        - task
        output_ports:
        - choice

    ``choice`` is computed once per change of an input.
    """

    def __init__(self, selector: Selector):
        super().__init__()
        self._selector = selector
        self._view = self.DeclareAbstractInputPort("view", Value(View.empty()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._task = self.DeclareAbstractInputPort("task", Value(""))
        ports = (self._view, self._cloud, self._candidates, self._task)
        self.DeclareAbstractOutputPort(
            "choice",
            alloc=lambda: Value(Choice.none()),
            calc=self._CalcChoice,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcChoice(self, context: Context, output: Value) -> None:
        output.set_value(
            self._selector.select(
                view=self._view.Eval(context),
                cloud=self._cloud.Eval(context),
                candidates=self._candidates.Eval(context),
                task=self._task.Eval(context),
            )
        )
