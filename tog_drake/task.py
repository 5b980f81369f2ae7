"""What a task asks for, in words alone: no picture, no geometry, no ground truth.

``read_task`` is shared by the geometric selector, which looks for the words in the cloud, and by
the judge of task compliance, which maps them to the labelled parts of an object. It reads plain
English by small word lists and the order of words; what it does not know it leaves out.
"""

import re
from collections.abc import Iterator, Set
from dataclasses import dataclass
from typing import Literal

from tog_drake.errors import InputError
from tog_drake.task_words import (
    COLOUR_WORDS,
    DETERMINERS,
    HANDOVER_VERBS,
    HOLD_VERBS,
    JOINING,
    NEGATING_PAIRS,
    NEGATORS,
    NOUN_OR_VERB,
    OFFERED,
    OPENERS,
    PART_WORDS,
    PERSON,
    PREPOSITIONS,
    RECIPIENTS,
    STOP,
    USE_VERBS,
    VAGUE_PARTS,
    VERBS,
)

Intent = Literal["use", "handover", "hold"]

MAX_TASK_LENGTH = 1000  # characters; a task is a sentence or two


@dataclass(frozen=True)
class TaskReading:
    """The words of a task that matter for where to grasp.

    ``parts``, where not empty, override ``intent``: "use the mug, by the rim" means the rim.
    """

    text: str  # as given
    intent: Intent | None  # None: the words do not say
    parts: tuple[str, ...]  # parts to hold, as in PART_WORDS, in the order named
    avoid: tuple[str, ...]  # parts not to hold, likewise
    colour: str | None  # of the object to grasp, as in COLOUR_WORDS
    objects: tuple[str, ...]  # nouns, the one most likely to be grasped first


def read_task(text: str) -> TaskReading:
    """Reads the intent, the parts, the colour and the object out of a task.

    Neither case nor punctuation matters. Raises InputError when the task is empty, has no word in
    it, or is longer than MAX_TASK_LENGTH.
    """
    if len(text) > MAX_TASK_LENGTH:
        raise InputError(
            f"The task has {len(text)} characters; at most {MAX_TASK_LENGTH} are read. "
            "Say it in a sentence, such as 'hand me the hammer'."
        )
    words = _words(text)
    if not words:
        raise InputError(
            f"The task {text.strip()!r} has no words. Say what to do, such as 'hand me the hammer'."
        )
    verbs = [i for i in range(len(words)) if _is_use_verb(words, i)]
    intent = _intent(words, verbs)
    parts, avoid = _parts(words, verbs)
    phrases = list(_noun_phrases(words, verbs))
    objects = tuple(o for o in _objects(words, verbs, phrases, intent) if o not in parts + avoid)
    colour = _colour(words, phrases, objects)
    return TaskReading(text, intent, parts, avoid, colour, objects)


def _words(text: str) -> list[str]:
    """Lower-case words; "don't" and "dont" are one word, "hammer's" is "hammer"."""
    plain = re.sub("[’‘`´]", "'", text.casefold())
    plain = re.sub(r"'s\b", "", plain).replace("'", "")
    return [_singular(word) for word in re.findall(r"[^\W_]+", plain)]


def _singular(word: str) -> str:
    if word in PART_WORDS or word in STOP or len(word) < 4 or word.endswith(("ss", "scissors")):
        return word
    stem = word[:-1] if word.endswith("s") else word
    if stem.endswith("ing") and stem not in STOP:  # cutting, pouring, driving
        base = stem[:-3]
        for verb in (base, base + "e", base[:-1]):
            if verb in USE_VERBS or verb in HOLD_VERBS:
                return verb
    return stem


def _at(words: list[str], i: int) -> str:
    return words[i] if 0 <= i < len(words) else ""


def _is_use_verb(words: list[str], i: int) -> bool:
    """Whether word i asks the robot to use something; nouns and the person's own doing do not."""
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    if word not in USE_VERBS or before in DETERMINERS or before in COLOUR_WORDS:
        return False
    if word in NOUN_OR_VERB:
        opens = before in OPENERS or before in {"", "for"}
        takes = after in DETERMINERS | PREPOSITIONS | {"it", "one", "something"}
        if not (opens and (takes or word == "use" or before == "for")):
            return False
    lead = words[max(0, i - 4) : i]
    for_person = PERSON & set(lead) or ("for" in lead and RECIPIENTS & set(lead))
    return not for_person or "you" in lead or "robot" in lead


def _is_handover(words: list[str], i: int) -> bool:
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    if word in {"hand", "hands"}:
        mine = _at(words, i - 2) in {"in", "into", "to"} and before in DETERMINERS
        verb = after in RECIPIENTS | DETERMINERS | {"over", "it"}
        return mine or (verb and before not in DETERMINERS | {"left", "right", "one"})
    if after in RECIPIENTS and word in {"get", "grab", "find", "pick", "take", "show"}:
        return _at(words, i + 2) not in {"by", "to", ""}  # "get me the mug", not "take me to"
    if word == "have" and before in {"i", "me"}:
        return True  # "can I have the mug", "let me have it"
    return word in HANDOVER_VERBS and before not in DETERMINERS


def _intent(words: list[str], use_verbs: list[int]) -> Intent | None:
    """The first verb that asks for use or handover; else hold, where a verb says so."""
    for i, word in enumerate(words):
        if i in use_verbs:
            return "use"
        if _is_handover(words, i):
            return "handover"
        if word == "for" and _at(words, i + 1) == "use":
            return "use"
    return "hold" if HOLD_VERBS & set(words) else None


def _parts(words: list[str], use_verbs: list[int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Parts to hold and parts to avoid, each once, in the order named."""
    positive: dict[str, None] = {}
    negative: dict[str, None] = {}
    for i, word in enumerate(words):
        if word not in PART_WORDS or _is_object_or_verb(words, i):
            continue
        if _is_avoided(words, i):
            negative[PART_WORDS[word]] = None
        elif not _is_acted_with(words, i, use_verbs) and not _points_away(words, i):
            positive[PART_WORDS[word]] = None
    return tuple(p for p in positive if p not in negative), tuple(negative)


def _governor(words: list[str], i: int) -> int:
    """Index of the verb or preposition before the noun phrase that word i ends; −1 for none."""
    j = i - 1
    while j >= 0 and (words[j] in DETERMINERS or words[j] not in STOP or words[j] == "only"):
        j -= 1
    return j


def _is_object_or_verb(words: list[str], i: int) -> bool:
    """Whether a part word means something else: "handle it with care", "a bowl", "on top of"."""
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    first = before in OPENERS or before == ""
    if word in {"handle", "head", "grip", "face", "point", "top"} and first:
        return after in DETERMINERS | {"it", "to", "with", "at"}
    if word in VAGUE_PARTS:
        return _at(words, _governor(words, i)) not in {"by", "at", "from"} | HOLD_VERBS
    if word == "bowl":  # of a spoon only where it is said so
        said = _at(words, _governor(words, i)) == "by" or _at(words, i + 1) == "of"
        return not (said or (before not in STOP | set(COLOUR_WORDS) and before != ""))
    return False


def _is_avoided(words: list[str], i: int) -> bool:
    after = _at(words, i + 1)
    if after in {"is", "end", "side"}:
        after = _at(words, i + 2)
    if after in OFFERED and not _points_away(words, i):
        return True
    lead = words[max(0, i - 8) : i]
    if "so" in lead and PERSON & set(lead[lead.index("so") :]) and "you" not in lead:
        return True  # "... so that I can take the handle"
    return _is_negated(words, i)


def _points_away(words: list[str], i: int) -> bool:
    """ "with the blade pointing away from me" names no part to hold."""
    tail = words[i + 1 : i + 4]
    return "away" in tail and bool({"facing", "pointing", "is", "turned"} & set(tail))


def _is_negated(words: list[str], i: int) -> bool:
    """Whether a "not" reaches word i: over one verb at most, over no other part but by "or"."""
    verbs = 0
    j = i - 1
    while j >= max(0, i - 8):
        if words[j] in NEGATORS or (_at(words, j - 1), words[j]) in NEGATING_PAIRS:
            return words[j + 1] != "only"
        if words[j] in PART_WORDS:
            between = set(words[j + 1 : i])
            joined = between & {"or", "nor", "and"} and between <= JOINING | DETERMINERS
            return bool(joined) and _is_negated(words, j)
        verbs += words[j] in VERBS
        if verbs > 1 or words[j] == "but":
            return False
        j -= 1
    return False


def _is_acted_with(words: list[str], i: int, use_verbs: list[int]) -> bool:
    """ "use the head of the hammer", "hit the nail on the head": a part, but not to be held."""
    g = _governor(words, i)
    if PART_WORDS[words[i]] == "handle" or g < 0:
        return False
    if words[g] in {"use", "using", "with"}:
        return True
    verbs_before = [v for v in use_verbs if v < g]
    return words[g] in {"on", "in", "into", "onto", "from", "against"} and bool(verbs_before)


def _noun_phrases(words: list[str], use_verbs: list[int]) -> Iterator[tuple[int, int]]:
    """Runs of words between stop words, as (begin, end)."""
    begin = 0
    for i in range(len(words) + 1):
        if i == len(words) or words[i] in STOP or i in use_verbs:
            if i > begin:
                yield begin, i
            begin = i + 1


def _noun(words: list[str], phrase: tuple[int, int]) -> str | None:
    """The last word of a phrase that is neither a part nor a colour; a lone colour is a fruit."""
    run = words[slice(*phrase)]
    nouns = [w for w in run if w not in COLOUR_WORDS and (w not in PART_WORDS or w == "bowl")]
    if nouns:
        return nouns[-1]
    return "orange" if run == ["orange"] else None


def _objects(
    words: list[str], use_verbs: list[int], phrases: list[tuple[int, int]], intent: Intent | None
) -> tuple[str, ...]:
    """Nouns in order, but first the one that is used, handed over or held."""
    nouns = [
        (_at(words, _governor(words, end)), noun)
        for begin, end in phrases
        if (noun := _noun(words, (begin, end)))
    ]
    if intent == "use":
        marks: list[Set[str]] = [{"use"}, {"with"}, {"from"}, HOLD_VERBS]
    else:
        marks = [HANDOVER_VERBS | RECIPIENTS | HOLD_VERBS]
    first = [noun for mark in marks for governor, noun in nouns if governor in mark][:1]
    if intent == "use" and not first:
        first = [tool for i in use_verbs if (tool := USE_VERBS[words[i]])][:1]
    return tuple(dict.fromkeys(first + [noun for _, noun in nouns]))


def _colour(
    words: list[str], phrases: list[tuple[int, int]], objects: tuple[str, ...]
) -> str | None:
    """The colour in the phrase of the object, or one that stands alone ("the red one")."""
    for begin, end in phrases:
        noun = _noun(words, (begin, end))
        run = words[begin:end]
        named = [COLOUR_WORDS[w] for w in run if w in COLOUR_WORDS]
        alone = noun is None and not any(w in PART_WORDS for w in run)
        if named and (alone or (objects and noun == objects[0])):
            return named[0]
    return None
