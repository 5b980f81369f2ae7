"""Methods: the rows of a benchmark's table."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tog_drake.benchmark.tables import TASK_BLIND
from tog_drake.errors import InputError
from tog_drake.options import ProposerOptions, SelectorOptions, put_k, valid
from tog_drake.view_options import put_view

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig


@dataclass(frozen=True)
class Method:
    """Who proposes, among how many candidates, and who chooses in which view.

    None leaves the scenario's.
    """

    selector: str
    proposer: str | None = None
    k: str | None = None
    strategy: str | None = None  # this and the next: of the selector "vlm" alone
    vlm: str | None = None
    view: str | None = None  # who compares views

    @property
    def name(self) -> str:
        """The row's label: what was said of the method, such as "vlm cpg gemini:NAME, K=auto"."""
        chooses = [part for part in (self.selector, self.strategy, self.vlm) if part is not None]
        words = [" ".join(chooses)]
        if self.view is not None:
            words.append(f"view: {self.view}")
        if self.k is not None:
            words.append(f"K={self.k}")
        if self.proposer is not None:
            words.append(self.proposer)
        return ", ".join(words)

    @property
    def reads_task(self) -> bool:
        """Whether the choice depends on the task."""
        return self.selector not in TASK_BLIND

    @property
    def takes_weights(self) -> bool:
        """Whether a file of weights is for its proposer; to name one alone names the proposer."""
        return self.proposer in (None, "contact-graspnet")

    def apply(
        self, config: "PipelineConfig", options: SelectorOptions, checkpoint: Path | None
    ) -> None:
        """Puts the method into the config of a pipeline; its other settings stay.

        Args:
            config: of the pipeline, changed in place.
            options: how a model is asked.
            checkpoint: weights, for the proposers that have any.

        Raises:
            InputError: an unknown name, a model that cannot be asked so, or a proposer that cannot
                be made.
        """
        chooser = SelectorOptions(self.selector)
        if self.selector == "vlm":
            chooser = replace(options, selector="vlm", strategy=self.strategy, vlm=self.vlm)
        chooser.apply(config)
        weights = checkpoint if self.takes_weights else None
        ProposerOptions(self.proposer, weights).apply(config)
        put_k(config, self.k)
        put_view(config, self.view)


def make_methods(
    selectors: Sequence[str],
    *,
    strategies: Sequence[str] = (),
    models: Sequence[str] = (),
    proposers: Sequence[str] = (),
    ks: Sequence[str] = (),
    views: Sequence[str] = (),
) -> list[Method]:
    """Returns all combinations, in a fixed order: proposers, K, selectors, strategies, models,
    views.

    Strategies and models multiply the selector "vlm" alone.

    Raises:
        InputError: a selector is unknown, or named twice; likewise the others.
    """
    from tog_drake.pipeline import SELECTORS

    for selector in selectors:
        valid(selector, SELECTORS, "selector")
    for given in (selectors, strategies, models, proposers, ks, views):
        if len(set(given)) < len(given):
            raise InputError(f"{', '.join(given)}: one is named twice; valid: each once")
    one: list[str | None] = [None]
    return [
        Method(selector, proposer, k, strategy, model, view)
        for proposer in [*proposers] or one
        for k in [*ks] or one
        for selector in selectors
        for strategy in ([*strategies] if selector == "vlm" else []) or one
        for model in ([*models] if selector == "vlm" else []) or one
        for view in [*views] or one
    ]
