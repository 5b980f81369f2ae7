"""The selector that asks a vision-language model.

A strategy asks, in a ``Dialogue``. Here is what all strategies share: whom to ask, the deadline of
a decision, the vote, and what to do where the model gives no answer that can be used. Nothing ever
takes the place of an answer without being named.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoChoice, NoGrasp, Unanswered
from tog_drake.selector import choose
from tog_drake.selectors.geometric import Geometric, GeometricSelector
from tog_drake.selectors.marks import Rendering
from tog_drake.selectors.prompts import Prompt
from tog_drake.selectors.scene import Nearest, Pick, Scene
from tog_drake.selectors.strategies import PERMUTABLE, POINTING, STRATEGIES, own_prompt
from tog_drake.selectors.vlm.connection import connect
from tog_drake.selectors.vlm.dialogue import Dialogue
from tog_drake.selectors.vlm.request import QuestionPending, Request
from tog_drake.selectors.vlm.specification import ModelConfig
from tog_drake.task import read_task
from tog_drake.values import Candidates, Choice, Exchange, Grasps, View, Workspace

FALLBACKS = ("fail", "geometric")


@dataclass
class Vlm:
    """Asks a vision-language model which grasp suits the task."""

    strategy: str = "gsi"  # gsi, cpsi, gmi, cpmi, cpg, pivot or avoid: see selectors/strategies.py
    prompt: str | None = None  # a file with a text of one's own in place of the strategy's
    model: ModelConfig | None = None  # whom to ask; replay needs none, the cassette names it
    rendering: str = "marked"  # marked: numbered discs and a close-up; paper: colours, as published
    votes: int = 1  # 2: asked again with permuted marks, if there are several; they must agree
    nearest: str | None = None
    """Which contact of a grasp counts where a model points: "contact" (as published: the one that
    the grasp was proposed at) or "both" (the farther of the two, at most 6 cm away in the first
    place). None: "contact" with the rendering "paper", else "both"."""
    fallback: str | None = None
    """Where no answer can be used: "fail" raises NoChoice, "geometric" lets the geometric selector
    choose and says so. None: "geometric" in `tog run` and `tog choose`, "fail" elsewhere."""
    deadline: float = 120.0  # [s] for all questions of a decision, retries and repairs included
    record: str | None = None  # a cassette: what is in it is not asked again, what is not is added
    replay: str | None = None  # a cassette: nothing is asked, what is not in it is an error


class VlmSelector:
    """Asks a model, and says what became of the question."""

    def __init__(self, config: Vlm, workspace: Workspace, *, seed: int, export: Path | None = None):
        """Prepares to ask; nothing is sent yet.

        Args:
            config: what to ask whom.
            workspace: for the geometric selector, should it have to step in.
            seed: of the order and the colours of the marks.
            export: a cassette that takes the place of those of the config: nothing is sent, and
                ``select`` raises QuestionPending where it has no answer.

        Raises:
            InputError: a field of the config is out of its bounds, there is no model to ask, or the
                prompt cannot be used.
        """
        _check(config)
        self._config = config
        self._rendering: Rendering = "paper" if config.rendering == "paper" else "marked"
        self._prompt: Prompt | None = None
        if config.prompt is not None:
            self._prompt = own_prompt(Path(config.prompt), config.strategy, self._rendering)
        self._seed = seed
        self._geometric = GeometricSelector(Geometric(), workspace)
        self._connection = connect(
            "!Vlm",
            config.model,
            deadline=config.deadline,
            record=config.record,
            replay=config.replay,
            export=export,
        )

    def check_key(self) -> None:
        """Raises InputError where the model will be asked for sure, and its key is missing."""
        self._connection.client.check_key()

    def select(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Choice:
        """Returns the grasp that the model's answers single out, or what the fallback chooses.

        Raises:
            NoChoice: the model gave no answer that can be used, and the fallback is "fail" or
                could not choose either; with its status and what was said.
            NoGrasp: there is no feasible grasp.
            QuestionPending: a question is to be asked elsewhere.
            InputError: the task is empty, there are more candidates than colours, the view is too
                large for the model, a question is not on the cassette, or a key is missing.
        """
        read_task(task)
        if len(candidates) == 0:
            raise NoGrasp("There is no feasible grasp to choose from; move the object nearer.")
        scene = self._scene(view, cloud, candidates, task)
        self._check_size(scene)
        dialogue = self._connection.dialogue()
        try:
            pick = self._vote(scene, dialogue)
        except Unanswered as error:
            problem = NoChoice(str(error), status=error.status)
        except NoChoice as error:
            problem = error
        else:
            choice = choose(pick.index, view, candidates, pick.reason, worth=pick.worth)
            return replace(choice, exchanges=dialogue.exchanges, pointed=pick.pointed)
        return self._without_answer(problem, dialogue.exchanges, view, cloud, candidates, task)

    def _scene(self, view: View, cloud: PointCloud, candidates: Candidates, task: str) -> Scene:
        paper = self._rendering == "paper"
        nearest = self._config.nearest or ("contact" if paper else "both")
        return Scene(
            view=view,
            points=np.asarray(cloud.xyzs().T, dtype=np.float64),
            candidates=candidates,
            task=task,
            rendering=self._rendering,
            seed=self._seed,
            nearest="contact" if nearest == "contact" else "both",
            prompt=self._prompt,
        )

    def _check_size(self, scene: Scene) -> None:
        """Raises InputError where the model is to tell pixels of an image that it sees resized."""
        profile = self._connection.profile
        size, most = scene.framing(Grasps.empty()).size, profile.max_side
        if self._config.strategy in POINTING and most is not None and max(size) > most:
            raise InputError(
                f"the view is {size[0]}×{size[1]} pixels large, and models of the profile "
                f"{profile.name} tell the pixels of images up to {most} on the long side: "
                "use rendering: marked (--rendering marked), which is sent smaller, or a smaller "
                "view"
            )

    def _vote(self, scene: Scene, dialogue: Dialogue) -> Pick:
        """Returns the pick on which all votes agree."""
        strategy = STRATEGIES[self._config.strategy]
        picks: list[Pick] = []
        pending: list[Request] = []  # the votes do not wait for each other
        # A single candidate cannot be permuted: a second question would be the same.
        votes = self._config.votes if len(scene.candidates.index) > 1 else 1
        for vote in range(votes):
            try:
                picks.append(strategy(replace(scene, permutation=vote), dialogue.ask))
            except QuestionPending as question:
                pending += question.requests
        if pending:
            raise QuestionPending(tuple(pending))
        if len({pick.index for pick in picks}) > 1:
            said = " Permuted: ".join(pick.reason for pick in picks)
            raise Unanswered("disagreed", f"the model chose two grasps. {said}")
        agreed = " The same with permuted marks." if len(picks) > 1 else ""
        return replace(picks[0], reason=picks[0].reason + agreed)

    def _without_answer(
        self,
        problem: NoChoice,
        exchanges: tuple[Exchange, ...],
        view: View,
        cloud: PointCloud,
        candidates: Candidates,
        task: str,
    ) -> Choice:
        """Does what the config says where the model's answer is no use."""
        status = problem.status
        assert status is not None  # whatever raises it here says so
        said = "The model's answer cannot be used" if exchanges else "No model was asked"
        message = f"{said} ({status}): {problem}".rstrip(".")
        if self._config.fallback != "geometric":
            raise NoChoice(f"{message}.", status=status, exchanges=exchanges) from problem
        try:
            choice = self._geometric.select(view, cloud, candidates, task)
        except (NoChoice, NoGrasp) as error:
            raise NoChoice(
                f"{message}; and the geometric selector cannot choose either: {error}",
                status=status,
                exchanges=exchanges,
            ) from error
        return replace(
            choice,
            reason=f"{message}; so the geometric selector chose. {choice.reason}",
            status=status,
            exchanges=exchanges,
            fallback="geometric",
        )


def _check(config: Vlm) -> None:
    """Raises InputError for a field that is out of its bounds."""
    _one_of("strategy", config.strategy, STRATEGIES)
    _one_of("rendering", config.rendering, get_args(Rendering))
    if config.nearest is not None:
        _one_of("nearest", config.nearest, get_args(Nearest))
    if config.fallback is not None:
        _one_of("fallback", config.fallback, FALLBACKS)
    if config.votes not in (1, 2):
        raise InputError(f"!Vlm: votes: {config.votes}; valid: 1, 2")
    if config.votes == 2 and config.strategy not in PERMUTABLE:
        raise InputError(
            f"!Vlm: votes: 2 asks again with permuted marks, and {config.strategy} does not mark "
            f"the same grasps twice; valid with it: votes: 1, or {', '.join(PERMUTABLE)}"
        )


def _one_of(field: str, given: str, valid: Iterable[str]) -> None:
    if given not in valid:
        raise InputError(f"!Vlm: {field}: {given!r}; valid: {', '.join(valid)}")
