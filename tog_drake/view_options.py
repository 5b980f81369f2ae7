"""The options about cameras and views that several subcommands of ``tog`` share.

Nothing heavy is imported here: the help stays quick.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from tog_drake.errors import InputError
from tog_drake.options import valid

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig
    from tog_drake.scenario import Scenario

VIEW_FORMS = "hand | coverage | detector | remote:URL | vlm-compare | vlm-compare:MODEL"


@dataclass(frozen=True)
class ViewOptions:
    """Which cameras there are, and in whose view the grasps are shown.

    None leaves the scenario's setting.
    """

    view: Annotated[
        str | None, typer.Option(help=f"Whose view whoever chooses is shown: {VIEW_FORMS}.")
    ] = None
    target: Annotated[
        str | None,
        typer.Option(help="The object's words by which views are compared; else the task's."),
    ] = None
    side_cameras: Annotated[
        bool, typer.Option("--side-cameras", help="Four more cameras around the workspace.")
    ] = False
    fuse: Annotated[
        bool, typer.Option("--fuse", help="Make the cloud of all cameras' views, not of one.")
    ] = False

    look: Annotated[
        str | None,
        typer.Option(
            help="once | active: with further looks of the hand's camera, all of which are fused."
        ),
    ] = None

    def apply(self, scenario: "Scenario") -> None:
        """Puts the options into a scenario; its other settings stay.

        Raises:
            InputError: an unknown name.
        """
        from tog_drake.pipeline import LOOKS
        from tog_drake.scenario import with_side_cameras

        config = scenario.pipeline
        if self.side_cameras:
            scenario.cameras = with_side_cameras(scenario.cameras)
        if self.fuse:
            config.cloud.fuse = True
        if self.look is not None:
            kind = valid(self.look, LOOKS, "look")
            config.look = config.look if isinstance(config.look, kind) else kind()
        put_view(config, self.view)
        if self.target is not None:
            config.view_selection.target = self.target


def put_view(config: "PipelineConfig", view: str | None) -> None:
    """Puts who compares views into the config of a pipeline; None leaves the scenario's.

    A model that is not named is the one that chooses, with its cassette: the selector comes first.

    Raises:
        InputError: it is unknown.
    """
    from tog_drake.pipeline import SCORERS
    from tog_drake.selectors.vlm.selector import Vlm
    from tog_drake.selectors.vlm.specification import read_specification
    from tog_drake.view_scorers.remote import Remote
    from tog_drake.view_scorers.vlm_compare import VlmCompare

    if view is None:
        return
    name, colon, place = view.partition(":")
    kind = valid(name, SCORERS, "view")
    if not isinstance(config.view_selection.scorer, kind):
        config.view_selection.scorer = kind()
    scorer = config.view_selection.scorer
    if isinstance(scorer, Remote) and place:
        scorer.url = place
    elif isinstance(scorer, VlmCompare) and place:
        scorer.model = read_specification(place)
    elif colon:
        raise InputError(f"unknown view {view!r}; valid: {VIEW_FORMS}")
    chooses = config.selector
    if (
        isinstance(scorer, VlmCompare)
        and isinstance(chooses, Vlm)
        and (scorer.model, scorer.replay) == (None, None)
    ):
        scorer.model, scorer.deadline = chooses.model, chooses.deadline
        scorer.record, scorer.replay = chooses.record, chooses.replay
