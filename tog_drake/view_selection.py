"""Chooses the view in which the grasps are shown: the least ambiguous one.

The grasps stay those of the pipeline; what changes is what whoever chooses among them sees.
Scorers differ in what they read: depth and cloud alone (``view_scorers/coverage.py``), what a
detector (``view_scorers/detector.py``), a server (``view_scorers/remote.py``) or a vision-language
model (``view_scorers/vlm_compare.py``) makes of the images, or nothing (``Hand``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.task import target_words
from tog_drake.values import CameraView, Candidates, Exchange, SelectedView


@dataclass(frozen=True)
class Scores:
    """How little ambiguous the target is in each view."""

    values: tuple[float, ...]  # one a view, finite, higher is better; 0: does not show the target
    reason: str  # for a person
    exchanges: tuple[Exchange, ...] = ()  # the questions to a model and its answers, in order


class ViewScorer(Protocol):
    """Anything that can tell how well each of several views shows the target."""

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns a score for each view.

        Args:
            views: one or more, that of the pipeline's own camera first.
            cloud: of the things on the table, in W.
            candidates: the grasps that are to be shown.
            target: the object's words, such as "red mug"; "" where nobody says which it is.
            task: what a person said.

        Raises:
            NoView: it cannot tell.
        """
        ...


@dataclass
class Hand:
    """The pipeline's own camera, whatever others there are: `!Hand {}`."""


class HandScorer:
    """Scores nothing: the pipeline's own camera is shown."""

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns 1 for the first view and 0 for the others."""
        values = (1.0, *(0.0 for _ in views[1:]))
        return Scores(values, "The pipeline's own camera; no view was compared.")


def select_view(
    scorer: ViewScorer,
    views: Sequence[CameraView],
    cloud: PointCloud,
    candidates: Candidates,
    task: str,
    *,
    target: str | None = None,
) -> SelectedView:
    """Returns the view with the highest score; of equal ones the first.

    Args:
        scorer: who tells.
        views: one or more, that of the pipeline's own camera first.
        cloud: of the things on the table, in W.
        candidates: the grasps that are to be shown.
        task: what a person said.
        target: the object's words; None: they are found in the task.

    Raises:
        NoView: the scorer cannot tell.
    """
    scores = scorer.score(views, cloud, candidates, target_words(task, target), task)
    found = max(scores.values) > 0
    best = views[int(np.argmax(scores.values)) if found else 0]
    return SelectedView(
        camera=best.camera,
        view=best.view,
        scores={v.camera: float(s) for v, s in zip(views, scores.values, strict=True)},
        reason=scores.reason,
        status="ok" if found else "not_found",
        exchanges=scores.exchanges,
    )


class ViewSelector(LeafSystem):
    """Chooses the view in which the grasps are shown.

    .. pydrake_system::

        name: ViewSelector
        input_ports:
        - views
        - cloud
        - candidates
        - task
        output_ports:
        - selected_view

    ``selected_view`` is computed once per change of an input.

    Args:
        scorer: who tells how well a view shows the target.
        target: the object's words; None: they are found in the task.
    """

    def __init__(self, scorer: ViewScorer, target: str | None = None):
        super().__init__()
        self._scorer = scorer
        self._target = target
        self._views = self.DeclareAbstractInputPort("views", Value(()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._task = self.DeclareAbstractInputPort("task", Value(""))
        ports = (self._views, self._cloud, self._candidates, self._task)
        self.DeclareAbstractOutputPort(
            "selected_view",
            alloc=lambda: Value(SelectedView.none()),
            calc=self._CalcSelectedView,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcSelectedView(self, context: Context, output: Value) -> None:
        output.set_value(
            select_view(
                self._scorer,
                self._views.Eval(context),
                self._cloud.Eval(context),
                self._candidates.Eval(context),
                self._task.Eval(context),
                target=self._target,
            )
        )
