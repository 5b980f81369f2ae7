"""The view that a vision-language model finds clearest: one question, one picture of each view.

The model compares; how sure it is of itself is not asked, since such numbers are made up. Each
picture is what ``marks`` frames, the things enlarged, since the selector shows the same part of
the view that is named. Order and numbers are drawn by the scenario's seed: models prefer first
and last places (arXiv 2410.16983).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.perception import PointCloud

from tog_drake.errors import NoView, Unanswered
from tog_drake.selectors import prompts
from tog_drake.selectors.discs import draw_disc, place_discs
from tog_drake.selectors.marks import frame_things, plain
from tog_drake.selectors.vlm.connection import connect
from tog_drake.selectors.vlm.question import Image, Options, Question
from tog_drake.selectors.vlm.specification import ModelConfig
from tog_drake.values import Array, CameraView, Candidates
from tog_drake.view_selection import Scores

_DISC = (255, 255, 255)  # RGB of the disc with an image's number: no candidate has it


@dataclass
class VlmCompare:
    """Asks a vision-language model in which view the parts to hold are clearest."""

    model: ModelConfig | None = None  # whom to ask; replay needs none, the cassette names it
    deadline: float = 120.0  # [s] for the question, retries and a repair included
    record: str | None = None  # a cassette, as of !Vlm; both may have the same
    replay: str | None = None


class VlmCompareScorer:
    """Scores the view that a model names 1 and all others 0 (a ``ViewScorer``)."""

    def __init__(self, config: VlmCompare, *, seed: int, export: Path | None = None):
        """Prepares to ask; nothing is sent yet.

        Args:
            config: whom to ask.
            seed: of the order of the pictures.
            export: a cassette that takes the place of those of the config: nothing is sent, and
                ``score`` raises QuestionPending where it has no answer.

        Raises:
            InputError: a field of the config is out of its bounds, or there is no model to ask.
        """
        self._seed = seed
        self._connection = connect(
            "!VlmCompare",
            config.model,
            deadline=config.deadline,
            record=config.record,
            replay=config.replay,
            export=export,
        )

    def check_key(self) -> None:
        """Raises InputError where the model will be asked for sure, and its key is missing."""
        self._connection.client.check_key()

    def score(
        self,
        views: Sequence[CameraView],
        cloud: PointCloud,
        candidates: Candidates,
        target: str,
        task: str,
    ) -> Scores:
        """Returns 1 for the view that the model names; of a single view nothing is asked.

        Raises:
            NoView: the model gave no answer that can be used; with its status and what was said.
            QuestionPending: the question is to be asked elsewhere.
            InputError: the question is not on the cassette, or a key is missing.
        """
        if len(views) == 1:
            return Scores((1.0,), f"There is no other view than that of {views[0].camera}.")
        order = np.random.default_rng(self._seed).permutation(len(views))
        shown = [views[i] for i in order]
        points = np.asarray(cloud.xyzs().T, np.float64)
        dialogue = self._connection.dialogue()
        try:
            label = dialogue.ask(_question(shown, points, candidates, target, task))
        except Unanswered as error:
            raise NoView(
                f"The model's answer which view is the clearest cannot be used ({error.status}): "
                f"{str(error).rstrip('.')}.",
                status=error.status,
                exchanges=dialogue.exchanges,
            ) from error
        assert isinstance(label, str)
        named = int(order[int(label) - 1])
        images = ", ".join(f"{n} {seen.camera}" for n, seen in enumerate(shown, 1))
        reason = f"Of the images {images} the model finds the parts clearest in {label}."
        values = tuple(float(i == named) for i in range(len(views)))
        return Scores(values, reason, dialogue.exchanges)


def _question(
    shown: Sequence[CameraView], points: Array, candidates: Candidates, target: str, task: str
) -> Question:
    """Returns the question with a picture of each view, numbered from 1."""
    labels = tuple(str(n) for n in range(1, len(shown) + 1))
    prompt = prompts.load("view")
    parts: list[str | Image] = []
    for label, seen in zip(labels, shown, strict=True):
        parts += [f"Image {label}:", _picture(seen, points, candidates, label)]
    text = prompt.render(task=task, target=target, labels=labels, count=len(labels))
    return Question(prompt.version, (*parts, text), Options(labels))


def _picture(seen: CameraView, points: Array, candidates: Candidates, label: str) -> Image:
    """Returns a view's picture, its number where it hides nothing, at the upper left if it can."""
    framing = frame_things(seen.view, points, candidates.grasps.take(candidates.index))
    image = plain(seen.view, framing)
    corner = np.zeros((1, 1, 2))
    centers, _ = place_discs(
        framing.size,
        corner,
        lines=np.zeros((0, 2, 2)),
        stems=None,
        things=framing.from_view(framing.things),
        thickness=1.0,
    )
    draw_disc(image, centers[0], label, _DISC)
    return image
