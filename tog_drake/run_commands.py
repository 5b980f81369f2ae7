"""The commands that run the pipeline once: ``tog run``, ``demo`` and ``choose``."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tog_drake.errors import InputError
from tog_drake.files import check_folder
from tog_drake.options import (
    DEFAULT_SCENARIO,
    JsonOption,
    KOption,
    NoiseOption,
    ProposerOptions,
    ScenarioOption,
    ScenarioText,
    SeedOption,
    SelectorOptions,
    TaskOption,
    put_k,
)
from tog_drake.spread import spread
from tog_drake.terminal import (
    console_for,
    deciding,
    print_json,
    print_stages,
    say,
)
from tog_drake.view_options import ViewOptions

if TYPE_CHECKING:
    pass

DEMO_TASKS = {
    "use": "use the hammer to drive a nail",
    "handover": "hand me the hammer",
}


@spread()
def run(
    *,
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
    selector: SelectorOptions,
    proposer: ProposerOptions,
    views: ViewOptions,
    k: KOption = None,
    seed: SeedOption = None,
    noise: NoiseOption = False,
    out: Annotated[Path, typer.Option(help="Folder for episode.json and report.html.")] = Path(
        "out/run"
    ),
    meshcat: Annotated[
        bool, typer.Option(help="Show the run live on localhost, and its replay in the report.")
    ] = True,
    interactive: Annotated[
        bool,
        typer.Option(
            "--interactive",
            help="Go through it by hand, with buttons in Meshcat: look, propose, ask, choose "
            "yourself, approve, run, stop, again with a new seed.",
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run one simulated episode. Exit 0: lifted; 1: not, see the outcome; 2: bad input."""
    from tog_drake.benchmark.cells import scenario_of
    from tog_drake.cameras import with_noise
    from tog_drake.episode import run_episode
    from tog_drake.report import write_report
    from tog_drake.scenario import load_scenario
    from tog_drake.showing import report_of, save_episode, show_live
    from tog_drake.task import read_task
    from tog_drake.view_selection import Hand

    console = console_for(as_json)
    check_folder(out)
    read_task(task)  # a task without words is refused before anything starts
    name = scenario or (DEFAULT_SCENARIO if object_ is None else scenario_of(object_))
    loaded = load_scenario(name, scenario_text, seed=seed)
    selector.apply(loaded.pipeline, fallback="geometric")
    proposer.apply(loaded.pipeline)
    put_k(loaded.pipeline, k)
    views.apply(loaded)
    if views.target is not None and isinstance(loaded.pipeline.view_selection.scorer, Hand):
        raise InputError(
            f"--target {views.target!r}: only who compares views reads it; valid: with --view"
        )
    if loaded.asset is not None and object_ is not None:
        loaded.asset = object_
    if noise:
        loaded.cameras = with_noise(loaded.cameras)
    target = object_ if scenario is not None else None  # alone in a scenario of its own
    if interactive and not meshcat:
        raise InputError("--interactive has its buttons in Meshcat; valid: without --no-meshcat")
    live = show_live(console) if meshcat else None
    if interactive:
        from tog_drake.control_panel import ControlPanel

        assert live is not None
        loaded.simulator_config.target_realtime_rate = 1.0  # or nobody could stop it
        say(console, "open it, then Open Controls at its top right; Ctrl-C or End ends it")
        panel = ControlPanel(live, loaded, name=name, task=task, target=target, out=out)
        last = panel.run()
        if last is not None:
            print_stages(console, last.record)
            print_json(as_json, last.record)
        raise typer.Exit(0 if last is not None and last.record["outcome"] == "lifted" else 1)
    with console.status(f"looking, {deciding(loaded.pipeline.selector)}, moving ..."):
        episode = run_episode(loaded, name=name, task=task, target=target, meshcat=live)
    save_episode(out, episode.record, episode.recording)
    write_report(out / "report.html", [report_of(episode)])
    print_stages(console, episode.record)
    say(console, f"report: {out / 'report.html'}")
    print_json(as_json, episode.record)
    raise typer.Exit(0 if episode.record["outcome"] == "lifted" else 1)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the report and the episodes.")] = Path(
        "out/demo"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Where the hammer lies.")] = 0,
) -> None:
    """One hammer, two tasks: held by the handle to use it, by the head to hand it over."""
    from tog_drake.episode import run_episode
    from tog_drake.report import write_report
    from tog_drake.scenario import load_scenario
    from tog_drake.showing import report_of, save_episode
    from tog_drake.visualization import make_meshcat

    console = console_for(as_json=False)
    check_folder(out)
    loaded = load_scenario(DEFAULT_SCENARIO, seed=seed)
    episodes = []
    for label, task in DEMO_TASKS.items():
        with console.status(f"{task} ..."):
            episode = run_episode(
                loaded, name=DEFAULT_SCENARIO, task=task, target=None, meshcat=make_meshcat()
            )
        save_episode(out / label, episode.record, episode.recording)
        print_stages(console, episode.record)
        episodes.append(episode)
    write_report(out / "report.html", [report_of(episode) for episode in episodes])
    say(console, f"report: {out / 'report.html'}")
    good = all(episode.record["combined_success"] for episode in episodes)
    raise typer.Exit(0 if good else 1)


@spread()
def choose(
    *,
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
    selector: SelectorOptions,
    proposer: ProposerOptions,
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
    from tog_drake.record import new_record
    from tog_drake.report import EpisodeReport, write_report
    from tog_drake.saved_view import load_pose, load_view
    from tog_drake.showing import save_episode
    from tog_drake.vlm_record import exchanges_of

    console = console_for(as_json)
    check_folder(out)
    config = PipelineConfig()
    selector.apply(config, fallback="geometric")
    proposer.apply(config)
    put_k(config, k)
    view = load_view(rgb, depth, intrinsics, units_per_metre=depth_scale)
    X_WC = None if camera_pose is None else load_pose(camera_pose)
    with console.status(f"{deciding(config.selector)} ..."):
        decision = choose_on_view(view, config, task=task, seed=seed or 0, X_WC=X_WC)
    episode = new_record(decision, config, task=task, seed=seed or 0)
    overlay = decision_image(decision.view or view, decision.candidates, decision.choice)
    write_atomically(out / "grasps.json", json.dumps(grasps_record(decision), indent=1))
    write_atomically(out / "overlay.png", encode_png(overlay))
    save_episode(out, episode)
    report = EpisodeReport(
        episode, decision.view or view, overlay, exchanges=exchanges_of(decision)
    )
    write_report(out / "report.html", [report])
    print_stages(console, episode)
    say(console, f"grasps: {out / 'grasps.json'}, picture: {out / 'overlay.png'}")
    say(console, f"report: {out / 'report.html'}")
    print_json(as_json, episode)
    raise typer.Exit(0 if decision.error is None else 1)
