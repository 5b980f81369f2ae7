"""Writes what runs of a benchmark found: one page that needs nothing else, and files of tables.

As the report of an episode, the page loads nothing from anywhere, every text in it is escaped, and
a content security policy forbids all requests besides. Its pictures are small and each is carried
once; cards are built as they are looked at.
"""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tog_drake.benchmark.detail_sheets import detail_sheets
from tog_drake.benchmark.figures import candidate_figure
from tog_drake.benchmark.gallery import Pictures, Replays, cards
from tog_drake.benchmark.human_labels import labels_of
from tog_drake.benchmark.journal import COMMAND, Run, read_run
from tog_drake.benchmark.sheets import Sheet, shown
from tog_drake.benchmark.success_sheets import scene_sheet, success_sheets
from tog_drake.benchmark.table_files import csv_text, latex_text, markdown_text
from tog_drake.benchmark.tables import in_table_order, methods_of, runs_of
from tog_drake.benchmark.view_sheets import view_sheets
from tog_drake.files import write_atomically
from tog_drake.pages import page_environment
from tog_drake.visible_text import visible

PAGE = "report.html"
_DIGESTS = ("files", "scenarios", "objects")  # of a run.json
_LONGEST_COMMAND = 20_000  # characters


def write_benchmark_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Writes page and tables of runs into a folder, each file whole or not at all.

    Args:
        folders: of the runs, ended or not; each is a part of the page.
        out: where ``report.html``, ``tables.csv``, ``tables.md`` and ``tables.tex`` go.

    Returns:
        The files.

    Raises:
        InputError: a folder holds no run.
    """
    runs = [read_run(folder) for folder in folders]
    names = _names(runs)
    sheets = {name: _sheets(run) for name, run in zip(names, runs, strict=True)}
    scenes = scene_sheet(runs)
    tables = {**({"Scenes": [scenes]} if scenes else {}), **sheets}
    contents = {
        PAGE: _page(names, runs, sheets, scenes),
        "tables.csv": csv_text({n: run.lines for n, run in zip(names, runs, strict=True)}),
        "tables.md": markdown_text(tables),
        "tables.tex": latex_text(tables),
    }
    for name, content in contents.items():
        write_atomically(out / name, content)
    return [out / name for name in contents]


def _names(runs: Sequence[Run]) -> list[str]:
    """What to call each run: its suite, and its folder where two are of one suite."""
    suites = [str(run.config.get("suite")) for run in runs]
    return [
        suite if suites.count(suite) == 1 else f"{suite} ({run.folder})"
        for suite, run in zip(suites, runs, strict=True)
    ]


def _sheets(run: Run) -> list[Sheet]:
    views = view_sheets(run.lines)
    return success_sheets(run.lines) + views + detail_sheets(run.lines, labels_of(run))


def _page(
    names: Sequence[str],
    runs: Sequence[Run],
    sheets: Mapping[str, Sequence[Sheet]],
    scenes: Sheet | None,
) -> str:
    lines = [line for run in runs for line in run.lines]
    methods = dict.fromkeys(method for run in runs for method in methods_of(run.lines))
    gallery, left_out = _gallery(runs)
    return (
        page_environment()
        .get_template("benchmark.html.j2")
        .render(
            title=shown(f"Grasping by task: {', '.join(names)}"),
            summary=f"{len(lines)} tasks, {sum(len(runs_of(run.lines)) for run in runs)} episodes, "
            f"{len(methods)} methods",
            scenes=scenes,
            runs=[_part(name, run, sheets[name]) for name, run in zip(names, runs, strict=True)],
            gallery=gallery,
            left_out=left_out,
        )
    )


def _part(name: str, run: Run, sheets: Sequence[Sheet]) -> dict[str, Any]:
    """Returns what the page shows of a run; the figure stands where its table does."""
    figure = candidate_figure(run.lines)
    at = next((i for i, sheet in enumerate(sheets) if sheet.key == "candidates"), len(sheets))
    return {
        "title": shown(name),
        "command": visible(command(run), limit=_LONGEST_COMMAND, lines=True),
        "facts": {shown(key): shown(text, 2000) for key, text in _facts(run).items()},
        "figure": figure,
        "before": sheets[:at],
        "after": sheets[at:],
    }


def _facts(run: Run) -> dict[str, str]:
    """What was asked for, in words."""
    said: dict[str, str] = {}
    for key, value in run.config.items():
        if key in ("schema", "suite", "suite_sha256", "program", COMMAND, *_DIGESTS) or not value:
            continue
        if text := _said(value):
            said[key.replace("_", " ").capitalize()] = text
    files = [f"{len(run.config[of])} {of}" for of in _DIGESTS if run.config.get(of)]
    if files:
        said["Files"] = f"suite, {', '.join(files)}: the SHA-256 of each is in run.json"
    if program := run.config.get("program"):
        said["Program"] = f"SHA-256 {str(program)[:12]}..."
    started = methods_of(run.lines)
    waiting = [name for name in run.config.get("methods", ()) if name not in started]
    if waiting:
        said["No episode yet"] = _said(waiting)
    return said


def command(run: Run) -> str:
    """Returns what runs the same again, fit for a shell; "" where an old run says none."""
    return shlex.join(run.config.get(COMMAND, ()))


def _said(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_said, value))
    if isinstance(value, dict):
        return ", ".join(f"{key} {_said(v)}" for key, v in value.items() if v not in (None, False))
    return "yes" if value is True else str(value)


def _gallery(runs: Sequence[Run]) -> tuple[dict[str, Any], str]:
    """Returns the data of the cards, and what of it had to be left out."""
    pictures, replays = Pictures(), Replays()
    shown_cards = [
        card
        for run in runs
        for card in cards(Run(run.folder, run.config, in_table_order(run.lines)), pictures, replays)
    ]
    encoded, (viewer, packed) = pictures.encoded(), replays.packed()
    missing = {
        "pictures": len(pictures) - len(encoded),
        "replays": len(replays) - len(packed),
    }
    told = " and ".join(f"{n:,} {what}" for what, n in missing.items() if n)
    note = "are left out: they cannot be read, or the page would be too large."
    data = {"cards": shown_cards, "pictures": encoded, "viewer": viewer, "replays": packed}
    return data, f"{told} {note}" if told else ""
