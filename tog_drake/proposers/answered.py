"""Who made the grasps of a server, as the server says; the client cannot know whether it is so."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tog_drake.proposers.grasp_document import BadDocument
from tog_drake.values import Grasps

LONGEST = {"name": 100, "note": 300, "sha256": 64}  # characters
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Answerer:
    """What a server says of what proposes there."""

    name: str  # of the proposer
    note: str = ""  # of a network: what its weights are
    sha256: str = ""  # of its weights


@dataclass(frozen=True)
class AnsweredGrasps(Grasps):
    """Grasps of a server."""

    answerer: Answerer | None = field(default=None, metadata={"whole": True})
    """None: the server does not say."""


def read_answerer(said: Any) -> Answerer | None:
    """Returns who answered, from the JSON of an answer; None where it does not say.

    Raises:
        BadDocument: saying what was given and what would be valid.
    """
    if said is None:
        return None
    bounds = ", ".join(f"{name} (at most {most} characters)" for name, most in LONGEST.items())
    valid = f"valid: an object of texts, {bounds}; only name must be there"
    if not isinstance(said, dict):
        raise BadDocument(f"its proposer is a {type(said).__name__}; {valid}")
    unknown = [name for name in said if name not in LONGEST]
    if unknown:
        raise BadDocument(f"its proposer holds {unknown[0][:40]!r}; {valid}")
    for name, most in LONGEST.items():
        text = said.get(name, "")
        if not isinstance(text, str) or len(text) > most:
            raise BadDocument(f"the {name} of its proposer is no text, or too long; {valid}")
    if not said.get("name"):
        raise BadDocument(f"its proposer has no name; {valid}")
    if said.get("sha256") and not _SHA256.fullmatch(said["sha256"]):
        raise BadDocument("the sha256 of its proposer is none; valid: 64 hexadecimal digits")
    return Answerer(**said)


def answerer_of(name: str, weights: Mapping[str, Any] | None) -> Answerer:
    """Returns what a server says of its proposer.

    Args:
        name: of the proposer, as the command spells it.
        weights: of a network, what a record says of them. Their file stays untold.
    """
    if weights is None:
        return Answerer(name[: LONGEST["name"]])
    note = str(weights["note"])[: LONGEST["note"]]
    return Answerer(name[: LONGEST["name"]], note, str(weights["sha256"]))


def passed_on(answerer: Answerer, grasps: Grasps) -> Answerer:
    """Returns who answers with these grasps: of those of a further server, that one by its name."""
    further = grasps.answerer if isinstance(grasps, AnsweredGrasps) else None
    if further is None:
        return answerer
    name = f"{further.name} by {answerer.name}"[: LONGEST["name"]]
    return Answerer(name, further.note, further.sha256)
