"""Chooses the grasp that the task asks for.

Selectors differ in what they read: scores alone (``selectors/baselines.py``), words and the shape
of the cloud (``selectors/geometric.py``), what a vision-language model answers
(``selectors/vlm/selector.py``), or simulated labels (``selectors/oracle.py``).
"""

from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.panda import grasps_apart
from tog_drake.pinhole import project
from tog_drake.values import Array, Candidates, Choice, ChoiceStatus, SelectedView, View

ALTERNATIVES = 5  # of a choice, at most
# Where the arm finds no way to a grasp, it finds none to one that is hardly different.
_SAME_PLACE = 0.02  # [m]
_SAME_TURN = np.radians(20.0)


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
    worth: Array | None = None,
) -> Choice:
    """Returns the choice of a grasp, with its contact's pixel and what to try in its place.

    Args:
        index: row of ``candidates.grasps``.
        view: what the pixel is a pixel of.
        candidates: all grasps that there are.
        reason: for a person.
        status: what could not be resolved.
        part: that the grasp is believed to hold.
        worth: (N,) how well each of ``candidates.grasps`` serves the task, −∞ where not at all:
            the alternatives are the best of these. None where the selector knows of the chosen
            one alone: then they are the most confident of its cluster.
    """
    if worth is None:
        same = candidates.cluster == candidates.cluster[index]
        worth = np.where(same, candidates.grasps.score, -np.inf)
    grasp = candidates.grasps.take(np.array([index]))
    u, v = project(grasp.p_WContact, view.intrinsics, view.X_WC)[0]
    pixel = (float(u), float(v))
    return Choice(
        index=index,
        grasp=grasp,
        reason=reason,
        status=status,
        part=part,
        pixel=pixel,
        alternatives=_alternatives(index, candidates.grasps.X_WG, worth),
    )


def _alternatives(index: int, X_WG: Array, worth: Array) -> tuple[int, ...]:
    """Returns the best rows besides ``index``, each unlike it and unlike those before it."""
    left = np.where(np.arange(len(worth)) == index, -np.inf, worth)
    picked = [index]
    while len(picked) <= ALTERNATIVES:
        place, turn = grasps_apart(X_WG, X_WG[picked[-1]])
        left = np.where((place < _SAME_PLACE) & (turn < _SAME_TURN), -np.inf, left)
        best = int(np.argmax(left))
        if left[best] == -np.inf:
            break
        picked.append(best)
    return tuple(picked[1:])


class GraspSelector(LeafSystem):
    """Chooses the grasp that the task asks for.

    .. pydrake_system::

        name: GraspSelector
        input_ports:
        - selected_view
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
        self._view = self.DeclareAbstractInputPort("selected_view", Value(SelectedView.none()))
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
                view=self._view.Eval(context).view,
                cloud=self._cloud.Eval(context),
                candidates=self._candidates.Eval(context),
                task=self._task.Eval(context),
            )
        )
