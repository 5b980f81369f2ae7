"""What a vision-language model is asked and what comes back, whatever API it is asked by.

A strategy asks a ``Question``. A dialogue adds how the model at hand is to answer, which makes it
a ``Message``; an API turns that into the body of a request, and the response into a ``Reply``.
``answers.read`` finds the ``Answer`` in the reply's text.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]  # (H, W, 3), RGB


@dataclass(frozen=True)
class Options:
    """The answer is one of these labels: numbers or names of colours."""

    labels: tuple[str, ...]


@dataclass(frozen=True)
class Points:
    """The answer is one point for each role, in the question's last image."""

    roles: tuple[str, ...]  # what each point is, in order, such as ("grasp", "avoid")
    size: tuple[int, int]  # width and height [pixel] of that image


Answer = str | dict[str, tuple[float, float]]
"""A label of ``Options``, or by role the pixel (u, v) in the image of ``Points`` as it was sent."""


@dataclass(frozen=True)
class Question:
    """What a strategy asks."""

    prompt: str  # name and version of the prompt, such as "gsi/1"
    parts: tuple[str | Image, ...]  # text and images, in the order in which they are read
    expects: Options | Points
    marks: dict[str, int] = field(default_factory=dict)
    """Label -> row of ``Candidates.grasps``; empty where nothing is marked."""
    check: Callable[["Answer"], object] = field(default=lambda answer: None, compare=False)
    """Raises Unanswered for an answer that is well-formed and no use, such as a point on nothing;
    the model is then asked once more."""


@dataclass(frozen=True)
class Message:
    """A question as a certain model is sent it."""

    parts: tuple[str | Image, ...]  # those of the question, then how to answer
    schema: Mapping[str, Any] | None  # JSON schema of the answer; None: the model's own format
    max_tokens: int  # of the answer, reasoning included
    prompt: str = ""  # name and version of the question's prompt; it is not sent


@dataclass(frozen=True)
class Reply:
    """What a model said."""

    text: str  # the answer alone, without reasoning that the API tells apart
    finish: Literal["stop", "length", "refusal"]
    model: str | None  # as the server names it
    tokens: dict[str, int] | None  # input, output, reasoning
    refusal: str = ""  # why it would not answer, where it says
