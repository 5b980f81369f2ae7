"""What the stages say one after another, up to the motion: timed, and as far as it came."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pydrake.perception import PointCloud
from pydrake.systems.framework import Context

from tog_drake.alignment import Alignment
from tog_drake.errors import EpisodeError
from tog_drake.pipeline import GraspPipeline
from tog_drake.proposer import weights_of
from tog_drake.values import (
    CameraView,
    Candidates,
    Choice,
    FeasibleGrasps,
    GraspMotion,
    Grasps,
    SelectedView,
    View,
)


@dataclass(frozen=True)
class Stage:
    """A step from image to motion that can be evaluated, timed and drawn by itself."""

    port: str  # of the pipeline, that holds its value
    key: str  # of its wall time in a record
    does: str  # for people


STAGES = (
    Stage("view", "render", "render the image"),
    Stage("cloud", "cloud", "image to cloud"),
    Stage("grasps", "propose", "propose grasps"),
    Stage("feasible_grasps", "filter", "check feasibility"),
    Stage("candidates", "candidates", "pick candidates"),
    Stage("selected_view", "choose_view", "choose the view"),
    Stage("choice", "select", "choose for the task"),
    Stage("motion", "plan", "plan the motion"),
)
"""In the order of the data."""


@dataclass(frozen=True)
class Look:
    """What the stages say that do not depend on the task, nor on who chooses."""

    view: View
    cloud: PointCloud
    grasps: Grasps
    feasible_grasps: FeasibleGrasps
    seconds: Mapping[str, float]  # wall time of each, by the stages' keys


@dataclass
class Decision:
    """What the stages said in one look, in order; None from the stage on that failed."""

    view: View | None = None
    cloud: PointCloud | None = None
    grasps: Grasps | None = None
    feasible_grasps: FeasibleGrasps | None = None
    candidates: Candidates | None = None
    selected_view: SelectedView | None = None
    choice: Choice | None = None
    motion: GraspMotion | None = None
    error: EpisodeError | None = None
    overruled: "Choice | EpisodeError | None" = None
    """What the selector said, where a person chose otherwise; see ``by_hand``."""
    by_hand: bool = False  # whether a person chose
    seconds: dict[str, float] = field(default_factory=dict)
    views: tuple[CameraView, ...] = ()  # of all cameras and looks, where there are several
    alignments: Mapping[str, Alignment] | None = None  # by camera, where views were fused
    weights: Mapping[str, Any] | None = None  # those that the proposer works with, see weights_of

    @property
    def shown(self) -> View | None:
        """What whoever chooses was shown; the pipeline's own view as long as none is selected."""
        return self.view if self.selected_view is None else self.selected_view.view

    @property
    def said(self) -> Choice | EpisodeError | None:
        """What the selector said, whoever chose in the end; None: it was not asked."""
        return self.overruled if self.by_hand else self.choice or self.error

    @property
    def look(self) -> Look | None:
        """What other decisions in the same situation can begin with; None where it ended sooner."""
        if self.feasible_grasps is None:
            return None
        assert self.view is not None and self.cloud is not None and self.grasps is not None
        seconds = {stage.key: self.seconds[stage.key] for stage in STAGES if _is_of_look(stage)}
        return Look(self.view, self.cloud, self.grasps, self.feasible_grasps, seconds)


def _is_of_look(stage: Stage) -> bool:
    return stage.port in Look.__dataclass_fields__


def decide(pipeline: GraspPipeline, context: Context, look: Look | None = None) -> Decision:
    """Evaluates the stages one by one, with the wall time of each.

    Drake caches each value, so that an executor that looks at the same time gets the same motion
    without computing it again.

    Args:
        pipeline: the pipeline.
        context: the root Context of the diagram that holds it.
        look: what the first stages said in the very same situation: they are not asked again, now
            or later in this context, and the seconds are those that they took then.
    """
    decision = Decision()
    if look is not None and len(pipeline.cameras) == 1:
        pipeline.fix(context, "views", (CameraView(pipeline.cameras[0], look.view),))
    if look is not None:
        for stage in filter(_is_of_look, STAGES):
            setattr(decision, stage.port, getattr(look, stage.port))
            pipeline.fix(context, stage.port, getattr(look, stage.port))
            decision.seconds[stage.key] = look.seconds[stage.key]
    go_on(decision, pipeline, context)
    return decision


def go_on(
    decision: Decision, pipeline: GraspPipeline, context: Context, until: str = STAGES[-1].port
) -> None:
    """Evaluates the stages that a decision lacks, in order, up to one of them or the first error.

    Args:
        decision: takes their values.
        pipeline, context: as of ``decide``.
        until: the port of the last stage to evaluate.
    """
    mine = pipeline.GetMyContextFromRoot(context)
    last = [stage.port for stage in STAGES].index(until)
    decision.error = None
    for stage in STAGES[: last + 1]:
        if getattr(decision, stage.port) is not None:
            continue
        start = time.perf_counter()
        try:
            setattr(decision, stage.port, pipeline.GetOutputPort(stage.port).Eval(mine))
        except EpisodeError as error:
            decision.error = error
            break
        finally:
            decision.seconds[stage.key] = time.perf_counter() - start
    if decision.selected_view is not None:
        views = pipeline.GetOutputPort("views").Eval(mine)
        decision.views = views if len(views) > 1 else ()
    if pipeline.HasOutputPort("alignments"):
        decision.alignments = pipeline.GetOutputPort("alignments").Eval(mine)
    decision.weights = weights_of(pipeline.proposer)
