"""Whom to ask, by which profile and out of which cassette: what all that ask in a run share."""

import math
import time
from dataclasses import dataclass
from pathlib import Path

from tog_drake.errors import InputError
from tog_drake.selectors.vlm.cassette import Cassette, Mode
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.dialogue import Dialogue
from tog_drake.selectors.vlm.profiles import Profile, find_profile
from tog_drake.selectors.vlm.specification import ModelConfig, check_model

MAX_DEADLINE = 3600.0  # [s]


@dataclass(frozen=True)
class Connection:
    """A model that can be asked; nothing is sent before it is."""

    model: ModelConfig
    profile: Profile
    client: Client
    deadline: float  # [s] for all questions of a decision, retries and repairs included

    def dialogue(self) -> Dialogue:
        """Begins a decision: its time runs from now on."""
        return Dialogue(
            self.client,
            self.profile,
            max_tokens=self.model.max_tokens,
            deadline=time.monotonic() + self.deadline,
        )


def connect(
    asker: str,
    model: ModelConfig | None,
    *,
    deadline: float,
    record: str | None,
    replay: str | None,
    export: Path | None,
) -> Connection:
    """Returns a model to be asked; a cassette that is replayed names its model itself.

    Args:
        asker: the tag of the config that the rest comes from, such as "!Vlm", for messages.
        model: None: that of the cassette.
        deadline: [s] for a decision.
        record: a cassette: what is in it is not asked again, what is not is added.
        replay: a cassette: nothing is asked, what is not in it is an error.
        export: a cassette that takes the place of both: what it has no answer to is pending.

    Raises:
        InputError: one of them is out of its bounds, or there is no model to ask.
    """
    if not (math.isfinite(deadline) and 0 < deadline <= MAX_DEADLINE):
        raise InputError(
            f"{asker}: deadline: {deadline:g}; valid: above 0, at most {MAX_DEADLINE:g} s"
        )
    if record is not None and replay is not None:
        raise InputError(f"{asker}: record and replay are given; valid: one of them")
    files: dict[Mode, Path | str | None] = {"export": export, "replay": replay, "record": record}
    cassette = next((Cassette(file, mode) for mode, file in files.items() if file), None)
    if model is None and cassette is not None and cassette.mode == "replay":
        model = cassette.model()
    if model is None:
        raise InputError(
            f"{asker} has no model to ask: give --vlm openai:MODEL@URL | gemini:MODEL | "
            f"anthropic:MODEL | replay:FILE, or in a scenario `{asker} {{model: !OpenAi {{model: "
            "NAME, base_url: URL}}`"
        )
    check_model(model)
    profile = find_profile(model.model, model.profile)
    return Connection(
        model, profile, Client(model, profile=profile.name, cassette=cassette), deadline
    )
