"""The commands that show what there is: ``tog scenarios``, ``show``, ``diagram`` and ``doctor``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from tog_drake.errors import InputError
from tog_drake.files import check_file, check_folder
from tog_drake.options import (
    JsonOption,
    ModelOption,
    ScenarioText,
    SeedOption,
    SelectorOption,
    SelectorOptions,
    scenario_names,
)
from tog_drake.terminal import console_for, print_json, say


def scenarios(as_json: JsonOption = False) -> None:
    """List the scenarios that come with the package."""
    from tog_drake.resources import scenario_files

    console = console_for(as_json)
    found = {name: _first_comment(path) for name, path in scenario_files().items()}
    table = Table("scenario", "what it is")
    for name, comment in found.items():
        table.add_row(name, comment)
    console.print(table)
    print_json(as_json, found)


def _first_comment(path: Path) -> str:
    first = path.read_text(encoding="utf-8").splitlines()[0]
    return first.lstrip("# ") if first.startswith("#") else ""


def show(
    scenario: Annotated[
        str,
        typer.Argument(
            help="Name or YAML file; or `objects`: a picture of all objects.",
            autocompletion=scenario_names,
        ),
    ],
    scenario_text: ScenarioText = None,
    seed: SeedOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write a static page (of `objects`, a PNG) instead of serving one."),
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Write what the hand's camera sees to this folder, as `tog choose` reads it: "
            "color.png, depth.png, camera.json, pose.json."
        ),
    ] = None,
) -> None:
    """Show a scenario in Meshcat: live on localhost until Ctrl-C, as a page, or as images."""
    from tog_drake.saved_view import save_view
    from tog_drake.scenario import load_scenario
    from tog_drake.showing import first_view, serve_scene, write_objects, write_scene

    if out is not None:
        check_file(out, suffixes=(".png" if scenario == "objects" else ".html",))
    if images is not None:
        check_folder(images, "--images")
    if scenario == "objects":
        if out is None:
            raise InputError("tog show objects draws a picture; say where: --out objects.png")
        say(console_for(as_json=False), f"picture: {write_objects(out)}")
        return
    loaded = load_scenario(scenario, scenario_text, seed=seed)
    console = console_for(as_json=False)
    if images is not None:
        save_view(images, first_view(loaded))
        say(console, f"images: {images}")
    if out is not None:
        write_scene(loaded, out)
        say(console, f"page: {out}")
    if images is None and out is None:
        serve_scene(loaded, console)


def diagram(
    scenario: Annotated[
        str, typer.Argument(help="Name or YAML file.", autocompletion=scenario_names)
    ],
    out: Annotated[Path, typer.Option(help="SVG file.")],
    scenario_text: ScenarioText = None,
    selector: SelectorOption = None,
    vlm: ModelOption = None,
) -> None:
    """Draw the Diagram of a scenario: station, stages and the ports that connect them."""
    from tog_drake.diagram_graph import svg
    from tog_drake.files import write_atomically
    from tog_drake.scenario import load_scenario
    from tog_drake.world import build_world, load_objects

    check_file(out, suffixes=(".svg",))
    loaded = load_scenario(scenario, scenario_text)
    SelectorOptions(selector, vlm=vlm).apply(loaded.pipeline, asks=False)
    write_atomically(out, svg(build_world(loaded, target=next(iter(load_objects(loaded)), None))))
    say(console_for(as_json=False), f"picture: {out}")


def doctor(
    scenario: Annotated[
        str | None,
        typer.Option(help="Check how well the poses of this scenario's cameras agree, too."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Check this machine: Python, Drake, rendering, Meshcat, disk, optional extras."""
    from tog_drake.doctor import camera_checks, run_checks

    console = console_for(as_json)
    checks = run_checks()
    if scenario is not None:
        from tog_drake.scenario import load_scenario

        checks += camera_checks(load_scenario(scenario))
    for check in checks:
        mark = "ok     " if check.ok else ("PROBLEM" if check.required else "missing")
        say(console, f"{mark}  {check.name}: {check.found}")
    print_json(as_json, {check.name: vars(check) for check in checks})
    raise typer.Exit(0 if all(check.ok for check in checks if check.required) else 1)
