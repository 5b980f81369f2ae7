"""What travels on the ports of the pipeline.

Every value is frozen and holds numpy arrays, not lists of objects. Frames follow Drake's monogram
notation: W world (z up), C camera (z forward, x right, y down), G grasp (see ``panda``).
"""

from dataclasses import dataclass, field, fields, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory
from typing_extensions import Self

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; pixel centres lie at whole numbers (u right, v down)."""

    width: int  # [pixel]
    height: int  # [pixel]
    fx: float  # [pixel]
    fy: float  # [pixel]
    cx: float  # [pixel]
    cy: float  # [pixel]


@dataclass(frozen=True)
class View:
    """One colour-and-depth image and where it was taken from."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float32]  # (H, W) [m] along z of C; 0 is a hole, nothing is NaN or inf
    intrinsics: Intrinsics
    X_WC: Array  # (4, 4)

    @staticmethod
    def empty() -> "View":
        """A view of one pixel, a hole: the model value of ports."""
        return View(
            rgb=np.zeros((1, 1, 3), np.uint8),
            depth=np.zeros((1, 1), np.float32),
            intrinsics=Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0),
            X_WC=np.eye(4),
        )


@dataclass(frozen=True)
class CameraView:
    """A view, and which camera took it."""

    camera: str  # as in the scenario, such as "wrist"; its first look is "wrist#1" after the next
    view: View
    q: Array | None = None  # (7,) [rad] where the arm was at an earlier look; None: where it is


@dataclass
class Workspace:
    """The part of the world in which things are looked for and grasped, in W (a config)."""

    lower: list[float] = field(default_factory=lambda: [0.25, -0.40, -0.05])  # [m] x, y, z
    upper: list[float] = field(default_factory=lambda: [0.80, 0.40, 0.40])  # [m] x, y, z
    table_height: float = 0.0  # [m] z of the table top; planning_directives put theirs there too


@dataclass(frozen=True)
class Grasps:
    """N grasps, best first. Every array has N rows."""

    X_WG: Array  # (N, 4, 4)
    width: Array  # (N,) [m] distance between the two contacts
    score: Array  # (N,) confidence in [0, 1]
    p_WContact: Array  # (N, 3) [m] where a finger pad meets the *observed* surface

    def __len__(self) -> int:
        return len(self.score)

    @property
    def p_WOtherContact(self) -> Array:
        """(N, 3) [m] where the finger meets the object that does not meet it at ``p_WContact``."""
        y = self.X_WG[:, :3, 1]
        from_middle = ((self.p_WContact - self.X_WG[:, :3, 3]) * y).sum(axis=1)
        return np.asarray(self.p_WContact - np.copysign(self.width, from_middle)[:, None] * y)

    def take(self, rows: NDArray[np.integer]) -> Self:
        """Returns the grasps of ``rows``, in that order, of the same type."""
        per_grasp = {
            f.name: getattr(self, f.name)[rows]
            for f in fields(self)
            if not f.metadata.get("whole", False)
        }
        return replace(self, **per_grasp)

    @staticmethod
    def empty() -> "Grasps":
        return Grasps(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True)
class FeasibleGrasps(Grasps):
    """Grasps that the arm can approach and lift, with the joint paths that do it."""

    q_approach: Array = field(default_factory=lambda: np.zeros((0, 0, 7)))
    """(N, A, 7) [rad] straight Cartesian approach: pregrasp first, grasp last."""
    q_lift: Array = field(default_factory=lambda: np.zeros((0, 0, 7)))
    """(N, L, 7) [rad] straight Cartesian lift: grasp first, lifted last."""
    rejected: dict[str, int] = field(default_factory=dict, metadata={"whole": True})
    """How many proposals fell to each reason; they and the N add up to all proposals."""

    @property
    def q_pregrasp(self) -> Array:
        return self.q_approach[:, 0]

    @property
    def q_grasp(self) -> Array:
        return self.q_approach[:, -1]


@dataclass(frozen=True)
class Candidates:
    """K diverse grasps, picked from all that are feasible."""

    grasps: Grasps  # all N feasible grasps (a FeasibleGrasps where there is an arm)
    index: NDArray[np.int64]  # (K,) rows of ``grasps``, best confidence first
    cluster: NDArray[np.int64]  # (N,) whose cluster (0..K-1) each grasp is in

    def __len__(self) -> int:
        return len(self.index)

    @staticmethod
    def empty() -> "Candidates":
        """No candidate: the model value of ports."""
        return Candidates(Grasps.empty(), np.zeros(0, np.int64), np.zeros(0, np.int64))


AnswerStatus = Literal[
    "ok",
    "refused",  # the model would not say
    "empty",  # it said nothing
    "truncated",  # it ran out of tokens before it answered
    "too_long",  # more text than is read
    "unreadable",  # no answer is found in what it said
    "ambiguous",  # more than one is
    "out_of_range",  # none of the labels, or a coordinate beyond its scale
    "off_image",  # a point outside the view
    "off_object",  # a point on nothing that could be grasped
    "disagreed",  # two permutations of the same candidates, two answers
    "timed_out",  # no answer within the deadline
    "unreachable",  # no connection, one that was cut, or the server is out of order
    "rejected",  # the server does not take the question: key, model name, parameters
]
"""What became of a question to a model."""

ViewStatus = Literal["ok", "not_found"]
"""not_found: no view shows the target, so that the pipeline's own camera is shown."""

ChoiceStatus = Literal[AnswerStatus, "unresolved", "part_not_found", "no_grasp_on_part"]
"""unresolved: the task's words are not understood, or say neither part nor purpose."""


@dataclass(frozen=True)
class Exchange:
    """One question to a model and what it answered, for the record and the report."""

    prompt: str  # name and version of the prompt, such as "gsi/1"
    text: str  # the question's text; "[image 1]" and so on stand where its images were
    images: tuple[NDArray[np.uint8], ...]  # as sent, each (H, W, 3) RGB
    marks: dict[str, int]  # label -> row of ``Candidates.grasps``; empty where nothing is marked
    key: str  # of the question, under which a cassette has it
    answer: str | None  # verbatim; None: none came
    status: AnswerStatus
    message: str  # what is wrong with the answer; "" where nothing is
    model: str | None  # as the server named it; it may differ from what was asked for
    seconds: float  # latency; where it was replayed that of the recording, 0 where not known
    tokens: dict[str, int] | None  # input, output, reasoning, as far as the server says
    cost: float | None  # [USD]; None where the price is not known
    points: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Where the answer points, whether or not that was of use: role -> (u, v) in the last image."""
    replayed: str | None = field(default=None, compare=False)
    """The cassette that had the answer; None: it was asked for now. Where an answer comes from is
    no part of the decision: a replay equals what was recorded."""


@dataclass(frozen=True)
class SelectedView:
    """The view in which the grasps are shown, and why that one."""

    camera: str  # that took it
    view: View
    scores: dict[str, float]  # camera -> score, one for each view; higher is less ambiguous
    reason: str  # for a person
    status: ViewStatus = "ok"
    exchanges: tuple[Exchange, ...] = ()  # the questions to a model and its answers, in order

    @staticmethod
    def none() -> "SelectedView":
        """No view: the model value of ports."""
        return SelectedView(camera="", view=View.empty(), scores={}, reason="")


@dataclass(frozen=True)
class Choice:
    """The grasp that a selector picked, and why."""

    index: int  # row of ``Candidates.grasps``
    grasp: Grasps  # that row, N = 1
    reason: str  # one or two sentences for a person
    status: ChoiceStatus = "ok"  # what the selector could not resolve, if anything
    part: str | None = None  # the part that the selector believes to hold, in its own words
    pixel: tuple[float, float] | None = None  # (u, v) of the contact point in the view shown
    alternatives: tuple[int, ...] = ()
    """Rows of ``Candidates.grasps`` to try, best first, where no motion to ``index`` is found."""
    exchanges: tuple[Exchange, ...] = ()  # the questions to a model and its answers, in order
    fallback: str | None = None  # the selector that chose because the model's answer was no use
    pointed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Where a model pointed: role ("grasp", "avoid") -> (u, v) in the view."""

    @staticmethod
    def none() -> "Choice":
        """Nothing chosen: the model value of ports."""
        return Choice(index=-1, grasp=Grasps.empty(), reason="")


@dataclass(frozen=True)
class GraspMotion:
    """A timed motion, from 0 to ``duration``, checked and ready to execute."""

    arm: Trajectory  # (7,) [rad]
    hand: Trajectory  # (1,) [m] commanded opening
    duration: float  # [s]
    phase_times: dict[str, float]  # [s] when approach, close, lift and hold begin
    note: str = ""  # how it was found (optimised, or the fallback), and what failed before
    grasp_index: int = -1  # row of ``Candidates.grasps`` that it carries out
    grasp: Grasps = field(default_factory=Grasps.empty)  # that row, N = 1
    retreat: "GraspMotion | None" = None
    """From its end back to its start, with the hand open: the way to another look."""

    def slowed(self, speed: float) -> "GraspMotion":
        """Returns the same motion at ``speed`` times its own, above 0; at 1 itself."""
        if speed == 1.0:
            return self
        duration = self.duration / speed
        clock = PiecewisePolynomial.FirstOrderHold([0.0, duration], [[0.0, self.duration]])
        return replace(
            self,
            arm=PathParameterizedTrajectory(self.arm, clock),
            hand=PathParameterizedTrajectory(self.hand, clock),
            duration=duration,
            phase_times={phase: t / speed for phase, t in self.phase_times.items()},
            retreat=None if self.retreat is None else self.retreat.slowed(speed),
        )

    @staticmethod
    def still() -> "GraspMotion":
        """A motion of no duration: the model value of ports."""
        return GraspMotion(
            arm=PiecewisePolynomial(np.zeros((7, 1))),
            hand=PiecewisePolynomial(np.zeros((1, 1))),
            duration=0.0,
            phase_times={},
        )


@dataclass(frozen=True)
class NextLook:
    """Where the pipeline's own camera goes for a further look, or that it stays."""

    motion: GraspMotion | None  # of the arm, its hand open; None: it stays
    reason: str  # for a person
    X_WC: Array | None = None  # (4, 4) of the camera, at the end of the motion
    shown: float = 0.0  # share of what is guessed of the target's surface that the views show
    expected: float = 0.0  # with the further look
    left: CameraView | None = None  # the present view of that camera, to be remembered

    @staticmethod
    def none() -> "NextLook":
        """No further look: the model value of ports."""
        return NextLook(None, "")
