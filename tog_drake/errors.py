"""What can go wrong, as types.

``InputError`` says that what was given cannot be used (exit status 2 of the command). The others
end an episode: each names the outcome under which it is recorded. A message says what was given,
what would be valid and what to do next; it needs no traceback to be understood.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tog_drake.safety import StopReason
    from tog_drake.values import AnswerStatus, ChoiceStatus, Exchange


class TogError(Exception):
    """Base of every error that tog_drake raises on purpose."""


class InputError(TogError):
    """What the user gave cannot be used: file, option, scenario or image."""


class EpisodeError(TogError):
    """The pipeline ended without a motion. ``outcome`` is how the episode is recorded."""

    outcome: str


class NoGrasp(EpisodeError):
    """Nothing to grasp: no object in view, no proposal, or none that the arm can carry out."""

    outcome = "no_grasp"


class NoFeasibleGrasp(NoGrasp):
    """Grasps were proposed, but all were rejected. ``rejected`` counts them by reason."""

    def __init__(self, message: str, rejected: dict[str, int]):
        super().__init__(message)
        self.rejected = rejected


class NoView(EpisodeError):
    """Who was to say which view is the least ambiguous did not.

    Where a model or a server was asked, ``status`` says what became of it and ``exchanges`` what
    was said.
    """

    outcome = "no_view"

    def __init__(
        self,
        message: str,
        *,
        status: "AnswerStatus | None" = None,
        exchanges: "tuple[Exchange, ...]" = (),
    ):
        super().__init__(message)
        self.status = status
        self.exchanges = exchanges


class NoProposal(EpisodeError):
    """Who was to propose grasps elsewhere did not; ``status`` says what became of the question."""

    outcome = "no_proposal"

    def __init__(self, message: str, status: "AnswerStatus"):
        super().__init__(message)
        self.status = status


class NoChoice(EpisodeError):
    """The selector could not decide. It says why instead of guessing.

    Where a model was asked, ``status`` says what became of it and ``exchanges`` what was said.
    """

    outcome = "no_choice"

    def __init__(
        self,
        message: str,
        *,
        status: "ChoiceStatus | None" = None,
        exchanges: "tuple[Exchange, ...]" = (),
    ):
        super().__init__(message)
        self.status = status
        self.exchanges = exchanges


class NoPlan(EpisodeError):
    """No motion to the chosen grasp passed the checks."""

    outcome = "no_plan"


class NoImage(EpisodeError):
    """A camera brings no images, old ones, or no depth: nothing is decided on them."""

    outcome = "no_image"


class Stopped(EpisodeError):
    """A motion of a real arm was stopped, or never began; ``rule`` says what it would break."""

    outcome = "stopped"

    def __init__(self, message: str, rule: "StopReason"):
        super().__init__(message)
        self.rule = rule


class Unanswered(Exception):
    """A question, to a model or to any server, without a usable answer.

    ``status`` says in which way, the message why. Who asked makes of it what ends an episode.
    """

    def __init__(self, status: "AnswerStatus", message: str):
        super().__init__(message)
        self.status = status
