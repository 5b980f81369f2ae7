"""What a task asks for, in words alone: no picture, no geometry, no ground truth.

``read_task`` is shared by the geometric selector, which looks for the words in the cloud, and by
the judge of task compliance, which maps them to the labelled parts of an object. It reads plain
English by the words of ``lexicon`` and the bones of the sentence (``grammar``); what it does not
understand it names.
"""

from dataclasses import dataclass
from typing import Literal

from tog_drake.errors import InputError
from tog_drake.grammar import G, Phrase, Verb, at, phrases_of, verbs_of, words_of
from tog_drake.lexicon import LEXICON

Intent = Literal["use", "handover", "hold"]
_Role = Literal["hold", "avoid"]

MAX_TASK_LENGTH = 1000  # characters; a task is a sentence or two


@dataclass(frozen=True)
class TaskReading:
    """The words of a task that matter for where to grasp.

    ``parts``, where not empty, override ``intent``: "use the mug, by the rim" means the rim.
    """

    text: str  # as given
    intent: Intent | None  # None: the words do not say
    parts: tuple[str, ...]  # parts to hold, by their names in the lexicon, in the order named
    avoid: tuple[str, ...]  # parts not to hold, likewise
    colour: str | None  # of the object to grasp, by its name in the lexicon
    objects: tuple[str, ...]  # nouns, the one most likely to be grasped first
    unknown: tuple[str, ...] = ()  # words that say where or what for, but are not understood
    forbidden: bool = False  # the task says to leave things alone: "don't pick anything up"


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
    words = words_of(text)
    if not words:
        raise InputError(
            f"The task {text.strip()!r} has no words. Say what to do, such as 'hand me the hammer'."
        )
    verbs = verbs_of(words)
    phrases = phrases_of(words, verbs)
    intent = _intent(verbs)
    parts, avoid = _parts(words, phrases)
    objects, colour = _objects(words, verbs, phrases, intent, parts + avoid)
    return TaskReading(
        text=text,
        intent=intent,
        parts=parts,
        avoid=avoid,
        colour=colour,
        objects=objects,
        unknown=_unknown(words, phrases, said=bool(intent or parts or avoid)),
        forbidden=not parts and not avoid and _is_forbidden(words, verbs, phrases),
    )


def _intent(verbs: list[Verb]) -> Intent | None:
    """The first verb that asks for use or handover; else hold, where a verb says so."""
    asked = [verb for verb in verbs if verb.by_robot and verb.sense != "mishap"]
    for verb in asked:
        if not verb.negated and verb.sense in {"use", "handover"}:
            return "use" if verb.sense == "use" else "handover"
    # "do not grab it by the handle" still asks to hold it.
    return "hold" if any(verb.sense == "hold" for verb in asked) else None


def _is_forbidden(words: list[str], verbs: list[Verb], phrases: list[Phrase]) -> bool:
    """Whether the task asks to leave things alone and for nothing else."""
    acts = [verb for verb in verbs if verb.by_robot and verb.sense != "mishap"]
    if any(not verb.negated for verb in acts):
        return False
    return bool(
        any(verb.negated for verb in acts)
        or any(phrase.negated for phrase in phrases if phrase.verb is None)
        or G.stops & set(words)
    )


def _parts(words: list[str], phrases: list[Phrase]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Parts to hold and parts to avoid, each once, in the order named."""
    roles: dict[_Role, dict[str, None]] = {"hold": {}, "avoid": {}}
    for phrase in phrases:
        for i in range(phrase.begin, phrase.end):
            if words[i] in LEXICON.parts and _means_part(words, i, phrase):
                role = _role(words, i, phrase)
                if role is not None:
                    roles[role][LEXICON.parts[words[i]]] = None
    avoid = tuple(roles["avoid"])
    return tuple(part for part in roles["hold"] if part not in avoid), avoid


def _means_part(words: list[str], i: int, phrase: Phrase) -> bool:
    """Whether a part word means one: not "a bowl", "on top of the box", "by the back wall"."""
    word, before, after = words[i], at(words, i - 1), at(words, i + 1)
    if word == "front" and after in LEXICON.parts:
        return False  # "its front legs" are legs
    if word in G.vague_parts:
        if after == "of" and at(words, i + 2) in G.determiners and phrase.lead not in G.locatives:
            return True
        by = phrase.lead in {"by", "at", "from", "around", "with"} or before in G.determiners
        owned = before in LEXICON.rules
        held = (phrase.verb is not None and phrase.lead == phrase.verb.word) or phrase.negated
        offered = _is_offered(words, i)
        if LEXICON.parts[word] == "middle" and phrase.lead == "in":
            return True
        return phrase.lead not in G.locatives - {"around"} and (
            phrase.lead in {"by", "at", "from", "around"} or (held and (by or owned)) or offered
        )
    if word == "bowl":  # of a spoon only where it is said so
        owned = after == "of" or before in LEXICON.rules or before in {"its", "s"}
        end = after in {"end", "side"}
        return (
            owned
            or end
            or phrase.lead in {"by", "at"}
            or (phrase.negated and phrase.lead in {"by", "touch"})
        )
    return not (word in {"head", "neck"} and phrase.lead in {"over", "above"})


def _role(words: list[str], i: int, phrase: Phrase) -> _Role | None:
    """What a task says of a part: to hold it, to keep off it, or neither."""
    verb, lead, part = phrase.verb, phrase.lead, LEXICON.parts[words[i]]
    if _points_away(words, i):
        return None
    if phrase.negated:
        return "avoid"
    if _is_offered(words, i):
        return "hold" if at(words, i + 2) in G.robot or at(words, i + 3) in G.robot else "avoid"
    if _is_bad(words, i):
        return "avoid"
    if verb is None:
        return "hold" if lead != "with" or part == "handle" else None
    if not verb.by_robot:  # what the person will hold is left free
        return "avoid" if verb.sense in {"hold", "handover"} and verb.word != "want" else None
    if lead in {"by", "at", "around"}:
        return "hold"
    if lead in {"with", "using"}:
        described = at(words, i - 1) not in G.determiners | {"with", "using"} | set(LEXICON.rules)
        return "hold" if part == "handle" and not described else None
    if verb.sense == "handover":  # "give me the handle": then the person holds it
        return "avoid" if lead in G.recipients | {verb.word} else "hold"
    if verb.sense == "use":
        return _role_in_use(words, i, phrase, verb)
    if verb.sense == "mishap":
        return None
    return "hold"


def _role_in_use(words: list[str], i: int, phrase: Phrase, verb: Verb) -> _Role | None:
    """ "clean the blade" acts on the blade, "use the head" with it; "squeeze the trigger" holds."""
    part = LEXICON.parts[words[i]]
    if phrase.lead in {"on", "in", "into", "onto", "from", "against", "for", "to"}:
        return None
    if verb.word == "use" or verb.word == "operate":
        return "hold" if part == "handle" else None
    if verb.word in G.grip_verbs:
        return "hold"
    return "avoid"


def _is_offered(words: list[str], i: int) -> bool:
    """ "handle first", "the handle facing me", "leave the handle free"."""
    j = i + 2 if at(words, i + 1) in {"is", "end", "side", "part"} else i + 1
    after, then = at(words, j), at(words, j + 1)
    if after not in G.offered:
        return False
    people = G.recipients | G.robot | {"the", "my", "person", "human", "user"}
    if after in {"facing", "towards", "toward", "pointing"}:
        return then in people or then in {"towards", "toward", "to", "at", "out", "outward"}
    if after in {"for", "to"}:
        return then in G.recipients and at(words, j + 2) not in {"to"}
    return after != "first" or then not in G.determiners | {"then"}


def _is_bad(words: list[str], i: int) -> bool:
    """ "the handle is hot", "by the part that is not hot" apart."""
    copula, tail = at(words, i + 1), words[i + 2 : i + 5]
    return copula in {"is", "are", "look", "looks", "was", "get", "feels"} and (
        bool(G.bad & set(tail)) and "not" not in tail
    )


def _points_away(words: list[str], i: int) -> bool:
    """ "with the blade pointing away from me" names no part to hold."""
    return "away" in words[i + 1 : i + 4] and not set(words[i + 1 : i + 4]) & {"by", "not"}


def _objects(
    words: list[str],
    verbs: list[Verb],
    phrases: list[Phrase],
    intent: Intent | None,
    parts: tuple[str, ...],
) -> tuple[tuple[str, ...], str | None]:
    """Nouns, first the one that is used, handed over or held; and the colour of that one."""
    nouns = [(phrase, noun) for phrase in phrases if (noun := _noun(phrase, parts))]
    meant = [
        (phrase, noun)
        for phrase, noun in nouns
        if not phrase.negated and phrase.lead not in G.locatives - {"around"}
    ]
    if not meant:  # "do not touch the mug"
        meant = [(phrase, noun) for phrase, noun in nouns if phrase.lead not in G.locatives]
    first = _first(meant, intent)
    if intent == "use" and first is None:
        first = _implied(verbs, parts)
    if first is None and meant:
        first = next((n for _, n in meant if n in LEXICON.rules), meant[0][1])
    rest = [noun for _, noun in sorted(nouns, key=lambda item: item[0].negated)]
    objects = tuple(dict.fromkeys(([first] if first else []) + rest)) if meant or first else ()
    return objects, _colour(phrases, objects, parts)


def _first(nouns: list[tuple[Phrase, str]], intent: Intent | None) -> str | None:
    marks: list[frozenset[str]] = [frozenset({"use"}), frozenset({"with", "using"})]
    marks += [frozenset({"from"}), G.hold_verbs | G.handover_verbs | G.recipients]
    for mark in marks if intent == "use" else [marks[-1] | {"need", "want", "like", "have"}]:
        marked = [noun for phrase, noun in nouns if phrase.lead in mark]
        known = [noun for noun in marked if noun in LEXICON.rules]
        if known or (marked and mark != {"from"}):
            return (known or marked)[0]
    return None


def _implied(verbs: list[Verb], parts: tuple[str, ...]) -> str | None:
    """The tool that a verb implies; none where it acts on a part: "unscrew the cap"."""
    for verb in verbs:
        if verb.by_robot and not verb.negated and verb.sense == "use":
            tool = LEXICON.use_verbs.get(verb.word, "")
            if tool and not parts:
                return tool
    return None


def _noun(phrase: Phrase, parts: tuple[str, ...]) -> str | None:
    """The last word of a phrase that is neither part nor colour; a lone colour is a fruit."""
    run = phrase.words
    bare = [w for w in run if w not in LEXICON.colours and w not in LEXICON.parts]
    known = [w for w in bare if w in LEXICON.rules]
    if known or bare:
        return (known or bare)[-1]
    if LEXICON.parts.get(run[-1]) == "bowl" and "bowl" not in parts:
        return run[-1]
    return "orange" if run == ("orange",) else None


def _colour(phrases: list[Phrase], objects: tuple[str, ...], parts: tuple[str, ...]) -> str | None:
    """The colour in the phrase of the object, or one that stands alone ("the red one")."""
    for phrase in phrases:
        noun = _noun(phrase, parts)
        named = [LEXICON.colours[w] for w in phrase.words if w in LEXICON.colours]
        alone = noun is None and not any(w in LEXICON.parts for w in phrase.words)
        if named and not phrase.negated and (alone or (objects and noun == objects[0])):
            return named[0]
    return None


def _unknown(words: list[str], phrases: list[Phrase], *, said: bool) -> tuple[str, ...]:
    """What is not understood: "by the gizmo"; where nothing else is said, every strange word."""
    strange = [
        w
        for phrase in phrases
        for w in phrase.words
        if w not in LEXICON.vocabulary
    ]  # fmt: skip
    if not said:
        return tuple(dict.fromkeys(strange))
    named = {*LEXICON.rules, *LEXICON.parts, *LEXICON.colours, *G.places, *G.measures}
    found = [
        phrase.words[-1]
        for phrase in phrases
        if phrase.lead == "by" and not set(phrase.words) & named
    ]
    return tuple(dict.fromkeys(found))


def target_words(task: str, target: str | None = None) -> str:
    """Returns the words of the object that a task is about, such as "red mug".

    Args:
        task: what a person said.
        target: the words where they are given; then the task is not read.

    Returns:
        The colour and the noun as far as the task names them; "" where it names neither.
    """
    if target is not None or not task.strip():
        return target or ""
    reading = read_task(task)
    return " ".join(word for word in (reading.colour, *reading.objects[:1]) if word)
