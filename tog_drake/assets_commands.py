"""The commands about scanned objects: ``tog assets ...``."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from tog_drake.errors import InputError
from tog_drake.options import JsonOption
from tog_drake.terminal import console_for, print_json, say

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Scanned objects: bring them in, look at them, and put them into scenarios as "
    "package://tog_assets/NAME/model.sdf.",
)


@app.command("import", epilog="Example: tog assets import mug.obj --name red_mug --mass 0.118")
def import_(
    meshes: Annotated[list[Path], typer.Argument(help="OBJ, glTF, GLB, PLY or STL files.")],
    name: Annotated[str | None, typer.Option(help="Of the object; else that of the file.")] = None,
    scale: Annotated[float, typer.Option(help="Metres per unit of the file.")] = 1.0,
    up: Annotated[str, typer.Option(help="The axis of the file that points up: z | y.")] = "z",
    mass: Annotated[float | None, typer.Option(help="[kg]; else from the density.")] = None,
    density: Annotated[float | None, typer.Option(help="[kg/m³], 400 unless given.")] = None,
    friction: Annotated[float | None, typer.Option(help="Coefficient, 0.8 unless given.")] = None,
    faces: Annotated[
        int | None, typer.Option(help="Of the surface that touches, 1500 unless given.")
    ] = None,
    decompose: Annotated[
        bool, typer.Option(help="Cut convex pieces where none come with it: seconds to minutes.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make scanned meshes into objects that can be grasped. Exit 0: all lie still; 1: not all."""
    from tog_drake.assets.importing import ImportOptions, import_mesh

    if name is not None and len(meshes) > 1:
        raise InputError(f"--name {name} is one name for {len(meshes)} meshes; import one by one")
    options = ImportOptions(scale=scale, up=_up(up), mass=mass, decompose=decompose)
    for option, value in (("density", density), ("friction", friction), ("faces", faces)):
        if value is not None:
            setattr(options, option, value)
    console = console_for(as_json)
    reports = {}
    for mesh in meshes:
        with console.status(f"importing {mesh.name} ..."):
            called = name or mesh.stem
            reports[called] = import_mesh(mesh, called, options)
        say(console, f"{called}: {line_of(reports[called])}")
        for note in reports[called]["notes"]:
            say(console, f"  note: {note}")
    print_json(as_json, reports)
    raise typer.Exit(0 if all(r["settled"]["ok"] for r in reports.values()) else 1)


def _up(axis: str) -> Literal["z", "y"]:
    if axis == "z":
        return "z"
    if axis == "y":
        return "y"
    raise InputError(f"--up must be z or y, not {axis!r}")


@app.command(epilog="Example: tog assets fetch ycb:048_hammer gso:Schleich_Lion_Action_Figure")
def fetch(
    objects: Annotated[list[str], typer.Argument(help="ycb:NAME or gso:NAME.")],
    force: Annotated[
        bool, typer.Option("--force", help="Download and import again what is there already.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Download scanned objects from their official servers and import them. Exit 1: not all."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    from tog_drake.assets import fetching

    console = console_for(as_json)
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as bars:
        bar = bars.add_task("")

        def progress(spec: str, done: int, total: int | None) -> None:
            if bars.tasks[bar].description != spec:
                bars.reset(bar, description=spec)
            bars.update(bar, completed=done, total=total)

        def tell(fetched: fetching.Fetched) -> None:
            report = fetched.report
            how = fetched.message if report is None else line_of(report)
            say(console, f"{fetched.asset}: {fetched.status}{how and ', ' + how}")

        done = fetching.fetch(objects, force=force, progress=progress, tell=tell)
    print_json(as_json, {fetched.asset: vars(fetched) for fetched in done})
    raise typer.Exit(1 if any(fetched.status == "failed" for fetched in done) else 0)


@app.command("list", epilog="Example: tog assets list --json")
def list_(as_json: JsonOption = False) -> None:
    """List the imported objects."""
    from tog_drake.assets.library import asset_names, library_dir, read_report

    console = console_for(as_json)
    reports = {name: read_report(name) for name in asset_names()}
    if reports:
        table = Table("object", "what it is")
        for name, report in reports.items():
            table.add_row(name, line_of(report))
        console.print(table)
    say(console, f"{len(reports)} objects in {library_dir()}")
    print_json(as_json, reports)


def line_of(report: dict[str, Any]) -> str:
    """Returns the short form of an import report: size, mass, and how it lies."""
    try:
        length, width, height = (100 * side for side in report["extent"])
        rest = "lies still" if report["settled"]["ok"] else "does not lie still"
        return f"{length:.1f} x {width:.1f} x {height:.1f} cm, {report['mass']:.3g} kg, {rest}"
    except (KeyError, TypeError, ValueError):
        return "its report cannot be read; import it again"


@app.command(epilog="Example: tog assets remove red_mug")
def remove(
    name: Annotated[str, typer.Argument(help="Of an imported object.")],
    as_json: JsonOption = False,
) -> None:
    """Delete an imported object."""
    from tog_drake.assets.library import remove_asset

    remove_asset(name)
    say(console_for(as_json), f"removed: {name}")
    print_json(as_json, {"removed": name})
