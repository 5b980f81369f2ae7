"""The bones of a sentence: words, verbs with who does them, and the phrases that hang on them.

Shallow on purpose: no tree, only what tells apart "hold the blade", "do not hold the blade" and
"so that I can hold the blade". Punctuation does not matter.
"""

import re
from dataclasses import dataclass
from functools import cache
from typing import Literal

from tog_drake.lexicon import LEXICON

Sense = Literal["use", "handover", "hold", "mishap"]
G = LEXICON.grammar

_MAX_LINK = 8  # words between a verb and its subject or its "not"
_MIN_TYPO = 5  # letters of a word that may be misspelt


@dataclass(frozen=True)
class Verb:
    """A verb that moves something, and whose doing it is."""

    at: int  # index of the word
    word: str
    sense: Sense
    by_robot: bool  # False: the person does it ("so that I can take it")
    negated: bool


@dataclass(frozen=True)
class Phrase:
    """A run of words that can hold a noun, a part or a colour: "the red mug handle"."""

    begin: int
    end: int
    words: tuple[str, ...]
    lead: str  # the preposition, verb or other word that it hangs on; "" for none
    verb: Verb | None  # of its clause
    negated: bool


def words_of(text: str) -> list[str]:
    """Lower-case words in their plain form; an entry of several words is one."""
    plain = re.sub("[’‘`´]", "'", text.casefold())
    plain = re.sub(r"(\w)'(ll|d|m|ve|re)\b", r"\1 \2 ", plain)
    plain = re.sub(r"'s\b", "", plain).replace("'", "")
    words = []
    for word in re.findall(r"[^\W_]+", plain):
        words += LEXICON.contractions.get(word, word).split()
    merged = _merged(words)
    # "a pair of scissors" is scissors.
    pairs = zip(merged, [*merged, ""][1:], strict=True)
    amount = {i for i, (word, after) in enumerate(pairs) if word in G.measures and after == "of"}
    return [word for i, word in enumerate(merged) if not {i, i - 1} & amount]


def _merged(words: list[str]) -> list[str]:
    """Joins entries of several words; the others are put into their plain form."""
    merged = []
    i = 0
    while i < len(words):
        for phrase, one in LEXICON.phrases.items():
            run = words[i : i + len(phrase)]
            same = len(run) == len(phrase) and all(
                p in (w, lemma(w)) for p, w in zip(phrase, run, strict=True)
            )
            # "pointing away from me" forbids nothing.
            to_person = one == "not" and at(words, i + len(phrase)) in G.recipients
            if same and not to_person:
                merged.append(one)
                i += len(phrase)
                break
        else:
            merged.append(lemma(words[i]))
            i += 1
    return merged


@cache
def lemma(word: str) -> str:
    """A word without its ending, if that makes it known; a slip of the pen is mended."""
    if word in LEXICON.vocabulary or len(word) < 4:
        return word
    stems = [word[:-1], word[:-2]] if word.endswith("s") else []
    if word.endswith("ves"):
        stems += [word[:-3] + "f", word[:-3] + "fe"]
    for ending in ("ing", "ed"):
        if word.endswith(ending):
            base = word[: -len(ending)]
            stems += [base, base + "e", base[:-1]]
    for stem in stems:
        if stem in LEXICON.vocabulary:
            return stem
    if word.endswith("s") and not word.endswith("ss"):
        word = word[:-1]
    return _mended(word)


def _mended(word: str) -> str:
    """The one noun, part or verb that two swapped letters or one within too many or few make.

    No letter is exchanged for another: "candle" is no "handle", "wallet" no "mallet"; the first
    and last letter stay unless they are swapped: "whisky" is no "whisk".
    """
    if len(word) < _MIN_TYPO:
        return word
    swapped = {word[:i] + word[i + 1] + word[i] + word[i + 2 :] for i in range(1, len(word) - 1)}
    shorter = {word[:i] + word[i + 1 :] for i in range(1, len(word) - 1)}
    known = [w for w in _mendable() if w in swapped or w in shorter or _longer(w, word)]
    return known[0] if len(known) == 1 else word


@cache
def _mendable() -> tuple[str, ...]:
    words = {*LEXICON.rules, *LEXICON.parts, *LEXICON.verbs}
    return tuple(sorted(w for w in words if len(w) >= _MIN_TYPO))


def _longer(known: str, word: str) -> bool:
    """Whether ``known`` has one letter more within."""
    if len(known) != len(word) + 1:
        return False
    return any(known[:i] + known[i + 1 :] == word for i in range(1, len(known) - 1))


def at(words: list[str], i: int) -> str:
    """The word in place ``i``; "" where there is none."""
    return words[i] if 0 <= i < len(words) else ""


def verbs_of(words: list[str]) -> list[Verb]:
    """The verbs, in order."""
    found: list[Verb] = []
    for i in range(len(words)):
        sense = _sense(words, i)
        if sense is None:
            continue
        negated = _negated_verb(words, i, found)
        if negated and words[i] in G.mishaps:  # "do not drop it"
            sense = "mishap"
        found.append(Verb(i, words[i], sense, _by_robot(words, i, found, sense), negated))
    return found


def _sense(words: list[str], i: int) -> Sense | None:
    word = words[i]
    if word in {"need", "want", "like"}:
        return "handover" if _is_wish(words, i) else None
    if _is_handover(words, i):
        return "handover"
    if word not in LEXICON.verbs or word in G.harmless or not _can_be_verb(words, i):
        return None
    if word in LEXICON.use_verbs:
        return "use"
    if word in G.hold_verbs:
        return "hold"
    return "mishap" if word in G.mishaps else None


def _can_be_verb(words: list[str], i: int) -> bool:
    """Whether word i is a verb where it stands and not a noun: "the drill", "a drink"."""
    word, before, after = words[i], at(words, i - 1), at(words, i + 1)
    if before in (G.determiners - {"this", "that", "these", "those"}) | set(LEXICON.colours):
        return False
    if before == "of" or (word == "use" and before != "for" and after == "of"):
        return False
    if word not in G.noun_or_verb:
        return True
    if word == "use" and before == "for":
        return True
    opens = before in G.openers | G.modals | G.person | G.negators | G.joining | {"", "for", "help"}
    opens |= before in G.recipients and at(words, i - 2) in {"let", "help"}
    takes = after in G.determiners | G.prepositions | G.recipients | {"it", "one", "something"}
    return opens and (takes or word == "use" or before == "for" or (not after and before != ""))


def _is_wish(words: list[str], i: int) -> bool:
    """ "I need the hammer", "we would like a mug": not "I want to", "I want you to"."""
    lead = words[max(0, i - 3) : i]
    after = at(words, i + 1)
    asks = bool(G.person & set(lead)) and not set(lead) & (G.negators | {"you", "as"})
    return asks and after not in G.robot | {"to", "", "it"} | G.recipients


def _is_handover(words: list[str], i: int) -> bool:
    word, before, after = words[i], at(words, i - 1), at(words, i + 1)
    if word == "hand":
        mine = at(words, i - 2) in {"in", "into", "to", "onto"} and before in G.determiners
        opens = before in G.openers | G.modals | G.negators | {""}
        named = opens and (after in LEXICON.rules or after in LEXICON.colours)
        takes = after in G.recipients | G.determiners | {"over", "it", "to"}
        return mine or named or (takes and before not in G.determiners | {"left", "right", "one"})
    if after in G.recipients and word in {"get", "grab", "find", "pick", "take", "show", "put"}:
        return at(words, i + 2) not in {"by", "to", ""}  # "get me the mug", not "take me to"
    if word in {"have", "get", "borrow"}:
        return before in {"i", "me"} and "so" not in words[max(0, i - 5) : i]  # "can I have"
    if word not in G.handover_verbs:
        return False
    return before not in G.determiners and (word not in G.noun_or_verb or _can_be_verb(words, i))


def _by_robot(words: list[str], i: int, earlier: list[Verb], sense: Sense) -> bool:
    """Whether the robot is asked to do verb i, and not the person's own doing is told."""
    if at(words, i + 1) in G.recipients and sense == "handover":
        return True
    if words[i] in {"have", "get", "borrow", "need", "want", "like"} and sense == "handover":
        return True
    if at(words, i - 1) in G.recipients and at(words, i - 2) in {"let", "so"}:
        return False
    last = earlier[-1] if earlier else None
    for j in range(i - 1, max(-1, i - _MAX_LINK - 1), -1):
        word = words[j]
        if last is not None and j == last.at:
            return last.by_robot or (last.sense == "handover" and _tells_robot(words, j, i))
        if word in G.person:
            return False
        if word in G.recipients and at(words, j - 1) == "for" and words[j + 1 : i] == ["to"]:
            return False  # "for me to drink"
        if word in G.robot or word not in G.modals | {"lets"}:
            return True
    return True


def _tells_robot(words: list[str], verb: int, i: int) -> bool:
    """After a wish ("I need the hammer to drive a nail") a purpose is the person's own."""
    return (
        words[verb] not in {"need", "want", "like", "have", "get", "borrow"}
        or "to" not in (words[verb + 1 : i])
    )


def _negated_verb(words: list[str], i: int, earlier: list[Verb]) -> bool:
    """Whether a "not" forbids verb i; "do not hesitate to" and "why do not you" forbid nothing."""
    last = earlier[-1] if earlier else None
    for j in range(i - 1, max(-1, i - _MAX_LINK - 1), -1):
        word = words[j]
        if last is not None and j == last.at:
            return last.negated and bool({"or", "nor"} & set(words[j + 1 : i]))
        if word in G.negators:
            asks = at(words, j + 1) == "you" and (
                at(words, j - 1) in {"can", "could", "will", "would"} or at(words, j - 2) == "why"
            )
            return not asks and at(words, j + 1) != "only" and at(words, i + 1) != "only"
        if word not in G.modals | G.robot | G.openers | G.joining | {"ever", "it", "even"}:
            return False
        if word in G.harmless or word in {"but", "please"}:
            return False
    return False


def phrases_of(words: list[str], verbs: list[Verb]) -> list[Phrase]:
    """The runs between words of grammar, with what each hangs on."""
    at_verb = {verb.at: verb for verb in verbs}
    found: list[Phrase] = []
    begin = 0
    for i in range(len(words) + 1):
        if i == len(words) or _ends_phrase(words, i) or i in at_verb:
            if i > begin:
                found.append(_phrase(words, begin, i, verbs, found))
            begin = i + 1
    return found


def _ends_phrase(words: list[str], i: int) -> bool:
    word = words[i]
    if word in LEXICON.parts:  # "back", "side": a part only where it is said like a noun
        return word in LEXICON.function_words and at(words, i - 1) not in G.determiners
    return word in LEXICON.function_words


def _phrase(
    words: list[str], begin: int, end: int, verbs: list[Verb], earlier: list[Phrase]
) -> Phrase:
    before = [verb for verb in verbs if verb.at < begin]
    verb = before[-1] if before else None
    j = begin - 1
    while j >= 0 and words[j] in G.determiners | G.measures | {"only", "end", "side", "it"}:
        j -= 1
    if verb is not None and j == verb.at + 1 and words[j] in G.particles:
        j = verb.at  # "hand over the mug", "pick up the mug"
    if at(words, j) == "to" and at(words, j - 1) in G.locatives:  # "next to the mug"
        j -= 1
    lead = at(words, j)
    negated = _negated_phrase(words, begin, verb, earlier)
    return Phrase(begin, end, tuple(words[begin:end]), lead, verb, negated)


def _negated_phrase(words: list[str], begin: int, verb: Verb | None, earlier: list[Phrase]) -> bool:
    """Whether a "not" reaches a phrase: over no other part but by "or", and over no "but"."""
    last = earlier[-1] if earlier else None
    first = max(verb.at + 1 if verb else 0, begin - _MAX_LINK)
    for j in range(begin - 1, first - 1, -1):
        word = words[j]
        if word in G.negators:
            return at(words, j + 1) != "only"
        if word in {"but", "instead"}:
            return False
        if last is not None and last.begin <= j < last.end and set(last.words) & set(LEXICON.parts):
            between = set(words[last.end : begin])
            joined = between & {"or", "nor", "and"} and between <= G.joining | G.determiners
            return last.negated and bool(joined)
    if verb is not None and verb.word in {"keep", "stay"} and "off" in words[verb.at : begin]:
        return True
    return verb is not None and verb.negated
