"""The commands for a real robot, and for an emulated one: ``tog hardware ...``."""

from pathlib import Path
from typing import Annotated

import typer

from tog_drake.options import JsonOption, ScenarioText, SeedOption
from tog_drake.terminal import console_for, print_json, say

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


@app.command(epilog="Example: tog hardware calibrate --scenario my.yaml --views out/views --live")
def calibrate(
    *,
    scenario: Annotated[
        str, typer.Option(help="YAML file whose camera is calibrated; its mount is written there.")
    ],
    views: Annotated[
        Path, typer.Option(help="Folder of images and views.json; with --live it is made.")
    ],
    live: Annotated[
        bool, typer.Option("--live", help="Take the views now, the arm moved by hand.")
    ] = False,
    camera: Annotated[str, typer.Option(help="Which of the scenario's cameras.")] = "wrist",
    out: Annotated[
        Path | None, typer.Option(help="Write a copy of the scenario instead of changing it.")
    ] = None,
    board: Annotated[str, typer.Option(help="Squares of the board: COLUMNSxROWS.")] = "7x5",
    square: Annotated[float, typer.Option(help="[m] side of a square, as measured.")] = 0.04,
    marker: Annotated[float, typer.Option(help="[m] side of a marker.")] = 0.03,
    dictionary: Annotated[str, typer.Option(help="Of the markers.")] = "5X5_100",
    as_json: JsonOption = False,
) -> None:
    """Find where the camera sits on the hand, from views of a ChArUco board that stands still."""
    from tog_drake.hardware.calibrating import calibrate_camera, parse_board

    squares = parse_board(board, square, marker, dictionary)
    console = console_for(as_json)
    found = calibrate_camera(
        scenario,
        views,
        squares,
        camera=camera,
        out=out,
        live=live,
        tell=lambda line: say(console, line),
    )
    print_json(as_json, found)


@app.command(epilog="Example: tog hardware doctor --scenario panda_lcm")
def doctor(
    *,
    scenario: RealScenarioOption = "panda_lcm",
    scenario_text: ScenarioText = None,
    seconds: Annotated[float, typer.Option(min=1.0, max=60.0, help="To listen for.")] = 3.0,
    as_json: JsonOption = False,
) -> None:
    """Check the real robot: drivers, clock, joints, hand, cameras. Nothing is commanded."""
    from tog_drake.hardware.checks import hardware_checks
    from tog_drake.scenario import load_scenario

    console = console_for(as_json)
    checks = hardware_checks(load_scenario(scenario, scenario_text), seconds)
    for check in checks:
        say(console, f"{'ok     ' if check.ok else 'PROBLEM'}  {check.name}: {check.found}")
    print_json(as_json, {check.name: vars(check) for check in checks})
    raise typer.Exit(0 if all(check.ok for check in checks) else 1)
