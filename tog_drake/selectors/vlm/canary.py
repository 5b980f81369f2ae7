"""A question whose answer is known, to try out a model, its server and its profile.

The image has coloured discs, one of them with a number on it. A model that sees it reads the
number and names that disc's colour; one whose answers are read in the right way points at another
disc's centre. Where the point is wrong, the answer is read in the way of every other profile too:
a transposed or rescaled answer is right in one of them.
"""

import json
import re
import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.errors import Unanswered
from tog_drake.selectors import prompts
from tog_drake.selectors.vlm import answers
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.dialogue import Dialogue
from tog_drake.selectors.vlm.profiles import PROFILES, Profile
from tog_drake.selectors.vlm.question import Answer, Image, Options, Points, Question
from tog_drake.values import Exchange

WIDTH, HEIGHT = 896, 672  # [pixel] multiples of 224: no model's server resizes it
RADIUS = 48  # [pixel] of a disc
WITHIN = 20.0  # [pixel] a point that is farther from the centre is not accepted
COLORS = ("red", "green", "blue", "yellow", "magenta", "white")
_GROUND, _INK = (120, 120, 120), (15, 15, 15)
_NUMBERS = 5  # to choose from
_SILENT = frozenset({"refused", "empty", "truncated"})  # such an answer tells nothing of its form
_GONE = frozenset({"unreachable", "timed_out", "rejected"})  # then there is no sense in asking on


@dataclass(frozen=True)
class Canary:
    """An image, and what is true of it."""

    image: Image  # (HEIGHT, WIDTH, 3)
    number: str  # on one of the discs
    numbers: tuple[str, ...]  # to choose from, the right one among them
    numbered: str  # colour of the disc with the number
    target: str  # colour of the disc to point at
    pixel: tuple[float, float]  # (u, v) of that disc's centre


@dataclass(frozen=True)
class Finding:
    """One thing that the canary has told."""

    name: str
    ok: bool
    found: str  # what, for a person
    required: bool = True  # False: good to know, but the model can be used without


@dataclass(frozen=True)
class Report:
    """What the canary has told of a model."""

    findings: tuple[Finding, ...]
    exchanges: tuple[Exchange, ...]

    @property
    def well(self) -> bool:
        """Whether the model can be used as it is."""
        return all(finding.ok for finding in self.findings if finding.required)


def draw_canary(seed: int) -> Canary:
    """Draws a canary: discs of six colours at random places, a number on the first."""
    import cv2

    rng = np.random.default_rng(seed)
    names = [COLORS[i] for i in rng.permutation(len(COLORS))]
    centers = _places(rng, len(names))
    rgb = dict(CANDIDATE_COLORS)
    image = np.full((HEIGHT, WIDTH, 3), _GROUND, np.uint8)
    for name, (u, v) in zip(names, centers, strict=True):
        cv2.circle(image, (u, v), RADIUS, _INK, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(image, (u, v), RADIUS - 4, rgb[name], cv2.FILLED, cv2.LINE_AA)
    numbers = tuple(str(n) for n in rng.choice(np.arange(10, 100), _NUMBERS, replace=False))
    number = numbers[rng.integers(_NUMBERS)]
    _write(image, number, centers[0])
    return Canary(
        image=image,
        number=number,
        numbers=numbers,
        numbered=names[0],
        target=names[1],
        pixel=(float(centers[1][0]), float(centers[1][1])),
    )


def _places(rng: np.random.Generator, n: int) -> list[tuple[int, int]]:
    """Centres of discs that keep apart; the second is at another place however it is misread."""
    edge = 2 * RADIUS
    while True:
        u = rng.integers(edge, WIDTH - edge, n)
        v = rng.integers(edge, HEIGHT - edge, n)
        places = [(int(a), int(b)) for a, b in zip(u, v, strict=True)]
        apart = [np.hypot(a[0] - b[0], a[1] - b[1]) for a in places for b in places if a is not b]
        misread = np.hypot(*(np.array(_misreadings(*places[1])) - places[1]).T)
        if min(apart) > 3 * RADIUS and misread.min() > 3 * WITHIN:
            return places


def _misreadings(u: float, v: float) -> list[tuple[float, float]]:
    """Where a point lands that is told one way and read another: transposed, or scaled wrongly."""
    return [
        (v, u),
        (v / HEIGHT * WIDTH, u / WIDTH * HEIGHT),
        (u / 1000 * WIDTH, v / 1000 * HEIGHT),
        (v / 1000 * WIDTH, u / 1000 * HEIGHT),
        (u / WIDTH * 1000, v / HEIGHT * 1000),
        (v / HEIGHT * 1000, u / WIDTH * 1000),
    ]


def _write(image: Image, text: str, center: tuple[int, int]) -> None:
    """Writes a number onto its disc, on a white plate: legible on any colour."""
    import cv2

    font, size, stroke = cv2.FONT_HERSHEY_SIMPLEX, 1.4, 4
    (width, height), _ = cv2.getTextSize(text, font, size, stroke)
    u, v = center[0] - width // 2, center[1] + height // 2
    cv2.rectangle(image, (u - 6, v - height - 6), (u + width + 6, v + 6), (255, 255, 255), -1)
    cv2.putText(image, text, (u, v), font, size, _INK, stroke, cv2.LINE_AA)


def check_model(
    client: Client, profile: Profile, *, max_tokens: int, seconds: float, seed: int
) -> Report:
    """Asks a model the questions of a canary and says what it can do.

    Args:
        client: asks it.
        profile: how the model is taken to tell places.
        max_tokens: of each answer.
        seconds: for all questions.
        seed: of the image.

    Raises:
        InputError: the key is missing, or cannot be sent.
    """
    canary = draw_canary(seed)
    dialogue = Dialogue(client, profile, max_tokens=max_tokens, deadline=time.monotonic() + seconds)
    numbers, colors = Options(canary.numbers), Options(COLORS)
    point = Points(("disc",), (WIDTH, HEIGHT))

    prompt = prompts.load("canary")

    def ask(question: str, expects: Options | Points) -> Answer | None:
        text = prompt.render(question=question, color=canary.target)
        with suppress(Unanswered):
            return dialogue.ask(Question(prompt.version, (canary.image, text), expects))
        return None

    number = ask("number", numbers)
    if dialogue.exchanges[-1].status in _GONE:
        return Report((_reached(dialogue.exchanges[-1]),), dialogue.exchanges)
    findings = [
        _reached(dialogue.exchanges[-1]),
        _seen("number", number, canary.number, dialogue.exchanges[-1]),
        _structured(profile, numbers, dialogue.exchanges[-1]),
    ]
    color = ask("colour", colors)
    findings.append(_seen("colour", color, canary.numbered, dialogue.exchanges[-1]))
    pointed = ask("point", point)
    findings.append(
        _pointed(pointed, canary.pixel, point, profile, client.model, dialogue.exchanges[-1])
    )
    return Report(tuple(findings), dialogue.exchanges)


def _reached(exchange: Exchange) -> Finding:
    if exchange.status in _GONE:
        return Finding("reachable", False, f"{exchange.status}: {exchange.message}")
    return Finding("reachable", True, f"{exchange.model or 'a model without a name'} answers")


def _seen(what: str, said: Answer | None, true: str, exchange: Exchange) -> Finding:
    """Whether the model has read the number, or named the colour."""
    name = f"sees the {what}"
    if said is None:
        return Finding(name, False, f"{exchange.status}: {exchange.message}")
    return Finding(name, said == true, true if said == true else f"said {said}, it is {true}")


def _structured(profile: Profile, expects: Options | Points, exchange: Exchange) -> Finding:
    """Whether the answer has the form that was asked for, with nothing around it."""
    schema = answers.schema(profile, expects)
    if schema is None:
        return Finding(
            "structured output", True, f"the profile {profile.name} asks for none", False
        )
    if exchange.status in _SILENT:
        return Finding("structured output", False, f"not tested: {exchange.status}", False)
    try:
        said = json.loads(answers.without_reasoning(exchange.answer or ""))
    except (Unanswered, ValueError, RecursionError):
        said = None
    if isinstance(said, dict) and set(schema["required"]) <= said.keys():
        return Finding("structured output", True, "honoured", False)
    found = "not honoured: answers are searched for in the text"
    return Finding("structured output", False, found, False)


def _pointed(
    said: Answer | None,
    true: tuple[float, float],
    expects: Points,
    profile: Profile,
    model: str,
    exchange: Exchange,
) -> Finding:
    """How far from the centre the model points, and which profile would be right if this is not."""
    name = f"points within {WITHIN:.0f} pixels"
    if isinstance(said, dict):
        miss = _miss(said, true)
        found = f"{miss:.1f} pixels from the centre, read as {profile.name}"
        if miss <= WITHIN:
            return Finding(name, True, found)
    else:
        found = f"{exchange.status}: {exchange.message}"
        if exchange.status in _SILENT:
            return Finding(name, False, found)
    right = right_profiles(exchange.answer or "", expects, true, model)
    advice = "no other profile reads it right"
    if right:
        advice = f"the same answer is right if it is read as {right[0]}: try --profile {right[0]}"
    if right[1:]:
        advice += f" ({', '.join(right[1:])}: equal for pointing)"
    return Finding(name, False, f"{found}; {advice}")


def right_profiles(text: str, expects: Points, true: tuple[float, float], model: str) -> list[str]:
    """Returns the names of the profiles by which ``text`` is a point within ``WITHIN`` of truth.

    First those of relatives of ``model`` by its name, then that of no family.
    """

    def far(name: str) -> tuple[bool, bool]:
        family = re.split("[^a-z]", name)[0]
        return family not in model.lower(), name != "pixels"

    right = []
    for profile in PROFILES.values():
        with suppress(Unanswered):
            answer = answers.read(text, profile, expects)
            if isinstance(answer, dict) and _miss(answer, true) <= WITHIN:
                right.append(profile.name)
    return sorted(right, key=far)


def _miss(answer: dict[str, tuple[float, float]], true: tuple[float, float]) -> float:
    (point,) = answer.values()
    return float(np.hypot(point[0] - true[0], point[1] - true[1]))
