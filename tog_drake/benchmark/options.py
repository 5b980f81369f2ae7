"""The options of a benchmark: what is run, and by which methods."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tog_drake.errors import InputError
from tog_drake.options import MODEL_HELP, NoiseOption, ScenarioText, SelectorOptions, names
from tog_drake.view_options import VIEW_FORMS, ViewOptions

if TYPE_CHECKING:
    from tog_drake.benchmark.cells import Cell
    from tog_drake.benchmark.method import Method
    from tog_drake.benchmark.suite import Suite

SuiteArgument = Annotated[
    str,
    typer.Argument(
        metavar="SUITE",
        help="builtin | household | kitchen | tools | tog29 | views; a scenario, all of whose "
        "objects are asked for; or a YAML file of either.",
    ),
]


@dataclass(frozen=True)
class SuiteOptions:
    """How a suite is run."""

    seeds: Annotated[
        int | None,
        typer.Option(min=1, help="Each trial with seeds 0 .. N-1; by default as the suite says."),
    ] = None
    noise: NoiseOption = False
    scenario_text: ScenarioText = None

    def cells(
        self, suite: "Suite", methods: "Sequence[Method]", views: ViewOptions | None = None
    ) -> "list[Cell]":
        """Returns the episodes. Raises as ``make_cells``."""
        from tog_drake.benchmark.cells import make_cells

        seeds = range(self.seeds or suite.seeds)
        return make_cells(
            suite, methods, seeds, noise=self.noise, text=self.scenario_text, views=views
        )


@dataclass(frozen=True)
class MethodOptions:
    """Which methods are compared: all combinations of what is named; None leaves the scenario's."""

    selectors: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated: top-score, random, oracle, geometric, vlm; by default "
            "top-score,oracle, or vlm where a model is named."
        ),
    ] = None
    strategies: Annotated[
        str | None,
        typer.Option(help="How models are asked, comma-separated: gsi, cpsi ...; see tog prompts."),
    ] = None
    models: Annotated[
        list[str] | None,
        typer.Option("--vlm", help=f"{MODEL_HELP} Or replay:FILE. Once for each."),
    ] = None
    proposers: Annotated[
        str | None, typer.Option(help="Who suggests grasps, comma-separated, as of tog run.")
    ] = None
    k: Annotated[
        str | None, typer.Option(help="How many candidates, comma-separated: 2,3,auto.")
    ] = None
    views: Annotated[
        str | None, typer.Option(help=f"Whose view is shown, comma-separated: {VIEW_FORMS}.")
    ] = None
    checkpoint: Annotated[
        Path | None, typer.Option(help="File of weights for the proposer contact-graspnet.")
    ] = None

    def methods(self, options: SelectorOptions) -> "list[Method]":
        """Returns the methods, in a fixed order.

        Args:
            options: how a model is asked.

        Raises:
            InputError: a name is unknown or stands twice, or options do not go together.
        """
        from tog_drake.benchmark.method import make_methods

        models = self.models or []
        names_model = bool(models) or options.names_model
        chosen = names(self.selectors or ("vlm" if names_model else "top-score,oracle"))
        given = [*options.given()]
        given += ["--strategies"] * bool(self.strategies) + ["--vlm"] * bool(models)
        if "vlm" not in chosen and given:
            raise InputError(
                f"{', '.join(given)}: only a model is asked so; valid: with vlm among the "
                "--selectors"
            )
        if options.prompt is not None and "," in (self.strategies or ""):
            raise InputError(
                f"--prompt {options.prompt} takes the place of one strategy's text; valid: with "
                "one of --strategies"
            )
        methods = make_methods(
            chosen,
            strategies=names(self.strategies) if self.strategies else [],
            models=models,
            proposers=names(self.proposers) if self.proposers else [],
            ks=names(self.k) if self.k else [],
            views=names(self.views) if self.views else [],
        )
        if self.checkpoint is not None and not any(method.takes_weights for method in methods):
            raise InputError(
                f"--checkpoint {self.checkpoint} is for contact-graspnet, not for "
                f"{self.proposers}; valid: with contact-graspnet among the --proposers"
            )
        return methods
