"""The options that several subcommands of ``tog`` share.

Nothing heavy is imported here: the help stays quick.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from tog_drake.errors import InputError
from tog_drake.files import check_file

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig, ProposerConfig
    from tog_drake.selectors.vlm.selector import Vlm

T = TypeVar("T")

MODEL_FORMS = "openai:MODEL@URL, gemini:MODEL or anthropic:MODEL"
MODEL_HELP = (
    "The model to ask: openai:MODEL@URL | gemini:MODEL | anthropic:MODEL. Its key: OPENAI_API_KEY, "
    "GEMINI_API_KEY, ANTHROPIC_API_KEY; elsewhere than there or on this machine, VLM_API_KEY."
)
_REPLAY = "replay:"
DEFAULT_SCENARIO = "Hammer"


def scenario_names() -> list[str]:
    """The names that a shell completes a scenario's to."""
    from tog_drake.resources import scenario_files

    return list(scenario_files())


ScenarioOption = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        help=f"Name (see `tog scenarios`) or YAML file; by default {DEFAULT_SCENARIO}.",
        autocompletion=scenario_names,
    ),
]
ScenarioText = Annotated[
    str | None, typer.Option(help="YAML that overrides single fields of the scenario.")
]
TaskOption = Annotated[str, typer.Option(help="What the robot should do, in plain words.")]
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
ProfileOption = Annotated[
    str | None, typer.Option(help="How the model tells places, where its name does not tell.")
]
RenderingOption = Annotated[
    str | None, typer.Option(help="What the model is shown: marked | paper.")
]

SelectorOption = Annotated[
    str | None, typer.Option(help="geometric | top-score | random | oracle | vlm")
]
ModelOption = Annotated[
    str | None,
    typer.Option("--vlm", help=f"{MODEL_HELP} Or replay:FILE."),
]


@dataclass(frozen=True)
class SelectorOptions:
    """Who chooses the grasp, and how a model is asked; None leaves the scenario's setting."""

    selector: SelectorOption = None
    strategy: Annotated[
        str | None,
        typer.Option(
            help="How a model is asked: gsi (default) | cpsi | gmi | cpmi | cpg | pivot | avoid;"
            " `tog prompts` explains them."
        ),
    ] = None
    prompt: Annotated[
        Path | None,
        typer.Option(
            help="File with a text of your own in place of the strategy's; `tog prompts STRATEGY"
            " --source` prints one to begin with."
        ),
    ] = None
    vlm: ModelOption = None
    profile: ProfileOption = None
    rendering: RenderingOption = None
    votes: Annotated[
        int | None, typer.Option(min=1, max=2, help="2: asked again with the marks permuted.")
    ] = None
    fallback: Annotated[
        str | None,
        typer.Option(
            help="Who chooses where the answer is no use: geometric | fail."
            " By default: run, choose: geometric; eval: fail."
        ),
    ] = None
    record: Annotated[
        Path | None,
        typer.Option(help="File that keeps questions and answers; none is asked twice."),
    ] = None
    replay: Annotated[
        Path | None,
        typer.Option(help="Such a file to take all answers from, and the model; nothing is sent."),
    ] = None
    deadline: Annotated[
        float | None, typer.Option(help="[s] for all questions to a model; by default 120.")
    ] = None

    @property
    def names_model(self) -> bool:
        """Whether a model is named, or a cassette that names one."""
        return self.vlm is not None or self.replay is not None

    def apply(
        self, config: "PipelineConfig", *, fallback: str | None = None, asks: bool = True
    ) -> None:
        """Puts the options into the config of a pipeline; its other settings stay.

        Args:
            config: of the pipeline, changed in place.
            fallback: what holds where neither options nor scenario say who chooses.
            asks: whether the pipeline is to run, so that the key of a model must be there.

        Raises:
            InputError: an unknown name, options that do not go together, a cassette that cannot be
                read or written, no model to ask, or no key for it.
        """
        from tog_drake.pipeline import SELECTORS
        from tog_drake.selectors.vlm.selector import Vlm, VlmSelector

        selector = self.selector
        if selector is None and self.names_model:
            selector = "vlm"  # to name one is to choose by it
        if selector is not None:
            kind = valid(selector, SELECTORS, "selector")
            if not isinstance(config.selector, kind):
                config.selector = kind()
        if isinstance(config.selector, Vlm):
            self._apply_to(config.selector)
            config.selector.fallback = config.selector.fallback or fallback
            wanted = VlmSelector(config.selector, config.workspace, seed=0)  # hears what is wrong
            if asks:
                wanted.check_key()
        elif given := self.given():
            chooses = type(config.selector).__name__
            raise InputError(
                f"{', '.join(given)}: only a model is asked so, and {chooses} is to choose here; "
                f"valid: with --vlm {MODEL_FORMS}, or replay:FILE"
            )

    def given(self) -> list[str]:
        """The options for a model that were given, as they are typed."""
        names = [f.name for f in fields(self) if f.name != "selector"]
        return [f"--{name}" for name in names if getattr(self, name) is not None]

    def _apply_to(self, config: "Vlm") -> None:
        for name in ("strategy", "rendering", "votes", "fallback", "deadline"):
            if getattr(self, name) is not None:
                setattr(config, name, getattr(self, name))
        if self.prompt is not None:
            config.prompt = str(self.prompt)
        replay = self._apply_model(config)
        if self.record is not None and replay is not None:
            raise InputError(
                f"--record {self.record} and --replay {replay} exclude each other; valid: "
                "--record alone, which asks nothing that the file answers already"
            )
        if replay is not None:
            config.replay, config.record = str(replay), None
        if self.record is not None:
            check_file(self.record, "--record")
            config.record, config.replay = str(self.record), None

    def _apply_model(self, config: "Vlm") -> Path | None:
        """Puts in place who is asked; returns the cassette to replay, if one is named."""
        from tog_drake.selectors.vlm.specification import read_specification

        if self.vlm is not None and self.vlm.startswith(_REPLAY):
            if self.replay is not None or self.profile is not None:
                other = "--replay" if self.replay is not None else "--profile"
                raise InputError(f"{other} with --vlm {self.vlm}: the cassette says it; valid: one")
            return Path(self.vlm.removeprefix(_REPLAY))
        if self.vlm is not None:
            config.model = read_specification(self.vlm, self.profile)
        elif self.profile is not None:
            if config.model is None:
                raise InputError("--profile says how a model tells places; valid: with --vlm MODEL")
            config.model.profile = self.profile
        return self.replay


_PLACES = {"file": "path", "remote": "url"}  # the field of a config that comes after the colon


@dataclass(frozen=True)
class ProposerOptions:
    """Who proposes grasps; None leaves the scenario's setting."""

    proposer: Annotated[
        str | None,
        typer.Option(
            help="Who suggests grasps: antipodal (default) | contact-graspnet | file:PATH"
            " | remote:URL | the name of a plug-in."
        ),
    ] = None
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            help="File of weights for contact-graspnet; by default what `tog weights` has stored."
        ),
    ] = None

    def apply(self, config: "PipelineConfig") -> None:
        """Puts the options into the config of a pipeline; its other settings stay.

        Raises:
            InputError: an unknown name, options that do not go together, or a proposer that cannot
                be made.
        """
        from tog_drake.pipeline import make_proposer

        if self.proposer is None and self.checkpoint is None:
            return
        if self.proposer is not None:
            self._apply_to(config)
        if self.checkpoint is not None:
            self._apply_checkpoint(config, self.checkpoint)
        make_proposer(config, 0)  # hears what is wrong before anything starts

    def _apply_to(self, config: "PipelineConfig") -> None:
        """Puts in place what proposes."""
        from tog_drake.pipeline import PROPOSERS
        from tog_drake.proposers.plugin import Plugin, plugin_names

        given = str(self.proposer)
        name, _, place = given.partition(":")
        if place and name in _PLACES:
            _put(config, PROPOSERS[name], **{_PLACES[name]: place})
        elif given in PROPOSERS and given not in _PLACES:
            _put(config, PROPOSERS[given])
        elif name in _PLACES and given == f"{name}:":
            field = _PLACES[name]
            raise InputError(
                f"--proposer {given!r} lacks its {field}; valid: {name}:{field.upper()}"
            )
        elif given in plugin_names():
            if not isinstance(config.proposer, Plugin) or config.proposer.name != given:
                config.proposer = Plugin(given)
        else:
            forms = [f"{n}:{_PLACES[n].upper()}" if n in _PLACES else n for n in PROPOSERS]
            raise InputError(
                f"unknown proposer {given!r}; valid: {', '.join(forms + plugin_names())}"
            )

    def _apply_checkpoint(self, config: "PipelineConfig", checkpoint: Path) -> None:
        """Puts the weights in place; alone, to name them is to propose by them."""
        from tog_drake.proposers.contact_graspnet.proposer import ContactGraspNet

        if self.proposer is None:
            _put(config, ContactGraspNet)
        if not isinstance(config.proposer, ContactGraspNet):
            raise InputError(
                f"--checkpoint {checkpoint} is for --proposer contact-graspnet, not for "
                f"{self.proposer}"
            )
        config.proposer.checkpoint = str(checkpoint)


def _put(config: "PipelineConfig", kind: "type[ProposerConfig]", **fields: str) -> None:
    """Makes a proposer of that kind the pipeline's; one that is keeps its other settings."""
    if not isinstance(config.proposer, kind):
        config.proposer = kind()
    for name, value in fields.items():
        setattr(config.proposer, name, value)


def put_k(config: "PipelineConfig", k: str | None) -> None:
    """Puts the number of candidates into the config of a pipeline; None leaves the scenario's.

    Raises:
        InputError: it is no number of candidates.
    """
    from tog_drake.candidates import candidate_counts

    if k is not None:
        config.candidates.k = k
        candidate_counts(config.candidates)


def names(text: str) -> list[str]:
    """Returns the names in a comma-separated list."""
    return [name.strip() for name in text.split(",")]


def valid(given: str, known: Mapping[str, T], what: str) -> T:
    """Returns what is known by the name given; raises InputError with all names where none is."""
    if given not in known:
        raise InputError(f"unknown {what} {given!r}; valid: {', '.join(known)}")
    return known[given]
