"""The options that several subcommands of ``tog`` share.

Nothing heavy is imported here: the help stays quick.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from tog_drake.errors import InputError

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig

T = TypeVar("T")

MODEL_FORMS = "openai:MODEL@URL, gemini:MODEL, anthropic:MODEL or replay:FILE"
_REPLAY = "replay:"

ScenarioOption = Annotated[
    str | None,
    typer.Option("--scenario", help="Name (see `tog scenarios`) or YAML file; by default Hammer."),
]
ScenarioText = Annotated[
    str | None, typer.Option(help="YAML that overrides single fields of the scenario.")
]
TaskOption = Annotated[str, typer.Option(help="What the robot should do, in plain words.")]
ProposerOption = Annotated[str | None, typer.Option(help="antipodal")]
KOption = Annotated[
    str | None, typer.Option(help="How many candidates: a number, or auto (best silhouette).")
]
SeedOption = Annotated[int | None, typer.Option(min=0, help="Seeds everything random.")]
NoiseOption = Annotated[
    bool, typer.Option("--noise", help="Depth as the cameras would measure it, not exact.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object as the last line of stdout.")
]
SelectorOption = Annotated[str | None, typer.Option(help="geometric | top-score | random | oracle")]
StrategyOption = Annotated[
    str | None, typer.Option(help="How a model is asked: gsi|cpsi|gmi|cpmi|cpg|pivot|avoid.")
]
ModelOption = Annotated[
    str | None,
    typer.Option("--vlm", help=f"Which model is asked: {MODEL_FORMS}. Keys: see tog doctor."),
]
ProfileOption = Annotated[
    str | None, typer.Option(help="How the model tells places, where its name does not tell.")
]
RenderingOption = Annotated[
    str | None, typer.Option(help="What the model is shown: marked | paper.")
]
VotesOption = Annotated[
    int | None, typer.Option(min=1, max=2, help="2: asked again with the marks permuted.")
]
FallbackOption = Annotated[
    str | None, typer.Option(help="Who chooses where the answer is no use: geometric | fail.")
]
RecordOption = Annotated[
    Path | None, typer.Option(help="File that keeps questions and answers; none is asked twice.")
]
ReplayOption = Annotated[
    Path | None, typer.Option(help="Such a file to take all answers from; nothing is sent.")
]


@dataclass(frozen=True)
class SelectorOptions:
    """Who chooses the grasp, and how a model is asked; None leaves the scenario's setting."""

    selector: str | None = None

    def apply(self, config: "PipelineConfig") -> None:
        """Puts the options into the config of a pipeline; its other settings stay.

        Raises:
            InputError: an unknown name.
        """
        from tog_drake.pipeline import SELECTORS

        if self.selector is not None:
            kind = valid(self.selector, SELECTORS, "selector")
            if not isinstance(config.selector, kind):
                config.selector = kind()


def valid(given: str, known: Mapping[str, T], what: str) -> T:
    """Returns what is known by the name given; raises InputError with all names where none is."""
    if given not in known:
        raise InputError(f"unknown {what} {given!r}; valid: {', '.join(known)}")
    return known[given]
