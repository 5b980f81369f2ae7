"""How a model is to answer, and what it answered.

What a model says is data: it picks a label or a pixel and nothing else. Nothing is guessed: an
answer that is not found, or not for sure, is ``Unanswered``, and never the first of the labels.
"""

import re
from typing import Any

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.selectors.vlm.json_in_text import find_values, is_cut_off
from tog_drake.selectors.vlm.pointing import read_points, seen_size
from tog_drake.selectors.vlm.profiles import Profile
from tog_drake.selectors.vlm.question import Answer, Options, Points, Unanswered

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

    In this order: JSON, the words "Final answer:", a refusal, the last sentence with a label in it.
    Reasoning between <think> tags is left out before, since it weighs what is not chosen, and may
    tell coordinates in another convention than the answer.

    Raises:
        Unanswered: empty, truncated, too_long, refused, unreadable, ambiguous, out_of_range or
            off_image; nothing else is raised, whatever the text.
    """
    answer = _without_reasoning(text) if len(text) <= MAX_REASONING else text
    if len(answer) > MAX_LENGTH:
        raise Unanswered("too_long", f"{len(answer)} characters; at most {MAX_LENGTH} are read")
    answer = answer.strip()
    if not answer:
        raise Unanswered("empty", "the model said nothing")
    if is_cut_off(answer):
        raise Unanswered("truncated", "the JSON ends before it is complete")
    if isinstance(expects, Options):
        return _read_label(answer, expects.labels)
    try:
        return read_points(answer, profile, expects)
    except Unanswered as failure:
        if failure.status == "unreadable":
            _refuse_what_is_no_answer(answer)
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


# What is left out, and what is none


_THINKS = re.compile(r"<(/?)(?:think|thinking|thought|reasoning)>", re.IGNORECASE | re.ASCII)


def _without_reasoning(text: str) -> str:
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


_REFUSES = re.compile(
    r"\bsorry\b|\bas an ai\b|\bwithout the image\b"
    r"|\b(?:can ?not|can['’]t|won['’]t|unable to|not able to|decline to)"
    r" (?:assist|help|process|comply|provide|answer|determine|view|see (?:the|any|an) image)\b",
    re.IGNORECASE,
)
_NONE = re.compile(r"\bthere (?:are|is) none\b|^\W{0,9}none\W{0,9}$", re.IGNORECASE)


def _refuse_what_is_no_answer(text: str) -> None:
    """Says in which way there is no answer in ``text``, where its words do."""
    if _NONE.search(text):
        raise Unanswered("empty", "the model says that there is none")
    if _REFUSES.search(text):
        raise Unanswered("refused", f"the model refuses: {text[:80]!r}")


# Labels


_TOKEN = re.compile(
    r"(?<![a-zA-Z\d.])[-−]?\d{1,9}(?![a-zA-Z\d%]|\.\d)(?!\s?(?:cm|mm|m|px|pixels?|degrees?|°|kg|g)\b)"
    r"|(?<![a-zA-Z])[a-zA-Z]{1,40}(?![a-zA-Z])"
)
"""Words and whole numbers, but no decimals, shares or measures."""
_SENTINEL = re.compile(
    r"\bfinal\s{1,3}answer\b\W{0,9}(?:is\b\W{0,9})?|\banswer\b\W{0,5}(?:is\b|:)\W{0,9}",
    re.IGNORECASE,
)
_SENTENCE_END = re.compile(r"[.!?](?=\s)|\n")
_NOT = re.compile(r"\b(?:not|never|avoid|neither|nor|except)\b|n['’]t\b", re.IGNORECASE)
_CHOSEN = (
    "choice", "final_answer", "answer", "best", "selected", "index", "number", "color", "colour",
    "label", "grasp", "candidate", "option", "id",
)  # fmt: skip
_COLORS = frozenset(name for name, _ in CANDIDATE_COLORS)


def _read_label(text: str, labels: tuple[str, ...]) -> str:
    by_word = {label.lower(): label for label in labels}
    objects = [found for found in map(_objects_in, find_values(text)) if found]
    for group in objects:
        chosen = {_chosen_in(value, by_word) for value in group} - {None}
        if len(chosen) > 1:
            raise Unanswered("ambiguous", f"{len(chosen)} choices at once")
        if chosen:
            return str(chosen.pop())
    for sentinel in list(_SENTINEL.finditer(text))[:-10:-1]:
        rest = text[sentinel.end() : sentinel.end() + 300]
        end = _SENTENCE_END.search(rest)
        label = _label_in(rest[: end.start()] if end else rest, by_word)
        if label is not None:
            return label
    _refuse_what_is_no_answer(text)
    if objects:
        raise Unanswered("unreadable", "the JSON has no key 'choice'")
    ends = [end.end() for end in _SENTENCE_END.finditer(text)]
    for start, stop in zip([0, *ends][::-1], [*ends, len(text)][::-1], strict=True):
        label = _label_in(text[start:stop], by_word)
        if label is not None:
            return label
    raise Unanswered("unreadable", f"no label is found in {text[-80:]!r}")


def _objects_in(value: Any) -> list[dict[Any, Any]]:
    return [item for item in (value if isinstance(value, list) else [value]) if type(item) is dict]


def _chosen_in(value: dict[Any, Any], by_word: dict[str, str]) -> str | None:
    """Returns the label that a JSON object names; None where it has no key for it."""
    keys = {key.lower(): key for key in value if isinstance(key, str)}
    named = [keys[key] for key in _CHOSEN if key in keys]
    if not named:
        return None
    chosen = value[named[0]]
    if isinstance(chosen, list) and len(chosen) == 1:
        chosen = chosen[0]
    if chosen is None or chosen == []:
        raise Unanswered("empty", "the model chooses none")
    if isinstance(chosen, list):
        raise Unanswered("ambiguous", f"{len(chosen)} choices at once")
    if isinstance(chosen, bool) or not isinstance(chosen, (int, str)):
        raise Unanswered("unreadable", "the choice is neither a whole number nor text")
    if isinstance(chosen, int) and abs(chosen) >= 10**9:
        raise Unanswered("out_of_range", "the choice is far beyond the labels")
    said = str(chosen)
    label = _label_in(said[:300], by_word)
    if label is None:
        raise Unanswered("unreadable", f"the choice is {said[:80]!r}")
    return label


def _label_in(sentence: str, by_word: dict[str, str]) -> str | None:
    """Returns the one label that a sentence names; None where it names nothing like a label.

    Raises:
        Unanswered: it names several, or another number beside it, or has a "not" in it (ambiguous),
            or it names only what is no label (out_of_range): another number where labels are
            numbers, or a colour that is not drawn.
    """
    numbers = any(word.isdigit() for word in by_word)
    labels: set[str] = set()
    others: set[str] = set()
    for token in _TOKEN.findall(sentence):
        is_number = not token.isalpha()
        word = str(int(token.replace("−", "-"))) if is_number else token.lower()
        if word in by_word:
            labels.add(by_word[word])
        elif (is_number and numbers) or (word in _COLORS and not _COLORS.isdisjoint(by_word)):
            others.add(word)
    if len(labels) > 1 or (labels and numbers and others):
        raise Unanswered("ambiguous", f"{', '.join(sorted(labels | others)[:5])} in one sentence")
    if labels and _NOT.search(sentence):
        raise Unanswered("ambiguous", f"{sentence[:80]!r} may speak against {', '.join(labels)}")
    if labels:
        return labels.pop()
    if others:
        some = ", ".join(sorted(others)[:5])
        raise Unanswered("out_of_range", f"{some}: none of {', '.join(by_word.values())}")
    return None
