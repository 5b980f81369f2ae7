"""What a task asks for, in words alone: no picture, no geometry, no ground truth.

``read_task`` is shared by the geometric selector, which looks for the words in the cloud, and by
the judge of task compliance, which maps them to the labelled parts of an object. It reads plain
English by small word lists and the order of words; what it does not know it leaves out.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from tog_drake.errors import InputError

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


def _table(**rows: str) -> dict[str, str]:
    """Turns ``name="synonym synonym"`` into {synonym: name, name: name}."""
    return {word: name for name, words in rows.items() for word in [name, *words.split()]}


PART_WORDS = _table(
    handle="grip handgrip haft hilt loop",
    head="face",
    blade="",
    shaft="rod shank stem",
    tip="point",
    bowl="",
    bristles="bristle",
    body="barrel belly torso",
    rim="lip brim edge",
    cap="lid cork stopper",
    spout="nozzle",
    tail="",
    leg="foot feet paw",
    claw="",
    neck="",
    base="bottom battery",
    chuck="",
    trigger="",
    horn="",
    top="",
    middle="centre center",
)
"""Words for parts and the one name that stands for each group."""

COLOUR_WORDS = _table(
    red="crimson maroon scarlet",
    orange="",
    yellow="golden gold",
    green="lime olive",
    cyan="turquoise teal",
    blue="navy",
    purple="violet",
    pink="magenta",
    brown="tan beige wooden",
    black="",
    white="",
    grey="gray silver",
)
"""Words for colours and the one name that stands for each group."""


def _set(words: str) -> frozenset[str]:
    return frozenset(words.split())


# Verbs that ask to use the object as it is meant to be used, by the tool that each implies.
_USE_VERBS = {
    verb: tool
    for tool, verbs in {
        "hammer": "hammer nail pound",
        "brush": "brush scrub sweep paint",
        "screwdriver": "screw unscrew tighten loosen",
        "knife": "cut slice chop carve",
        "spoon": "stir scoop",
        "spatula": "flip",
        "mug": "drink sip",
        "drill": "drill",
        "saw": "saw",
        "whisk": "whisk",
        "": "use using drive hit strike knock beat pry pour fill eat serve spread fry cook write "
        "draw dig squeeze spray shake clean wash wipe mix peel operate play bake",
    }.items()
    for verb in verbs.split()
}
# Verbs above that are as often nouns: verbs only where a sentence can have one.
_NOUN_OR_VERB = _set("hammer nail brush paint screw drill saw whisk drink cut scoop spray play use")
_HANDOVER_VERBS = _set("give pass bring deliver offer handover fetch lend present")
_HOLD_VERBS = _set(
    "hold grab grasp grip take pick lift get carry move raise clutch seize pinch touch keep put "
    "place clear remove"
)
_MISHAPS = _set("drop spill break damage hurt scratch crush bend")
_RECIPIENTS = _set("me us him her them")
_PERSON = _set("i we he she they")
_DETERMINERS = _set("the a an my your his her its their our this that these those some")
_OPENERS = _set("please to and then now you robot just only gently carefully quickly lets kindly")
_PREPOSITIONS = _set(
    "by at around near along via on in into onto to from against under over off with of for "
    "towards toward behind beside next between inside through without"
)
_NEGATORS = _set(
    "not dont never avoid avoiding without except excluding neither nor cannot cant shouldnt "
    "mustnt doesnt no"
)
_NEGATING_PAIRS = {
    ("away", "from"), ("instead", "of"), ("rather", "than"), ("other", "than"), ("anywhere", "but"),
    ("anything", "but"), ("clear", "of"), ("keep", "off"), ("stay", "off"), ("hands", "off"),
}  # fmt: skip
_JOINING = _set("or nor and by at")
# "the knife, handle first": the part is for the person, so the robot must leave it free.
_OFFERED = _set("first facing towards toward pointing forward free clear accessible")
_VERBS = (_USE_VERBS.keys() - _NOUN_OR_VERB) | {"use", "open"} | _HANDOVER_VERBS | _HOLD_VERBS
_VERBS |= _MISHAPS
_STOP = (
    _VERBS | _RECIPIENTS | _PERSON | _DETERMINERS | _OPENERS | _PREPOSITIONS | _NEGATORS | _OFFERED
) | _set(
    "it one ones is are was be been being can could will would should shall may might must do does "
    "did have has had need want like so which who where when while if but or rather instead than "
    "other anywhere anything all up down out away back here there very way time thing object item "
    "care end side part direction hand as ready let make made sure try used both any each s t"
)


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
    if word in PART_WORDS or word in _STOP or len(word) < 4 or word.endswith(("ss", "scissors")):
        return word
    stem = word[:-1] if word.endswith("s") else word
    if stem.endswith("ing") and stem not in _STOP:  # cutting, pouring, driving
        base = stem[:-3]
        for verb in (base, base + "e", base[:-1]):
            if verb in _USE_VERBS or verb in _HOLD_VERBS:
                return verb
    return stem


def _at(words: list[str], i: int) -> str:
    return words[i] if 0 <= i < len(words) else ""


def _is_use_verb(words: list[str], i: int) -> bool:
    """Whether word i asks the robot to use something; nouns and the person's own doing do not."""
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    if word not in _USE_VERBS or before in _DETERMINERS or before in COLOUR_WORDS:
        return False
    if word in _NOUN_OR_VERB:
        opens = before in _OPENERS or before in {"", "for"}
        takes = after in _DETERMINERS | _PREPOSITIONS | {"it", "one", "something"}
        if not (opens and (takes or word == "use" or before == "for")):
            return False
    lead = words[max(0, i - 4) : i]
    for_person = _PERSON & set(lead) or ("for" in lead and _RECIPIENTS & set(lead))
    return not for_person or "you" in lead or "robot" in lead


def _is_handover(words: list[str], i: int) -> bool:
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    if word in {"hand", "hands"}:
        mine = _at(words, i - 2) in {"in", "into", "to"} and before in _DETERMINERS
        verb = after in _RECIPIENTS | _DETERMINERS | {"over", "it"}
        return mine or (verb and before not in _DETERMINERS | {"left", "right", "one"})
    if after in _RECIPIENTS and word in {"get", "grab", "find", "pick", "take", "show"}:
        return _at(words, i + 2) not in {"by", "to", ""}  # "get me the mug", not "take me to"
    if word == "have" and before in {"i", "me"}:
        return True  # "can I have the mug", "let me have it"
    return word in _HANDOVER_VERBS and before not in _DETERMINERS


def _intent(words: list[str], use_verbs: list[int]) -> Intent | None:
    """The first verb that asks for use or handover; else hold, where a verb says so."""
    for i, word in enumerate(words):
        if i in use_verbs:
            return "use"
        if _is_handover(words, i):
            return "handover"
        if word == "for" and _at(words, i + 1) == "use":
            return "use"
    return "hold" if _HOLD_VERBS & set(words) else None


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
    while j >= 0 and (words[j] in _DETERMINERS or words[j] not in _STOP or words[j] == "only"):
        j -= 1
    return j


def _is_object_or_verb(words: list[str], i: int) -> bool:
    """Whether a part word means something else: "handle it with care", "a bowl", "on top of"."""
    word, before, after = words[i], _at(words, i - 1), _at(words, i + 1)
    first = before in _OPENERS or before == ""
    if word in {"handle", "head", "grip", "face", "point", "top"} and first:
        return after in _DETERMINERS | {"it", "to", "with", "at"}
    if word in {"top", "point", "face", "edge", "middle", "centre", "center", "bottom", "base"}:
        return _at(words, _governor(words, i)) not in {"by", "at", "from"} | _HOLD_VERBS
    if word == "bowl":  # of a spoon only where it is said so
        said = _at(words, _governor(words, i)) == "by" or _at(words, i + 1) == "of"
        return not (said or (before not in _STOP | set(COLOUR_WORDS) and before != ""))
    return False


def _is_avoided(words: list[str], i: int) -> bool:
    after = _at(words, i + 1)
    if after in {"is", "facing", "pointing", "end", "side"}:
        after = _at(words, i + 2) if after in {"is", "end", "side"} else after
    if after in _OFFERED and not _points_away(words, i):
        return True
    lead = words[max(0, i - 8) : i]
    if "so" in lead and _PERSON & set(lead[lead.index("so") :]) and "you" not in lead:
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
        if words[j] in _NEGATORS or (_at(words, j - 1), words[j]) in _NEGATING_PAIRS:
            return words[j + 1] != "only"
        if words[j] in PART_WORDS:
            between = set(words[j + 1 : i])
            joined = between & {"or", "nor", "and"} and between <= _JOINING | _DETERMINERS
            return bool(joined) and _is_negated(words, j)
        verbs += words[j] in _VERBS
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
        if i == len(words) or words[i] in _STOP or i in use_verbs:
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
        marks: list[frozenset[str]] = [_set("use"), _set("with"), _set("from"), _HOLD_VERBS]
    else:
        marks = [_HANDOVER_VERBS | _RECIPIENTS | _HOLD_VERBS]
    first = [noun for mark in marks for governor, noun in nouns if governor in mark][:1]
    if intent == "use" and not first:
        first = [tool for i in use_verbs if (tool := _USE_VERBS[words[i]])][:1]
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
