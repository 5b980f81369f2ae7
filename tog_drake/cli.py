"""The command ``tog``. Heavy imports happen inside the subcommands: ``tog --help`` stays quick."""

import json
import signal
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.table import Table

from tog_drake.assets_commands import app as assets_app
from tog_drake.errors import InputError, TogError
from tog_drake.files import check_file, check_folder
from tog_drake.options import (
    DeadlineOption,
    FallbackOption,
    JsonOption,
    KOption,
    ModelOption,
    NoiseOption,
    ProfileOption,
    ProposerOption,
    ProposerOptions,
    RecordOption,
    RenderingOption,
    ReplayOption,
    ScenarioOption,
    ScenarioText,
    SeedOption,
    SelectorOption,
    SelectorOptions,
    StrategyOption,
    TaskOption,
    VotesOption,
    names,
    valid,
)
from tog_drake.serve_commands import app as serve_app
from tog_drake.terminal import (
    console_for,
    deciding,
    keep_drake_quiet,
    print_failures,
    print_json,
    print_rates,
    print_stages,
    say,
)
from tog_drake.visible_text import visible
from tog_drake.vlm_commands import app as vlm_app
from tog_drake.vlm_commands import prompts

if TYPE_CHECKING:
    from tog_drake.pipeline import PipelineConfig
    from tog_drake.scenario import Scenario

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode=None,
    help="Training-free task-oriented grasping for the Franka Panda, in Drake. "
    "Add --debug to any command for a traceback.",
)

DEFAULT_SCENARIO = "Hammer"
DEMO_TASKS = {
    "use": "use the hammer to drive a nail",
    "handover": "hand me the hammer",
}


def _epilog(example: str) -> str:
    return f"Example: {example}"


@app.command(epilog=_epilog('tog run --scenario Hammer --task "hand me the hammer"'))
def run(
    task: TaskOption,
    scenario: ScenarioOption = None,
    scenario_text: ScenarioText = None,
    object_: Annotated[
        str | None,
        typer.Option(
            "--object",
            help="Which object the task is about; alone, its scenario too. With a scenario of one "
            "imported object, such as Tog29: which one to put there.",
        ),
    ] = None,
    selector: SelectorOption = None,
    strategy: StrategyOption = None,
    vlm: ModelOption = None,
    profile: ProfileOption = None,
    rendering: RenderingOption = None,
    votes: VotesOption = None,
    fallback: FallbackOption = None,
    record: RecordOption = None,
    replay: ReplayOption = None,
    deadline: DeadlineOption = None,
    proposer: ProposerOption = None,
    k: KOption = None,
    seed: SeedOption = None,
    noise: NoiseOption = False,
    out: Annotated[Path, typer.Option(help="Folder for episode.json and report.html.")] = Path(
        "out/run"
    ),
    meshcat: Annotated[
        bool, typer.Option(help="Show the run live on localhost, and its replay in the report.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Run one simulated episode. Exit 0: lifted; 1: not, see the outcome; 2: bad input."""
    from tog_drake.cameras import with_noise
    from tog_drake.episode import run_episode
    from tog_drake.record import save_record
    from tog_drake.report import write_report
    from tog_drake.showing import report_of, show_live
    from tog_drake.task import read_task

    console = console_for(as_json)
    check_folder(out)
    read_task(task)  # a task without words is refused before anything starts
    name = scenario or _scenario_of(object_)
    options = SelectorOptions(
        selector, strategy, vlm, profile, rendering, votes, fallback, record, replay, deadline
    )
    loaded = _load(name, scenario_text, options, proposer, k, seed, fallback="geometric")
    if loaded.asset is not None and object_ is not None:
        loaded.asset = object_
    if noise:
        loaded.cameras = with_noise(loaded.cameras)
    live = show_live(console) if meshcat else None
    with console.status(f"looking, {deciding(loaded.pipeline.selector)}, moving ..."):
        episode = run_episode(
            loaded, name=name, task=task, target=_target(object_, scenario), meshcat=live
        )
    save_record(out / "episode.json", episode.record)
    write_report(out / "report.html", [report_of(episode)])
    print_stages(console, episode.record)
    say(console, f"report: {out / 'report.html'}")
    print_json(as_json, episode.record)
    raise typer.Exit(0 if episode.record["outcome"] == "lifted" else 1)


@app.command(epilog=_epilog("tog demo --out out/demo"))
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the report and the episodes.")] = Path(
        "out/demo"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Where the hammer lies.")] = 0,
) -> None:
    """One hammer, two tasks: held by the handle to use it, by the head to hand it over."""
    from tog_drake.episode import run_episode
    from tog_drake.record import save_record
    from tog_drake.report import write_report
    from tog_drake.showing import report_of
    from tog_drake.visualization import make_meshcat

    console = console_for(as_json=False)
    check_folder(out)
    loaded = _load(DEFAULT_SCENARIO, None, seed=seed)
    episodes = []
    for label, task in DEMO_TASKS.items():
        with console.status(f"{task} ..."):
            episode = run_episode(
                loaded, name=DEFAULT_SCENARIO, task=task, target=None, meshcat=make_meshcat()
            )
        save_record(out / label / "episode.json", episode.record)
        print_stages(console, episode.record)
        episodes.append(episode)
    write_report(out / "report.html", [report_of(episode) for episode in episodes])
    say(console, f"report: {out / 'report.html'}")
    good = all(episode.record["combined_success"] for episode in episodes)
    raise typer.Exit(0 if good else 1)


@app.command(
    epilog=_epilog(
        "tog choose --rgb color.png --depth depth.png --intrinsics camera.json "
        '--task "hold the red mug by the handle"'
    )
)
def choose(
    rgb: Annotated[Path, typer.Option(help="8-bit colour image.")],
    depth: Annotated[Path, typer.Option(help="16-bit PNG, or float32 NPY or TIFF.")],
    intrinsics: Annotated[Path, typer.Option(help="JSON {fx, fy, cx, cy, width, height}.")],
    task: TaskOption,
    depth_scale: Annotated[
        float | None,
        typer.Option(help="Depth units per metre; by default 1000 for PNG, 1 for floats."),
    ] = None,
    camera_pose: Annotated[
        Path | None, typer.Option(help="JSON 4x4 matrix X_WC with z of W up; tells up.")
    ] = None,
    selector: SelectorOption = None,
    strategy: StrategyOption = None,
    vlm: ModelOption = None,
    profile: ProfileOption = None,
    rendering: RenderingOption = None,
    votes: VotesOption = None,
    fallback: FallbackOption = None,
    record: RecordOption = None,
    replay: ReplayOption = None,
    deadline: DeadlineOption = None,
    proposer: ProposerOption = None,
    k: KOption = None,
    seed: SeedOption = None,
    out: Annotated[Path, typer.Option(help="Folder for grasps.json, overlay.png and more.")] = Path(
        "out/choose"
    ),
    as_json: JsonOption = False,
) -> None:
    """Choose a grasp on a saved view. Exit 0: chosen; 1: not, see the outcome; 2: bad input."""
    from tog_drake.choose import choose_on_view, grasps_record
    from tog_drake.drawing import decision_image, encode_png
    from tog_drake.files import write_atomically
    from tog_drake.pipeline import PipelineConfig
    from tog_drake.record import new_record, save_record
    from tog_drake.report import EpisodeReport, write_report
    from tog_drake.saved_view import load_pose, load_view
    from tog_drake.vlm_record import exchanges_of

    console = console_for(as_json)
    check_folder(out)
    config = PipelineConfig()
    options = SelectorOptions(
        selector, strategy, vlm, profile, rendering, votes, fallback, record, replay, deadline
    )
    options.apply(config, fallback="geometric")
    _override(config, proposer, k)
    view = load_view(rgb, depth, intrinsics, units_per_metre=depth_scale)
    X_WC = None if camera_pose is None else load_pose(camera_pose)
    with console.status(f"{deciding(config.selector)} ..."):
        decision = choose_on_view(view, config, task=task, seed=seed or 0, X_WC=X_WC)
    episode = new_record(decision, config, task=task, seed=seed or 0)
    overlay = decision_image(decision.view or view, decision.candidates, decision.choice)
    write_atomically(out / "grasps.json", json.dumps(grasps_record(decision), indent=1))
    write_atomically(out / "overlay.png", encode_png(overlay))
    save_record(out / "episode.json", episode)
    report = EpisodeReport(
        episode, decision.view or view, overlay, exchanges=exchanges_of(decision)
    )
    write_report(out / "report.html", [report])
    print_stages(console, episode)
    say(console, f"grasps: {out / 'grasps.json'}, picture: {out / 'overlay.png'}")
    say(console, f"report: {out / 'report.html'}")
    print_json(as_json, episode)
    raise typer.Exit(0 if decision.error is None else 1)


@app.command("eval", epilog=_epilog("tog eval --selectors top-score,oracle --seeds 5 --workers 2"))
def evaluate_(
    selectors: Annotated[
        str | None,
        typer.Option(help="Comma-separated; by default top-score,oracle, or vlm with --vlm."),
    ] = None,
    strategy: StrategyOption = None,
    vlm: ModelOption = None,
    profile: ProfileOption = None,
    rendering: RenderingOption = None,
    votes: VotesOption = None,
    fallback: FallbackOption = None,
    record: RecordOption = None,
    replay: ReplayOption = None,
    deadline: DeadlineOption = None,
    proposer: ProposerOption = None,
    scenarios: Annotated[
        str,
        typer.Option(
            help="Comma-separated; `objects` is every single object, `clutter` all three, `tog29` "
            "a suite of imported objects with tasks of its own."
        ),
    ] = "objects",
    tasks: Annotated[str, typer.Option(help="Comma-separated: use, handover, part.")] = (
        "use,handover"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="Poses of each object: seeds 0 .. N-1.")] = 5,
    noise: NoiseOption = False,
    scenario_text: ScenarioText = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[
        Path, typer.Option(help="Folder for episodes.jsonl and pictures of the failures.")
    ] = Path("out/eval"),
    as_json: JsonOption = False,
) -> None:
    """Run objects, seeds and tasks with each selector, and print the table of successes."""
    from tog_drake.evaluation import evaluate, make_cells, scenario_names
    from tog_drake.pipeline import SELECTORS
    from tog_drake.selectors.oracle import ORACLE_NOTE
    from tog_drake.suite import rows_of_suites
    from tog_drake.summary import agreement, failures, summarize

    console = console_for(as_json)
    check_folder(out)
    chosen = names(selectors or ("top-score,oracle" if vlm is None and replay is None else "vlm"))
    for selector in chosen:
        valid(selector, SELECTORS, "selector")
    options = SelectorOptions(
        None, strategy, vlm, profile, rendering, votes, fallback, record, replay, deadline
    )
    if "vlm" not in chosen and options.given():
        raise InputError(
            f"{', '.join(options.given())}: only a model is asked so; valid: with vlm among the "
            "--selectors"
        )
    cells = make_cells(
        scenario_names(names(scenarios)),
        chosen,
        range(seeds),
        tasks=names(tasks),
        noise=noise,
        text=scenario_text,
    )
    records = evaluate(
        cells,
        workers=workers,
        out=out,
        console=console,
        options=options,
        proposer=ProposerOptions(proposer),
    )
    rows, failed = summarize(records, rows_of_suites(names(scenarios))), failures(records)
    same = agreement(records)
    print_rates(console, rows)
    print_failures(console, failed)
    say(
        console,
        f"the part between the fingers is the one that the pads press in {same['agree']} of "
        f"{same['n']} lifts; where both are four fifths one part, in {same['clear_agree']} of "
        f"{same['clear']}",
    )
    if "oracle" in chosen:
        say(console, f"oracle: {ORACLE_NOTE}")
    found = {"rows": rows, "failures": failed, "agreement": same}
    print_json(as_json, found | ({"oracle": ORACLE_NOTE} if "oracle" in chosen else {}))


@app.command(epilog=_epilog("tog scenarios"))
def scenarios(as_json: JsonOption = False) -> None:
    """List the scenarios that come with the package."""
    from tog_drake.scenario import scenario_files

    console = console_for(as_json)
    found = {name: _first_comment(path) for name, path in scenario_files().items()}
    table = Table("scenario", "what it is")
    for name, comment in found.items():
        table.add_row(name, comment)
    console.print(table)
    print_json(as_json, found)


@app.command(epilog=_epilog("tog show Hammer --out hammer.html"))
def show(
    scenario: Annotated[
        str, typer.Argument(help="Name or YAML file; or `objects`: a picture of all objects.")
    ],
    scenario_text: ScenarioText = None,
    seed: SeedOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write a static page (of `objects`, a PNG) instead of serving one."),
    ] = None,
) -> None:
    """Show a scenario in Meshcat: live on localhost until Ctrl-C, or as a static page."""
    from tog_drake.showing import serve_scene, write_objects, write_scene

    if out is not None:
        check_file(out)
    if scenario == "objects":
        if out is None:
            raise InputError("tog show objects draws a picture; say where: --out objects.png")
        say(console_for(as_json=False), f"picture: {write_objects(out)}")
        return
    loaded = _load(scenario, scenario_text, seed=seed)
    console = console_for(as_json=False)
    if out is None:
        serve_scene(loaded, console)
    else:
        write_scene(loaded, out)
        say(console, f"page: {out}")


@app.command(epilog=_epilog("tog diagram Hammer --out hammer.svg"))
def diagram(
    scenario: Annotated[str, typer.Argument(help="Name or YAML file.")],
    out: Annotated[Path, typer.Option(help="SVG file.")],
    scenario_text: ScenarioText = None,
    selector: SelectorOption = None,
    vlm: ModelOption = None,
) -> None:
    """Draw the Diagram of a scenario: station, stages and the ports that connect them."""
    from tog_drake.diagram_graph import svg
    from tog_drake.episode import build_world, load_objects
    from tog_drake.files import write_atomically

    check_file(out)
    loaded = _load(scenario, scenario_text)
    SelectorOptions(selector, vlm=vlm).apply(loaded.pipeline, asks=False)
    write_atomically(out, svg(build_world(loaded, target=next(iter(load_objects(loaded)), None))))
    say(console_for(as_json=False), f"picture: {out}")


@app.command(epilog=_epilog("tog doctor"))
def doctor(as_json: JsonOption = False) -> None:
    """Check this machine: Python, Drake, rendering, Meshcat, disk, optional extras."""
    from tog_drake.doctor import run_checks

    console = console_for(as_json)
    checks = run_checks()
    for check in checks:
        mark = "ok     " if check.ok else ("PROBLEM" if check.required else "missing")
        say(console, f"{mark}  {check.name}: {check.found}")
    print_json(as_json, {check.name: vars(check) for check in checks})
    raise typer.Exit(0 if all(check.ok for check in checks if check.required) else 1)


app.command(epilog=_epilog("tog prompts cpg"))(prompts)
app.add_typer(vlm_app, name="vlm")
app.add_typer(assets_app, name="assets")
app.add_typer(serve_app, name="serve")


def main() -> None:
    """Runs the command: wrong input ends in one line and exit status 2, Ctrl-C in status 130."""
    debug = "--debug" in sys.argv
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    keep_drake_quiet()
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        app(args=arguments, prog_name="tog")
    except _Interrupted:
        sys.stderr.write("interrupted\n")
        sys.exit(130)
    except SystemExit as error:
        if isinstance(error.code, str):  # so ends Drake where a condition of it does not hold
            _fail(error, 2, debug)
        raise
    except (TogError, OSError) as error:
        _fail(error, 2, debug)
    except Exception as error:
        _fail(error, 3, debug)


def _fail(error: BaseException, status: int, debug: bool) -> NoReturn:
    """Says in one line what is wrong, and ends. Status 3: a defect of the program."""
    if debug:
        traceback.print_exc()
    message = " ".join(str(error).split())
    if status == 3:
        message = f"internal error, {type(error).__name__}: {message} (--debug shows where)"
    sys.stderr.write(f"tog: {visible(message)}\n")
    sys.exit(status)


class _Interrupted(BaseException):
    """Ctrl-C, kept from the command-line library, which would report it as a failure."""


def _interrupt(signum: int, frame: object) -> None:
    raise _Interrupted


def _scenario_of(object_: str | None) -> str:
    """The scenario of an object that is named alone; else the default one."""
    from tog_drake.evaluation import scenario_names

    if object_ is None:
        return DEFAULT_SCENARIO
    plain = {name.lower(): name for name in scenario_names(["objects"])}
    found = plain.get(object_.replace("_", "").replace(" ", "").lower())
    if found is None:
        raise InputError(f"unknown object {object_!r}; valid: {', '.join(plain)}")
    return found


def _target(object_: str | None, scenario: str | None) -> str | None:
    """The object to look for in a scenario that was given; a scenario of its own has only it."""
    return object_ if scenario is not None else None


def _load(
    name: str,
    text: str | None,
    selector: SelectorOptions | None = None,
    proposer: str | None = None,
    k: str | None = None,
    seed: int | None = None,
    fallback: str | None = None,
) -> "Scenario":
    """The scenario with the command's options in place."""
    from tog_drake.scenario import load_scenario

    scenario = load_scenario(name, text)
    if selector is not None:
        selector.apply(scenario.pipeline, fallback=fallback)
    _override(scenario.pipeline, proposer, k)
    if seed is not None:
        scenario.random_seed = seed
    return scenario


def _override(config: "PipelineConfig", proposer: str | None, k: str | None) -> None:
    from tog_drake.candidates import candidate_counts

    ProposerOptions(proposer).apply(config)
    if k is not None:
        config.candidates.k = k
        candidate_counts(config.candidates)  # a wrong K is refused before anything starts


def _first_comment(path: Path) -> str:
    first = path.read_text(encoding="utf-8").splitlines()[0]
    return first.lstrip("# ") if first.startswith("#") else ""


if __name__ == "__main__":
    main()
