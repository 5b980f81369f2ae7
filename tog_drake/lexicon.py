"""The words that are understood: ``lexicon.yaml``, loaded once and checked.

A noun, a part or a verb is taught by a line in that file, not by code. What words mean in a
sentence is in ``task``; what the shapes of things and parts are, in ``selectors/parts``.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

from tog_drake.errors import InputError
from tog_drake.files import read_yaml

Kind = Literal["tool", "vessel", "bottle", "drill", "animal"]
End = Literal["wide", "thin", "flat"]


@dataclass(frozen=True)
class KindWords:
    """What a kind of thing is called, and by which part it is held to be used."""

    called: str
    use: str


@dataclass(frozen=True)
class Rule:
    """What a noun says: the kind of the thing, and which part of it does the work."""

    kind: Kind
    working: str = "body"  # the part that does the work, and is held when handing it over
    working_end: End = "wide"  # of a tool
    looks: tuple[float, float, float, float] | None = None
    """How long, wide and high [m], and the share of its length that is wide (0: not said)."""


@dataclass(frozen=True)
class Grammar:
    """Words by what they do in a sentence; each field is a list in the file."""

    vague_parts: frozenset[str]
    grip_verbs: frozenset[str]
    handover_verbs: frozenset[str]
    hold_verbs: frozenset[str]
    noun_or_verb: frozenset[str]
    mishaps: frozenset[str]
    harmless: frozenset[str]
    bad: frozenset[str]
    offered: frozenset[str]
    negators: frozenset[str]
    negating_phrases: frozenset[str]
    stops: frozenset[str]
    person: frozenset[str]
    recipients: frozenset[str]
    robot: frozenset[str]
    determiners: frozenset[str]
    openers: frozenset[str]
    modals: frozenset[str]
    prepositions: frozenset[str]
    locatives: frozenset[str]
    particles: frozenset[str]
    joining: frozenset[str]
    measures: frozenset[str]
    places: frozenset[str]
    fillers: frozenset[str]


@dataclass(frozen=True)
class Lexicon:
    """All words that are understood."""

    kinds: dict[str, KindWords]
    rules: dict[str, Rule]  # by noun, synonyms included
    parts: dict[str, str]  # word -> the name of the part
    colours: dict[str, str]  # word -> the name of the colour
    use_verbs: dict[str, str]  # verb -> the tool that it implies, "" for none
    contractions: dict[str, str]  # "dont" -> "do not"
    grammar: Grammar

    @cached_property
    def phrases(self) -> dict[tuple[str, ...], str]:
        """Entries of several words, longest first, and the one word that stands for each."""
        found = {**{noun: noun for noun in self.rules}, **self.parts}
        found |= dict.fromkeys(self.grammar.negating_phrases, "not")
        several = {tuple(entry.split()): one for entry, one in found.items() if " " in entry}
        return dict(sorted(several.items(), key=lambda item: (-len(item[0]), item[0])))

    @cached_property
    def function_words(self) -> frozenset[str]:
        """Words that are neither noun, part, colour nor verb."""
        g = self.grammar
        groups = (
            g.person, g.recipients, g.robot, g.determiners, g.openers, g.modals, g.prepositions,
            g.joining, g.negators, g.fillers, g.harmless,
            g.offered,
        )  # fmt: skip
        return frozenset().union(*groups)

    @cached_property
    def verbs(self) -> frozenset[str]:
        g = self.grammar
        return frozenset(self.use_verbs).union(
            g.handover_verbs, g.hold_verbs, g.mishaps, g.harmless
        )

    @cached_property
    def vocabulary(self) -> frozenset[str]:
        """All single words."""
        groups = [getattr(self.grammar, f.name) for f in fields(Grammar)]
        entries = frozenset().union(self.rules, self.parts, self.colours, self.verbs, *groups)
        return frozenset(entry for entry in entries if " " not in entry)


def load_lexicon(path: Path) -> Lexicon:
    """Reads a lexicon of the form of ``lexicon.yaml``.

    Raises:
        InputError: if it cannot be read, a section is missing or unknown, or a word stands twice.
    """
    try:
        content = read_yaml(path)
    except InputError as error:
        raise InputError(f"cannot read the lexicon {path}: {error}") from error
    lists = [f.name for f in fields(Grammar)]
    named = ["kinds", "objects", "parts", "colours", "use_verbs", "contractions"]
    _check_keys(content, [*named, *lists], f"{path}")
    kinds = {
        name: KindWords(**_entry(entry, ["called", "use"], [], f"{path}: kinds: {name}"))
        for name, entry in content["kinds"].items()
    }
    _check_keys(kinds, get_args(Kind), f"{path}: kinds")
    parts = _names_of_words(content["parts"], f"{path}: parts")
    return Lexicon(
        kinds=kinds,
        rules=_rules(content["objects"], parts, f"{path}: objects"),
        parts=parts,
        colours=_names_of_words(content["colours"], f"{path}: colours"),
        use_verbs=_names_of_words(content["use_verbs"], f"{path}: use_verbs", named=False),
        contractions={str(k): str(v) for k, v in content["contractions"].items()},
        grammar=Grammar(**{n: frozenset(_words(content[n], f"{path}: {n}")) for n in lists}),
    )


def _rules(section: Any, parts: dict[str, str], where: str) -> dict[str, Rule]:
    rules: dict[str, Rule] = {}
    for noun, entry in _items(section, where):
        here = f"{where}: {noun}"
        _entry(entry, ["kind"], ["working", "working_end", "looks", "words"], here)
        rule = {key: value for key, value in entry.items() if key != "words"}
        for key, valid in (
            ("kind", get_args(Kind)),
            ("working", sorted(set(parts.values()))),
            ("working_end", get_args(End)),
        ):
            if key in rule and rule[key] not in valid:
                raise InputError(f"{here}: {key} {rule[key]!r} is none of {', '.join(valid)}")
        if "looks" in rule:
            rule["looks"] = _looks(rule["looks"], here)
        for word in [noun, *_words(entry.get("words", []), here)]:
            if word in rules:
                raise InputError(f"{here}: {word!r} stands twice among the objects")
            rules[word] = Rule(**rule)
    return rules


def _looks(looks: Any, where: str) -> tuple[float, ...]:
    numbers = isinstance(looks, list) and all(isinstance(x, int | float) for x in looks)
    if not numbers or len(looks) != 4 or min(looks[:3]) <= 0 or not 0 <= looks[3] < 1:
        raise InputError(
            f"{where}: looks must be length, width and height [cm] and a share below 1: {looks!r}"
        )
    return (*(x / 100 for x in looks[:3]), looks[3])


def _names_of_words(section: Any, where: str, *, named: bool = True) -> dict[str, str]:
    """Turns ``name: [word, word]`` into {word: name}; the name is a word too where ``named``."""
    names: dict[str, str] = {}
    for name, words in _items(section, where):
        for word in [*([name] if named else []), *_words(words, f"{where}: {name}")]:
            if word in names:
                raise InputError(f"{where}: {word!r} stands for both {names[word]!r} and {name!r}")
            names[word] = name
    return names


def _items(section: Any, where: str) -> Iterator[tuple[str, Any]]:
    if not isinstance(section, dict):
        raise InputError(f"{where} must be a mapping, not {section!r}")
    for key, value in section.items():
        yield str(key), value


def _words(words: Any, where: str) -> list[str]:
    # YAML reads `no`, `on`, `off` and `yes` as booleans: they must be quoted.
    if not isinstance(words, list) or not all(isinstance(w, str) and w for w in words):
        raise InputError(f"{where} must be a list of words (quote 'no', 'on', 'off'): {words!r}")
    twice = [word for i, word in enumerate(words) if word in words[:i]]
    if twice:
        raise InputError(f"{where}: {twice[0]!r} stands twice in the list")
    return words


def _entry(entry: Any, needed: list[str], possible: list[str], where: str) -> dict[str, Any]:
    if not isinstance(entry, dict) or not set(needed) <= set(entry) <= {*needed, *possible}:
        raise InputError(f"{where} must have {needed} and may have {possible}, not {entry!r}")
    return entry


def _check_keys(content: Any, valid: Any, where: str) -> None:
    given = set(content) if isinstance(content, dict) else {str(content)}
    if given != set(valid):
        missing, strange = sorted(set(valid) - given), sorted(map(str, given - set(valid)))
        raise InputError(
            f"{where} must have the keys {', '.join(valid)}; "
            f"missing: {missing or 'none'}, unknown: {strange or 'none'}"
        )


LEXICON = load_lexicon(Path(__file__).with_name("lexicon.yaml"))
