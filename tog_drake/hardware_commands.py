"""The commands for a real robot, and for an emulated one: ``tog hardware ...``."""

from pathlib import Path
from typing import Annotated

import typer

from tog_drake.options import ScenarioOption, ScenarioText, SeedOption
from tog_drake.terminal import console_for, say

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="A real robot, or one that is emulated."
)


@app.callback()
def _hardware() -> None:
    """Or a single command would take the place of the group."""


@app.command(epilog="Example: tog hardware emulate --scenario Hammer --log out/robot.jsonl")
def emulate(
    *,
    scenario: ScenarioOption = None,
    scenario_text: ScenarioText = None,
    seed: SeedOption = None,
    rate: Annotated[
        float, typer.Option(min=50.0, max=1000.0, help="[Hz] of the arm's status.")
    ] = 200.0,
    recover_after: Annotated[
        float | None,
        typer.Option(min=0.0, help="[s] after a reflex the driver is there again; else never."),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="File that gets every command and what became of it.")
    ] = None,
) -> None:
    """Be a robot for `tog hardware run`: arm, hand and camera, simulated, until Ctrl-C."""
    from tog_drake.files import check_file
    from tog_drake.hardware.emulator import Emulator
    from tog_drake.options import DEFAULT_SCENARIO
    from tog_drake.scenario import load_scenario

    loaded = load_scenario(scenario or DEFAULT_SCENARIO, scenario_text, seed=seed)
    if log is not None:
        check_file(log, "--log")
        log.parent.mkdir(parents=True, exist_ok=True)
    with Emulator(loaded, rate=rate, recover_after=recover_after, log=log) as emulator:
        say(console_for(as_json=False), f"an emulated robot, {rate:g} Hz (Ctrl-C ends it)")
        emulator.run()
