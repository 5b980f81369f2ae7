"""The commands for a real robot, and for an emulated one: ``tog hardware ...``."""

from pathlib import Path
from typing import Annotated

import typer

from tog_drake.options import ScenarioText, SeedOption
from tog_drake.terminal import console_for, say

RealScenarioOption = Annotated[
    str,
    typer.Option(
        "--scenario", help="Name or YAML file, with a section hardware; by default panda_lcm."
    ),
]

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="A real robot, or one that is emulated."
)


@app.callback()
def _hardware() -> None:
    """Or a single command would take the place of the group."""


@app.command(epilog="Example: tog hardware emulate --scenario panda_lcm --log out/robot.jsonl")
def emulate(
    *,
    scenario: RealScenarioOption = "panda_lcm",
    scenario_text: ScenarioText = None,
    seed: SeedOption = None,
    rate: Annotated[
        float, typer.Option(min=50.0, max=1000.0, help="[Hz] of the arm's status.")
    ] = 200.0,
    recover_after: Annotated[
        float, typer.Option(min=0.0, help="[s] until the driver is there again after a reflex.")
    ] = float("inf"),
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="KIND:CHANNEL:START:DURATION[:AMOUNT], such as drop:PANDA_STATUS:0.5:0.2: what "
            "goes wrong, START s after the arm first moves (+START: after the emulator starts). "
            "May be given several times. KIND: drop | delay | freeze | reorder | duplicate | nan "
            "of any channel; restart | reflex | push of PANDA_STATUS."
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="File that gets every command and what became of it.")
    ] = None,
) -> None:
    """Be a robot for `tog hardware run`: arm, hand and camera, simulated, until Ctrl-C."""
    from tog_drake.files import check_file
    from tog_drake.hardware.emulator import Emulator, EmulatorConfig, image_channels
    from tog_drake.hardware.faults import parse_fault
    from tog_drake.scenario import load_scenario

    loaded = load_scenario(scenario, scenario_text, seed=seed)
    channels = list(image_channels(loaded).values())
    faults = [parse_fault(text, channels) for text in fault or []]
    if log is not None:
        check_file(log, "--log")
        log.parent.mkdir(parents=True, exist_ok=True)
    config = EmulatorConfig(rate, recover_after, faults, log)
    with Emulator(loaded, config) as emulator:
        say(console_for(as_json=False), f"an emulated robot, {rate:g} Hz (Ctrl-C ends it)")
        emulator.run()
