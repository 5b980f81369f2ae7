"""What a strategy of asking a vision-language model is given, and what it gives back."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from tog_drake.selectors.marks import Framing, Rendering, frame_things, whole_image
from tog_drake.selectors.prompts import Prompt
from tog_drake.selectors.vlm.question import Answer, Question
from tog_drake.values import Array, Candidates, Grasps, View

Nearest = Literal["contact", "both"]
"""Which contact of a grasp counts where a model points: the one at ``Grasps.p_WContact`` as in the
paper, or the farther of the two, so that neither finger is on another part."""


@dataclass(frozen=True)
class Scene:
    """What a strategy may know."""

    view: View
    points: Array  # (M, 3) [m] of the cloud, in W
    candidates: Candidates
    task: str
    rendering: Rendering
    seed: int  # of the order and the colours of the marks
    permutation: int = 0
    """0 or 1: of two grasps or more, each has another number and colour with 1 than with 0."""
    nearest: Nearest = "both"
    prompt: Prompt | None = None  # to ask by; None: the strategy's own

    def framing(self, grasps: Grasps) -> Framing:
        """The part of the view that a model is sent, and at which size; ``grasps`` are in it."""
        if self.rendering == "paper":
            return whole_image(self.view)
        return frame_things(self.view, self.points, grasps)


@dataclass(frozen=True)
class Pick:
    """The grasp that the answers of a model single out."""

    index: int  # row of ``Candidates.grasps``
    reason: str  # for a person
    worth: Array | None = None  # (N,) of each grasp, −∞ where not at all; None: see ``choose``
    pointed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Role -> (u, v) in the view, where the model was asked to point."""


Ask = Callable[[Question], Answer]
"""Asks a model and returns its answer; raises Unanswered where there is none."""
Strategy = Callable[[Scene, Ask], Pick]
