"""The label that a model chooses, in what it said.

A number or a colour in a text is seldom a choice: it is counted, compared, rejected, asked about.
So a label is an answer only where the words around it are known to say so, and everything else is
``Unanswered``; the model is then asked once more, which costs less than a wrong grasp. Looked at in
this order:

1. the last JSON with a key for the choice;
2. the last "Final answer:", which is final: earlier words do not count where it names no label;
3. the last sentence, if it has a word of choosing, such as in "3 is the best", and none of doubt,
   and its number counts nothing; or the label, if that is all.
"""

import re
from typing import Any

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.json_in_text import find_values


def read_label(text: str, labels: tuple[str, ...]) -> str:
    """Returns the one label that ``text`` chooses.

    Raises:
        Unanswered: empty (it chooses none), refused, ambiguous (several, or one that is taken
            back), out_of_range (no label) or unreadable (what it says is no choice).
    """
    if _BLIND.search(text):
        raise Unanswered("refused", f"the model sees no image: {text[:80]!r}")
    by_word = {label.lower(): label for label in labels}
    chosen, has_objects = _in_json(text, by_word)
    end = text.rfind("}") + 1 if chosen is not None else 0
    if (final := _final(text, end, by_word)) is not None:
        chosen, end = final
    if chosen is not None:
        _refuse_what_is_taken_back(chosen, text[end:], by_word)
        return chosen
    refuse_what_is_no_answer(text)
    if has_objects:
        raise Unanswered("unreadable", "the JSON has no key 'choice'")
    return _in_sentences(_MARKUP.sub("", text).strip(), by_word)


# What is no answer


_BLIND = re.compile(
    r"(?:can ?not|can['’]t|unable to|not able to|don['’]t|do not|did not|didn['’]t)"
    r" (?:actually )?(?:view|see|access|process|have access to|receive|open)"
    r" (?:the |any |an |this |these |your |attached )*(?:image|picture|photo)s?\b",
    re.IGNORECASE,
)
"""What is chosen then, where the form of an answer is enforced, is made up."""
_REFUSES = re.compile(
    r"\bsorry\b|\bas an ai\b|\bwithout the image\b"
    r"|\b(?:can ?not|can['’]t|won['’]t|unable to|not able to|decline to)"
    r" (?:assist|help|process|comply|provide|answer|determine|view|see (?:the|any|an) image)\b",
    re.IGNORECASE,
)
_NONE = re.compile(r"\bthere (?:are|is) none\b|^\W{0,9}none\W{0,9}$", re.IGNORECASE)
_CHOOSES_NONE = re.compile(
    r"\W{0,9}(?:(?:none|neither|nothing|null|nil|no)\b|n\W?a\b)", re.IGNORECASE
)
_TAKES_BACK = re.compile(
    r"\b(?:wait|actually|correction|correct myself|second thoughts?|instead|none|neither|sorry"
    r"|however|hmm+|mistake|mistaken|wrong|changed? my mind|rather|reconsider|ignore|disregard"
    r"|can ?not)\b|can['’]t\b|\bno[,:]",
    re.IGNORECASE,
)


def refuse_what_is_no_answer(text: str) -> None:
    """Raises Unanswered where the words of ``text`` say in which way it is no answer."""
    if _NONE.search(text):
        raise Unanswered("empty", "the model says that there is none")
    if _REFUSES.search(text):
        raise Unanswered("refused", f"the model refuses: {text[:80]!r}")


def _refuse_what_is_taken_back(chosen: str, after: str, by_word: dict[str, str]) -> None:
    """Raises Unanswered where what follows a choice speaks against it, or makes another."""
    if _TAKES_BACK.search(after):
        raise Unanswered("ambiguous", f"{chosen} may be taken back: {after[-80:]!r}")
    if others := _choices_in(_sentences(after), by_word) - {chosen}:
        raise Unanswered("ambiguous", f"first {chosen}, then {', '.join(sorted(others))}")


# A label in a sentence


_TOKEN = re.compile(
    r"(?<![a-zA-Z\d.])[-−]?\d{1,9}(?![a-zA-Z\d%]|\.\d)(?!\s?(?:cm|mm|m|px|pixels?|degrees?|°|kg|g)\b)"
    r"|(?<![a-zA-Z])[a-zA-Z]{1,40}(?![a-zA-Z])"
)
"""Words and whole numbers, but no decimals, shares or measures."""
_COLORS = frozenset(name for name, _ in CANDIDATE_COLORS)
_NOT = re.compile(r"\b(?:not|never|avoid|neither|nor|except)\b|n['’]t\b", re.IGNORECASE)
_DOUBT = re.compile(
    r"\b(?:no|none|cannot|but|unless|if|whether|when|or|would|could|might|may|perhaps|maybe|unsure"
    r"|worst|worse|bad|poor|wrong|fails?|unsuitable|reject\w*|discard\w*|exclud\w*|instead|rather"
    r"|although|though|however|example|format|form|asks?|asked|which|what|step|confidence|scores?"
    r"|rating|count|error|says?|said)\b",
    re.IGNORECASE,
)
"""Words by which a sentence takes back what it names, sets a condition or speaks of another thing;
"which" and "form" since it may be a question, or how an answer is to be written."""
_POLITE = re.compile(r"\bI would\b|\bwould be\b", re.IGNORECASE)  # "I would choose 3" is a choice
_MARKUP = re.compile(r"```[a-z]{0,10}|<\|(?:begin|end)_of_box\|>|\\boxed\b")

_GAP = r"[\s*_\"'“‘`(\[{<|#:$\\,–—-]{0,9}"
_CLOSE = r"[\s*_\"'”’`)\]}>|$.!,;:]{0,9}"
_NOUN = (
    r"(?:grasp|gripper|hand|candidate|option|choice|image|picture|dot|mark|marker|number|label|disc"
    r"|contact|point|colou?r|index)\b"
)
_LABEL = rf"(?:(\d{{1,9}})(?!\d)|([a-z]{{1,40}})\b(?:\s(?:one|{_NOUN}))?)"
_REASON = r"\W{0,3}(?:because|since|as|for)\b.*|\s?[,;:(–—-].*"
_ALONE = re.compile(
    rf"{_GAP}(?:so\b{_GAP})?(?:the\b{_GAP})?(?:{_NOUN}{_GAP}){{0,2}}{_LABEL}{_CLOSE}(?:{_REASON})?",
    re.IGNORECASE | re.DOTALL,
)
"""Nothing but a label, with what it is one of and perhaps why. A noun follows a colour only: "1
grasp" is a count."""
_CHOOSES = re.compile(
    r"\b(?:best|choose|chose|choosing|choice|pick|select\w{0,4}|recommend\w{0,6}|prefer\w{0,4}|take"
    r"|use|go(?:ing)? with|suit\w{0,6}|correct|optimal|ideal|appropriate|answer)\b",
    re.IGNORECASE,
)
_COUNT = re.compile(
    r"\b(?:of|all|these|those|are)\s(?:the\s)?\d"
    r"|\d\s(?:\w{1,20}\s)?(?:of\b|(?:grasp|gripper|hand|candidate|option|choice|image|picture"
    r"|dot|mark|marker|number|disc|contact|point|colou?r|object|step)s?\b)",
    re.IGNORECASE,
)
"""A number that counts: "of 6 grasps", "4 grasps", "there are 4"."""


def _chosen_by(sentence: str, by_word: dict[str, str], *, told: bool = False) -> str | None:
    """Returns the label that a sentence chooses; None where no label is in it.

    Args:
        sentence: to be read.
        by_word: the labels.
        told: whether it was announced as the choice, as by "Final answer:"; else its words must say
            that it is one, or there must be nothing but the label.

    Raises:
        Unanswered: as ``_label_in``; or unreadable, where it has a label but does not choose it.
    """
    label = _label_in(sentence, by_word)
    if label is None:
        return None
    match = _ALONE.fullmatch(sentence)
    word = next(filter(None, match.groups()), "") if match else ""
    alone = by_word.get(str(int(word)) if word.isdigit() else word.lower()) == label
    says_so = alone or told or _CHOOSES.search(sentence)
    doubted = "?" in sentence or _DOUBT.search(_POLITE.sub("", sentence))
    counts = not alone and _COUNT.search(sentence)
    if doubted or counts or not says_so:
        raise Unanswered("unreadable", f"{sentence[:80]!r} does not clearly choose {label}")
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


# JSON


_CHOICE = ("choice", "final_answer", "answer", "best", "selected")
_NAMES = ("index", "number", "color", "colour", "label", "grasp", "candidate", "option", "id")
_BESIDE = frozenset({"reasoning", "reason", "explanation", "thought", "thoughts", "rationale"})


def _in_json(text: str, by_word: dict[str, str]) -> tuple[str | None, bool]:
    """Returns the choice of the last JSON that has one, and whether there are objects at all."""
    objects = [found for found in map(_objects_in, find_values(text)) if found]
    for group in objects:
        chosen = {_chosen_in(value, by_word) for value in group} - {None}
        if len(chosen) > 1:
            raise Unanswered("ambiguous", f"{len(chosen)} choices at once")
        if chosen:
            return chosen.pop(), True
    return None, bool(objects)


def _objects_in(value: Any) -> list[dict[Any, Any]]:
    return [item for item in (value if isinstance(value, list) else [value]) if type(item) is dict]


def _chosen_in(value: dict[Any, Any], by_word: dict[str, str]) -> str | None:
    """Returns the label that a JSON object names; None where it has no key for it.

    A key that only names something, such as "grasp", is one if there is nothing but reasons beside
    it: {"grasp": 3, "suitable": false} is no choice.
    """
    keys = {key.lower(): key for key in value if isinstance(key, str)}
    named = [keys[key] for key in _CHOICE if key in keys]
    if not named and len(keys.keys() - _BESIDE) == 1:
        named = [keys[key] for key in _NAMES if key in keys]
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
    return _said_to_be_chosen(str(chosen), by_word)


# Sentences


_SENTINEL = re.compile(
    r"\bfinal\s{1,3}answer\b(?:[^\w?−-]{0,9}\bis\b|[^\w.?!−-]{0,5}(?:[:=\n*>→–—]|-(?!\d)))[^\w?−-]{0,9}"
    r"|\banswer\b\W{0,5}(?:is\b|:)[^\w?−-]{0,9}",
    re.IGNORECASE,
)
_SENTENCE = re.compile(r"[^\n]*?(?:[.!?](?=\s)|\n|$)")


def _final(text: str, start: int, by_word: dict[str, str]) -> tuple[str, int] | None:
    """Returns what the last "Final answer:" after ``start`` names, and where that ends."""
    sentinel = None
    for sentinel in _SENTINEL.finditer(text, start):  # noqa: B007
        pass
    if sentinel is None:
        return None
    before = _sentences(text[start : sentinel.start()] + "\x00")[-1]
    if _NOT.search(before) or _DOUBT.search(before):
        raise Unanswered("unreadable", f"{before[-80:]!r} may speak against what follows")
    named = _SENTENCE.match(text, sentinel.end())
    assert named is not None  # it matches an empty text, too
    said = _MARKUP.sub("", named.group()).strip()
    return _said_to_be_chosen(said, by_word), named.end()


def _said_to_be_chosen(said: str, by_word: dict[str, str]) -> str:
    """Returns the label in what is told as the choice itself."""
    if not said or _CHOOSES_NONE.match(said):
        raise Unanswered("empty", "the model chooses none")
    label = _chosen_by(said, by_word, told=True)
    if label is None:
        raise Unanswered("unreadable", f"the choice is {said[:80]!r}")
    return label


def _in_sentences(text: str, by_word: dict[str, str]) -> str:
    """Returns the label that free text chooses: in its last sentence, and no other before."""
    sentences = _sentences(text)
    label = _chosen_by(sentences[-1], by_word)
    if label is None:
        raise Unanswered("unreadable", f"no label is found in {text[-80:]!r}")
    if others := _choices_in(sentences[:-1], by_word) - {label}:
        raise Unanswered("ambiguous", f"first {', '.join(sorted(others))}, then {label}")
    return label


def _choices_in(sentences: list[str], by_word: dict[str, str]) -> set[str]:
    """Returns the labels that sentences choose, or that stand alone in one."""
    chosen = set()
    for sentence in sentences:
        if _CHOOSES.search(sentence) or _ALONE.fullmatch(sentence):
            try:
                chosen.add(_chosen_by(sentence, by_word))
            except Unanswered:
                continue
    return {label for label in chosen if label is not None}


def _sentences(text: str) -> list[str]:
    """Returns the sentences of a text, without those that are empty; one at least."""
    found = [match.group().strip() for match in _SENTENCE.finditer(text)]
    return [sentence for sentence in found if sentence] or [""]
