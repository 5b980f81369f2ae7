"""The commands for a real robot, and for an emulated one: ``tog hardware ...``."""

from pathlib import Path
from typing import Annotated

import typer

from tog_drake.options import (
    JsonOption,
    KOption,
    ProposerOptions,
    ScenarioText,
    SeedOption,
    SelectorOptions,
    TaskOption,
    put_k,
)
from tog_drake.spread import spread
from tog_drake.terminal import console_for, print_json, print_stages, say

RealScenarioOption = Annotated[
    str,
    typer.Option(
        "--scenario", help="Name or YAML file, with a section hardware; by default panda_lcm."
    ),
]

SquaresOption = Annotated[str, typer.Option("--board", help="Squares of the board: COLUMNSxROWS.")]
SquareOption = Annotated[float, typer.Option(help="[m] side of a square, as measured.")]
MarkerOption = Annotated[float, typer.Option(help="[m] side of a marker.")]
DictionaryOption = Annotated[str, typer.Option(help="Of the markers.")]

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
    board: SquaresOption = "7x5",
    square: SquareOption = 0.04,
    marker: MarkerOption = 0.03,
    dictionary: DictionaryOption = "5X5_100",
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


@app.command(epilog="Example: tog hardware board --out board.png")
def board(
    *,
    out: Annotated[Path, typer.Option(help="PNG file.")],
    board: SquaresOption = "7x5",
    square: Annotated[float, typer.Option(help="[m] side of a square.")] = 0.04,
    marker: MarkerOption = 0.03,
    dictionary: DictionaryOption = "5X5_100",
    as_json: JsonOption = False,
) -> None:
    """Draw the ChArUco board that `tog hardware calibrate` looks at, to be printed."""
    from tog_drake.files import check_file, write_atomically
    from tog_drake.hardware.calibrating import board_png, parse_board

    check_file(out, suffixes=(".png",))
    squares = parse_board(board, square, marker, dictionary)
    write_atomically(out, board_png(squares))
    size = f"{1e3 * squares.columns * square:g} x {1e3 * squares.rows * square:g} mm"
    console = console_for(as_json)
    say(console, f"{out}: {size}; print it at 100 %, not fitted to the page")
    say(console, f"a square is {1e3 * square:g} mm; give `calibrate` what the print measures")
    print_json(as_json, {"file": str(out), "size": size})


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


@app.command(epilog='Example: tog hardware run --task "hand me the hammer" --speed 0.05')
@spread()
def run(
    *,
    task: TaskOption,
    scenario: RealScenarioOption = "panda_lcm",
    scenario_text: ScenarioText = None,
    selector: SelectorOptions,
    proposer: ProposerOptions,
    k: KOption = None,
    seed: SeedOption = None,
    speed: Annotated[
        float | None,
        typer.Option(help="Of the planned motion's, up to 1; by default that of the scenario."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Look and decide; never send one message.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for episode.json and report.html.")] = Path(
        "out/hardware"
    ),
    meshcat: Annotated[
        bool, typer.Option(help="Show it live on localhost, with a STOP button.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Run one episode on a real robot. Exit 0: lifted (or a dry run that chose); 1: not; 2: bad
    input. Ctrl-C stops the arm."""
    from tog_drake.files import check_folder
    from tog_drake.hardware.asking import asked
    from tog_drake.hardware.config import hardware_of
    from tog_drake.hardware.episode import run_hardware_episode
    from tog_drake.report import write_report
    from tog_drake.scenario import load_scenario
    from tog_drake.showing import report_of, save_episode, show_live
    from tog_drake.task import read_task

    console = console_for(as_json)
    check_folder(out)
    read_task(task)  # a task without words is refused before anything starts
    loaded = load_scenario(scenario, scenario_text, seed=seed)
    selector.apply(loaded.pipeline, fallback="geometric")
    proposer.apply(loaded.pipeline)
    put_k(loaded.pipeline, k)
    config = hardware_of(loaded)
    config.speed = config.speed if speed is None else speed
    live = show_live(console) if meshcat else None
    episode = run_hardware_episode(
        loaded,
        name=scenario,
        task=task,
        ask=lambda decision, listen: (
            yes or asked(decision, listen, speed=config.speed, meshcat=live)
        ),
        dry_run=dry_run,
        meshcat=live,
    )
    save_episode(out, episode.record, episode.recording)
    write_report(out / "report.html", [report_of(episode)])
    print_stages(console, episode.record)
    say(console, f"report: {out / 'report.html'}")
    print_json(as_json, episode.record)
    wanted = "chosen" if dry_run else "lifted"
    raise typer.Exit(0 if episode.record["outcome"] == wanted else 1)
