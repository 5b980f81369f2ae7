"""The commands about scanned objects: ``tog assets ...``."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from tog_drake.assets.reporting import changes_of, details_of, line_of, rows_of
from tog_drake.errors import InputError
from tog_drake.files import check_file, write_atomically
from tog_drake.options import JsonOption, valid
from tog_drake.terminal import console_for, print_json, say
from tog_drake.visible_text import visible

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Scanned objects: bring them in, look at them, and put them into scenarios as "
    "package://tog_assets/NAME/model.sdf.",
)


@app.command("import", epilog="Example: tog assets import mug.obj --name red_mug --mass 0.118")
def import_(
    meshes: Annotated[list[Path], typer.Argument(help="OBJ, glTF, GLB, PLY or STL files.")],
    name: Annotated[
        str | None,
        typer.Option(
            help="Of the object; else that of the file, or of its folder where that says more."
        ),
    ] = None,
    scale: Annotated[float, typer.Option(help="Metres per unit of the file.")] = 1.0,
    up: Annotated[
        str | None,
        typer.Option(help="The axis of the file that points up: z | y; y for glTF unless given."),
    ] = None,
    mass: Annotated[float | None, typer.Option(help="[kg]; else from the density.")] = None,
    density: Annotated[float | None, typer.Option(help="[kg/m³], 400 unless given.")] = None,
    friction: Annotated[float | None, typer.Option(help="Coefficient, 0.8 unless given.")] = None,
    faces: Annotated[
        int | None,
        typer.Option(help="Of the surface that touches, as few as lie still unless given."),
    ] = None,
    decompose: Annotated[
        bool, typer.Option(help="Cut convex pieces where none come with it: seconds to minutes.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make scanned meshes into objects that can be grasped. Exit 0: all lie still; 1: not all."""
    from tog_drake.assets.importing import ImportOptions, import_mesh, name_for
    from tog_drake.assets.library import asset_names, read_report

    if name is not None and len(meshes) > 1:
        raise InputError(f"--name {name} is one name for {len(meshes)} meshes; import one by one")
    options = ImportOptions(scale=scale, up=_up(up), mass=mass, decompose=decompose)
    for option, value in (("density", density), ("friction", friction), ("faces", faces)):
        if value is not None:
            setattr(options, option, value)
    console = console_for(as_json)
    named = {name or name_for(mesh): mesh for mesh in meshes}
    if len(named) < len(meshes):
        raise InputError(
            f"{len(meshes)} meshes, but only {len(named)} names: {', '.join(named)}; "
            "import those of one name one by one, with --name"
        )
    before = {called: read_report(called) for called in named if called in asset_names()}
    reports = {}
    for called, mesh in named.items():
        with console.status(f"importing {mesh.name} ..."):
            reports[called] = import_mesh(mesh, called, options)
        say(console, f"{called}: {line_of(reports[called])}")
        say(console, f"  {details_of(reports[called])}")
        if called in before:
            changes = changes_of(before[called], reports[called])
            say(console, f"  it replaces the {called} imported before: {changes}")
        for note in reports[called]["notes"]:
            say(console, f"  note: {note}")
    print_json(as_json, reports)
    raise typer.Exit(0 if all(r["settled"]["ok"] for r in reports.values()) else 1)


def _up(axis: str | None) -> Literal["z", "y"] | None:
    if axis is None:
        return None
    if axis == "z":
        return "z"
    if axis == "y":
        return "y"
    raise InputError(f"--up must be z or y, not {axis!r}")


@app.command(epilog="Example: tog assets fetch ycb:048_hammer gso:Schleich_Lion_Action_Figure")
def fetch(
    objects: Annotated[list[str] | None, typer.Argument(help="ycb:NAME or gso:NAME.")] = None,
    suite: Annotated[str | None, typer.Option(help="All objects of a suite: tog29.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Download and import again what is there already.")
    ] = False,
    decompose: Annotated[
        bool, typer.Option(help="Cut convex pieces, which none of them has: seconds to minutes.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Download scanned objects from their official servers and import them. Exit 1: not all."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

    from tog_drake.assets import fetching

    wanted = [*(objects or ()), *(_objects_of(suite) if suite is not None else ())]
    if not wanted:
        raise InputError("nothing to fetch; valid: names such as ycb:048_hammer, or --suite tog29")
    console = console_for(as_json)
    columns = TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as bars:
        bar = bars.add_task("", total=None, visible=False)

        def progress(spec: str, done: int, total: int | None) -> None:
            if bars.tasks[bar].description != spec:
                bars.reset(bar, description=spec, visible=True)
            bars.update(bar, completed=done, total=total)

        def tell(fetched: fetching.Fetched) -> None:
            report = fetched.report
            how = fetched.message if report is None else line_of(report)
            say(console, f"{fetched.asset}: {fetched.status}{how and ', ' + how}")
            for note in report["notes"] if report is not None else ():
                say(console, f"  note: {note}")

        done = fetching.fetch(
            wanted, force=force, decompose=decompose, progress=progress, tell=tell
        )
    print_json(as_json, {fetched.asset: vars(fetched) for fetched in done})
    raise typer.Exit(1 if any(fetched.status == "failed" for fetched in done) else 0)


def _objects_of(suite: str) -> list[str]:
    from tog_drake.benchmark.suite import is_imported, load_suite, suite_files

    valid(suite, suite_files(), "suite")
    objects = [trial.object for trial in load_suite(suite).trials if is_imported(trial.object)]
    if not objects:
        raise InputError(f"the suite {suite} has no imported objects; there is nothing to fetch")
    return objects


@app.command("list", epilog="Example: tog assets list --json")
def list_(
    sheet: Annotated[
        Path | None, typer.Option(help="PNG file: draw them all on one sheet, too.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the imported objects."""
    from tog_drake.assets.library import asset_names, library_dir, read_report

    console = console_for(as_json)
    if sheet is not None:
        _draw_sheet(asset_names(), sheet)
    reports = {name: read_report(name) for name in asset_names()}
    if reports:
        table = Table("object", "what it is")
        for name, report in reports.items():
            table.add_row(name, line_of(report))
        console.print(table)
    say(console, f"{len(reports)} objects in {library_dir()}")
    print_json(as_json, reports)


def _draw_sheet(objects: list[str], path: Path) -> None:
    from tog_drake.assets import preview
    from tog_drake.drawing import encode_png

    check_file(path, "--sheet")
    write_atomically(path, encode_png(preview.sheet(objects), compression=9))


@app.command(epilog="Example: tog assets show red_mug --out red_mug.html")
def show(
    name: Annotated[str, typer.Argument(help="Of an imported object.")],
    out: Annotated[
        Path | None,
        typer.Option(help="Write a static page (.html) or its picture (.png) instead."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show what its import said of an object, and the object in Meshcat until Ctrl-C."""
    from tog_drake.assets.library import asset_dir, read_report
    from tog_drake.assets.viewing import copy_picture, serve_asset, write_page

    console = console_for(as_json)
    if out is not None:
        check_file(out, suffixes=(".png", ".html"))
    report = read_report(name)
    table = Table("of it", name, show_header=False)
    for row in rows_of(report):
        table.add_row(*map(visible, row))
    console.print(table)
    print_json(as_json, report)
    if out is None:
        serve_asset(asset_dir(name), console)
        return
    picture = _is_picture(out)
    (copy_picture if picture else write_page)(asset_dir(name), out)
    say(console, f"{'picture' if picture else 'page'}: {out}")


def _is_picture(out: Path) -> bool:
    return out.suffix.lower() == ".png"


@app.command(epilog="Example: tog assets label ycb_048_hammer --out labels.png")
def label(
    objects: Annotated[
        list[str] | None, typer.Argument(help="Imported objects; all of them unless given.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write a picture (.png), or a static page of one object (.html)."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show objects in the colours of their parts, and the area of each part. Without --out, one
    object is shown in Meshcat until Ctrl-C."""
    from tog_drake.assets import labelling
    from tog_drake.assets.library import asset_names
    from tog_drake.drawing import encode_png

    console = console_for(as_json)
    chosen = objects or asset_names()
    if out is not None:
        check_file(out, suffixes=(".png", ".html"))
    if not chosen or (len(chosen) != 1 and (out is None or not _is_picture(out))):
        raise InputError(
            f"{len(chosen)} objects cannot be shown in one page; name one object, or give "
            "--out labels.png"
        )
    areas = {name: labelling.labelled_faces(name).areas() for name in chosen}
    for name, parts in areas.items():
        shown = ", ".join(f"{part} {1e4 * area:.1f} cm²" for part, area in parts.items())
        say(console, f"{name}: {shown}")
    print_json(as_json, areas)
    if out is None:
        labelling.serve_labels(chosen[0], console)
        return
    if _is_picture(out):
        write_atomically(out, encode_png(labelling.label_sheet(chosen), compression=9))
    else:
        page = labelling.labels_in_meshcat(labelling.labelled_faces(chosen[0])).StaticHtml()
        write_atomically(out, page)
    say(console, f"{'picture' if _is_picture(out) else 'page'}: {out}")


@app.command("add-dir", epilog="Example: tog assets add-dir ../scans --workers 2")
def add_dir(
    folder: Annotated[Path, typer.Argument(help="Holds a folder for each object.")],
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    as_json: JsonOption = False,
) -> None:
    """Import a folder of scans. Exit 0: all lie still; 1: one does not, or cannot be imported.

    Each has a folder of its own with one mesh in it. A metadata.json beside these may say more:
    {NAME: {mesh, scale_to_m, up_axis, mass_kg_ycb, licence, repo}}.
    """
    from rich.progress import Progress

    from tog_drake.assets.adding import add, find_jobs

    console = console_for(as_json)
    jobs = find_jobs(folder)
    results = {}
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("objects", total=len(jobs))
        for name, report in add(jobs, workers):
            results[name] = report
            error = report.get("error")
            say(console, f"{name}: {line_of(report) if error is None else error}")
            for note in report.get("notes", ()):
                say(console, f"  note: {note}")
            progress.advance(bar)
    good = sum("error" not in r and r["settled"]["ok"] for r in results.values())
    say(console, f"{good} of {len(jobs)} are imported and lie still")
    print_json(as_json, results)
    raise typer.Exit(0 if good == len(jobs) else 1)


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
