"""A vision-language model that judges whether a grasp suits the task, as in the paper.

It sees what the selector might have seen, never the ground truth: the view, and the view with the
hand of the grasp that was chosen. The paper's judge agreed with people on 0.717 of the grasps; here
it stands beside the judge that reads the labels, and does not replace it.
"""

import time
from functools import cache

import numpy as np

from tog_drake.benchmark.journal import JudgeRecord
from tog_drake.decision import Decision
from tog_drake.drawing import Image
from tog_drake.errors import InputError, Unanswered
from tog_drake.selectors import prompts
from tog_drake.selectors.marks import Mark, draw_grippers, frame_things, plain
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.dialogue import Dialogue
from tog_drake.selectors.vlm.profiles import find_profile
from tog_drake.selectors.vlm.question import Options, Question
from tog_drake.selectors.vlm.specification import VALID, read_specification, specification

SUITS, SUITS_NOT = "1", "2"
"""The labels of the answer. Numbers are what is read most surely (see ``vlm.labels``)."""
_COLOR = (255, 64, 64)
_PREFIX = "vlm:"


class VlmJudge:
    """Asks a model of each grasp whether it suits the task."""

    def __init__(self, wanted: str, *, deadline: float = 120.0):
        """Prepares to ask; nothing is sent yet.

        Args:
            wanted: the model, such as "vlm:gemini:gemini-3.8-flash".
            deadline: [s] for one judgement, retries included.

        Raises:
            InputError: it names no model, or the model's key is missing.
        """
        if not wanted.startswith(_PREFIX):
            raise InputError(f"--judge {wanted!r}; valid: {_PREFIX}MODEL, where MODEL is {VALID}")
        self._model = read_specification(wanted.removeprefix(_PREFIX))
        self._profile = find_profile(self._model.model, self._model.profile)
        self._client = Client(self._model, profile=self._profile.name)
        self._client.check_key()
        self._deadline = deadline

    def judge(self, decision: Decision, task: str) -> JudgeRecord | None:
        """Returns what the model says of the grasp that was chosen; None where none was.

        A useless answer is a record that says so, not an error.
        """
        pictures = grasp_pictures(decision)
        if pictures is None:
            return None
        labels = (SUITS, SUITS_NOT)
        prompt = prompts.load("judge")
        text = prompt.render(task=task, labels=labels)
        question = Question(prompt.version, (*pictures, text), Options(labels))
        dialogue = Dialogue(
            self._client,
            self._profile,
            max_tokens=self._model.max_tokens,
            deadline=time.monotonic() + self._deadline,
        )
        status, complies = "ok", None
        try:
            complies = dialogue.ask(question) == SUITS
        except Unanswered as error:
            status = error.status
        costs = [exchange.cost for exchange in dialogue.exchanges]
        known = [cost for cost in costs if cost is not None]
        return JudgeRecord(
            model=specification(self._model),
            complies=complies,
            status=status,
            cost=sum(known) if len(known) == len(costs) else None,
            seconds=round(sum(exchange.seconds for exchange in dialogue.exchanges), 3),
        )


@cache
def vlm_judge(wanted: str) -> VlmJudge:
    """Returns the judge of a model: one, however many grasps a process has to be judged.

    Raises as ``VlmJudge``.
    """
    return VlmJudge(wanted)


def grasp_pictures(decision: Decision) -> tuple[Image, Image] | None:
    """Returns the scene, and the same with the hand that was chosen; None where none was."""
    view, cloud, choice = decision.shown, decision.cloud, decision.choice
    if view is None or cloud is None or choice is None:
        return None
    framing = frame_things(view, np.asarray(cloud.xyzs().T, np.float64), choice.grasp)
    drawn = draw_grippers(view, framing, choice.grasp, [Mark("", _COLOR)], "paper")
    return plain(view, framing), drawn
