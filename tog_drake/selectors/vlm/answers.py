"""How a model is to answer, and what it answered.

What a model says is data: it picks a label or a pixel and nothing else. Nothing is guessed: an
answer that is not found, or not for sure, is ``Unanswered``, and never the first of the labels.
"""

import re
from typing import Any

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.json_in_text import is_cut_off
from tog_drake.selectors.vlm.labels import read_label, refuse_what_is_no_answer
from tog_drake.selectors.vlm.pointing import read_points, seen_size
from tog_drake.selectors.vlm.profiles import Profile
from tog_drake.selectors.vlm.question import Answer, Options, Points

VERSION = "answer/1"
"""Of what ``instruction`` and ``schema`` say; it goes up whenever any of it changes, the sentences
in profiles.yaml included, since answers to other instructions are other answers."""
MAX_LENGTH = 40_000  # characters of an answer
MAX_REASONING = 2_000_000  # characters of an answer with the reasoning before it


def instruction(profile: Profile, expects: Options | Points) -> str:
    """Returns how the model is to answer: the last words of a question."""
    if isinstance(expects, Options):
        labels = ", ".join(expects.labels)
        if profile.structured:
            return (
                'Answer with JSON: {"reasoning": "<one or two sentences>", "choice": "<X>"}, '
                f"where X is exactly one of: {labels}."
            )
        return (
            'Explain in one or two sentences. Then end with a line "Final answer: X", '
            f"where X is exactly one of: {labels}."
        )
    width, height = seen_size(profile.resize, expects.size)
    sentence = profile.prompt.replace("{width}", str(width)).replace("{height}", str(height))
    return " ".join(filter(None, (sentence, *_how_written(profile, expects.roles))))


def schema(profile: Profile, expects: Options | Points) -> dict[str, Any] | None:
    """Returns the JSON schema of the answer; None where the family does better without.

    Reasoning comes first, so that the model thinks before it chooses. What every provider's
    structured output takes: no limits on numbers, labels are texts.
    """
    if not profile.structured:
        return None
    if isinstance(expects, Options):
        answer = {"choice": {"type": "string", "enum": list(expects.labels)}}
        return _object({"reasoning": {"type": "string"}, **answer})
    number = {"type": "integer" if profile.scale in (None, 1000.0) else "number"}
    point: dict[str, Any] = {"x": number, "y": number}
    if profile.key != "x, y":
        point = {profile.key: {"type": "array", "items": number, "minItems": 2, "maxItems": 2}}
    item = _object({**point, "label": {"type": "string", "enum": list(expects.roles)}})
    return _object({"reasoning": {"type": "string"}, "points": {"type": "array", "items": item}})


def read(text: str, profile: Profile, expects: Options | Points) -> Answer:
    """Finds the answer in what a model said.

    Where a label is read from other words than JSON, and from which, is in ``labels``. Reasoning
    between <think> tags is left out before, since it weighs what is not chosen, and may
    tell coordinates in another convention than the answer.

    Raises:
        Unanswered: empty, truncated, too_long, refused, unreadable, ambiguous, out_of_range or
            off_image; nothing else is raised, whatever the text.
    """
    answer = without_reasoning(text) if len(text) <= MAX_REASONING else text
    if len(answer) > MAX_LENGTH:
        raise Unanswered("too_long", f"{len(answer)} characters; at most {MAX_LENGTH} are read")
    answer = answer.strip()
    if not answer:
        raise Unanswered("empty", "the model said nothing")
    if is_cut_off(answer):
        raise Unanswered("truncated", "the JSON ends before it is complete")
    if isinstance(expects, Options):
        return read_label(answer, expects.labels)
    try:
        return read_points(answer, profile, expects)
    except Unanswered as failure:
        if failure.status == "unreadable":
            refuse_what_is_no_answer(answer)
        raise


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _how_written(profile: Profile, roles: tuple[str, ...]) -> tuple[str, str]:
    """Returns the sentences about the format of an answer and about how many points are in it."""
    role = roles[0]
    if len(roles) == 1:
        each = f'Return exactly one point and label it "{role}".'
    else:
        named = ", ".join(f'"{name}"' for name in roles)
        each = f"Return exactly one point for each of these labels: {named}."
    match profile.formats[0]:
        case "json":
            pair = "y, x" if profile.order == "yx" else "x, y"
            point = '"x": x, "y": y' if profile.key == "x, y" else f'"{profile.key}": [{pair}]'
            points = f'[{{{point}, "label": "{role}"}}]'
            if profile.structured:
                points = f'{{"reasoning": "<one or two sentences>", "points": {points}}}'
            return f"The answer should follow the JSON format: {points}.", each
        case "boxes":
            form = f"<ref>{role}</ref><box>[[x1, y1, x2, y2]]</box>"
            return f"Give a small box around the point, in the form {form}.", each
        case "tuples" if len(roles) == 1:
            form = (
                "Your answer should be formatted as a list of tuples, i.e. [(x1, y1)], where each "
            )
            form += (
                "tuple contains the x and y coordinates of a point satisfying the conditions above."
            )
            return form, "Return exactly one point."
        case "tuples":
            return f'Give a line for each, formatted as "{role}: [(x, y)]".', each
        case _:
            return "", each  # tags and coords: Molmo writes them unasked


# What is left out


_THINKS = re.compile(r"<(/?)(?:think|thinking|thought|reasoning)>", re.IGNORECASE | re.ASCII)


def without_reasoning(text: str) -> str:
    """Returns what comes after the last thought; a thought that does not end is truncated."""
    marks = list(_THINKS.finditer(text))
    ends = [mark for mark in marks if mark.group(1)]
    answer = text[ends[-1].end() :] if ends else text
    begun = _THINKS.search(answer)
    if begun is None:
        return answer
    if not answer[: begun.start()].strip():
        raise Unanswered("truncated", "the model was still reasoning when it stopped")
    return answer[: begun.start()]
