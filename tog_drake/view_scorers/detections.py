"""What an object detector says of the views, and how clear of doubt that makes each of them.

As in the paper, a view's score is the greatest confidence that a box holds what the words say: of
the boxes of that class alone, however sure the detector is of other things.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from tog_drake.errors import NoView
from tog_drake.values import CameraView
from tog_drake.view_selection import Scores

Box = tuple[float, float, float, float]  # [pixel] u, v of the upper left, then of the lower right


@dataclass(frozen=True)
class Detection:
    """A box in an image."""

    label: str  # one of the words that were asked for, or whatever else the detector knows
    box: Box
    score: float  # confidence, from 0 to 1


def check_target(target: str) -> None:
    """Raises NoView where there are no words that a detector could be asked for."""
    if not target.strip():
        raise NoView(
            "a detector must be told what to look for, and the task names neither an object nor "
            "its colour; valid: a task that does, or --target WORDS (target of view_selection)"
        )


def score_detections(
    views: Sequence[CameraView], found: Sequence[Sequence[Detection]], target: str, detector: str
) -> Scores:
    """Scores each view by the best box of the target in it, 0 where there is none.

    Args:
        views: as they were shown to the detector.
        found: what it found in each.
        target: the words that it was asked for.
        detector: what it is called, at the beginning of the reason.
    """
    best = [_best(seen, boxes, target) for seen, boxes in zip(views, found, strict=True)]
    values = tuple(0.0 if found is None else found.score for found in best)
    surest = best[max(range(len(values)), key=values.__getitem__)]
    if surest is None:
        return Scores(values, f"{detector} finds {target!r} in none of {len(views)} views.")
    u0, v0, u1, v1 = (round(edge) for edge in surest.box)
    where = views[values.index(surest.score)].camera
    reason = f"{detector} is surest of {target!r} in {where}, at ({u0}, {v0}) to ({u1}, {v1})."
    return Scores(values, reason)


def _best(seen: CameraView, boxes: Sequence[Detection], target: str) -> Detection | None:
    """Returns the surest box of the target that is in the image at all.

    Detectors pad images to squares, and may see things in the padding.
    """
    height, width = seen.view.rgb.shape[:2]
    inside = [
        found
        for found in boxes
        if found.label.casefold() == target.casefold()
        and found.box[0] < width
        and found.box[1] < height
        and found.box[2] > 0
        and found.box[3] > 0
    ]
    return max(inside, key=lambda found: found.score, default=None)
