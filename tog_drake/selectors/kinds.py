"""What a noun says about shape: the kinds of things that the geometric selector knows."""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["tool", "vessel", "bottle", "drill", "animal"]


@dataclass(frozen=True)
class Rule:
    """The kind of a thing, and which part of it does the work."""

    kind: Kind
    working: str = "body"  # the part that does the work, and is held when handing it over
    working_end: Literal["wide", "thin"] = "wide"  # of a tool


_NOUNS = {
    Rule("tool", "head"): "hammer mallet axe hatchet muddler racket tool fork whisk wrench plunger",
    Rule("tool", "blade"): "spatula turner cleaver shovel",
    Rule("tool", "bowl"): "spoon ladle scoop pan frypan skillet strainer",
    Rule("tool", "bristles"): "brush broom",
    Rule("tool", "body"): "bell",
    Rule("tool", "shaft", "thin"): "screwdriver awl",
    Rule("tool", "blade", "thin"): "knife chisel scissors file saw",
    Rule("vessel"): "mug cup pitcher jug teapot kettle pot",
    Rule("bottle", "cap"): "bottle ketchup mustard milk lotion glue cleanser bleach shampoo jar "
    "tube conditioner sauce dressing honey",
    Rule("drill"): "drill",
    Rule("animal"): "toy dinosaur dino brontosaurus triceratops spinosaurus therizinosaurus animal "
    "horse cow bull lion rhino unicorn dog cat elephant giraffe",
}
RULES = {noun: rule for rule, nouns in _NOUNS.items() for noun in nouns.split()}

HOLD_FOR_USE: dict[Kind, str] = {
    "tool": "handle",
    "vessel": "handle",
    "bottle": "body",
    "drill": "handle",
    "animal": "body",
}
"""Where a thing is held to be used."""

PHRASES: dict[Kind, str] = {
    "tool": "a long tool",
    "vessel": "a round vessel",
    "bottle": "a bottle",
    "drill": "a drill",
    "animal": "an animal",
}
"""How a kind is called in a reason."""
