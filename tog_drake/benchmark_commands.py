"""The commands about many episodes: ``tog eval`` and ``tog report``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tog_drake.benchmark.options import MethodOptions, SuiteArgument, SuiteOptions
from tog_drake.errors import InputError
from tog_drake.files import check_file, check_folder
from tog_drake.options import JsonOption, SelectorOptions
from tog_drake.spread import spread
from tog_drake.terminal import (
    console_for,
    print_failures,
    print_json,
    print_origins,
    print_rates,
    say,
)
from tog_drake.view_options import ViewOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from tog_drake.benchmark.journal import Line
    from tog_drake.benchmark.runner import Parallel

_DECIDE_NOTHING = ("workers", "limit", "max_cost", "replays", "out", "fresh", "as_json")
"""Options of a run that no result depends on."""


@spread(without=["selector", "strategy", "vlm", "view"])
def evaluate_(
    context: typer.Context,
    suite: SuiteArgument,
    *,
    compared: MethodOptions,
    options: SelectorOptions,
    runs: SuiteOptions,
    cameras: ViewOptions,
    judge: Annotated[
        str | None, typer.Option(help="A model that judges besides: vlm:MODEL, as of --vlm.")
    ] = None,
    workers: Annotated[
        str,
        typer.Option(
            help="How many processes; or ray, for a Ray cluster that runs here or is started; or "
            "ray:ADDRESS."
        ),
    ] = "2",
    limit: Annotated[
        int | None, typer.Option(min=0, help="Run no more than so many episodes this time.")
    ] = None,
    max_cost: Annotated[
        float | None, typer.Option(min=0.0, help="[USD] Begin no episode once models cost that.")
    ] = None,
    replays: Annotated[
        bool, typer.Option("--replays", help="Record each episode, to be played in a browser.")
    ] = False,
    out: Annotated[
        Path, typer.Option(help="Folder of the run. One that was stopped is taken up there.")
    ] = Path("out/eval"),
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Delete the run that is there, and begin anew.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the trials of a suite with each method, and print the tables of successes.

    Whatever stops it, the same command again goes on where it was.
    """
    from dataclasses import replace

    from tog_drake.benchmark.episodes import EpisodeWork
    from tog_drake.benchmark.identity import run_config
    from tog_drake.benchmark.journal import COMMAND, SHARED, Journal
    from tog_drake.benchmark.judging import vlm_judge
    from tog_drake.benchmark.runner import evaluate
    from tog_drake.benchmark.suite import load_suite

    console = console_for(as_json)
    check_folder(out)
    loaded = load_suite(suite, runs.scenario_text)
    methods = compared.methods(options)
    cells = runs.cells(loaded, methods, cameras)
    parallel, count = _parallel(workers)
    shared = (out / SHARED).resolve()
    work = EpisodeWork(shared, options, compared.checkpoint, judge, replays)
    config = run_config(loaded, methods, cells, work, seeds=runs.seeds or loaded.seeds)
    if judge is not None:
        vlm_judge(judge)  # hears what is wrong before anything starts
    with Journal(out, {**config, COMMAND: command_words(context)}, fresh=fresh) as journal:
        try:
            why = evaluate(
                cells,
                replace(work, asked=config),
                journal,
                workers=count,
                console=console,
                limit=limit,
                max_cost=max_cost,
                parallel=parallel,
            )
        finally:
            found = _print_successes(console, journal.lines)
    if why is not None:
        say(console, why)
    print_json(as_json, found | {"cells": len(cells), "stopped": why})


def report(
    folders: Annotated[
        list[Path], typer.Argument(metavar="DIR...", help="Folders of runs, as tog eval left them.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for report.html and the tables; by default the first DIR."),
    ] = None,
) -> None:
    """Write the page and the tables of one or several runs of tog eval, ended or not."""
    from tog_drake.benchmark.report import write_benchmark_report

    console = console_for(as_json=False)
    target = out or folders[0]
    check_folder(target, "DIR" if out is None else "--out")
    with console.status("writing the page ..."):
        files = write_benchmark_report(folders, target)
    for file in files:
        say(console, f"written: {file}")


def label(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of a run, as tog eval left it.")
    ],
    sample: Annotated[int, typer.Option(min=1, help="Grasps to judge, drawn at random.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Of the sample and its order.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="The page; by default labels.html in DIR.")
    ] = None,
    answers: Annotated[
        Path | None,
        typer.Option("--import", help="The file that the page saved: enters it instead."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Have people judge a blind sample of a run's grasps: writes a page, or enters its answers."""
    from dataclasses import asdict

    from tog_drake.benchmark.human_labels import (
        agreements,
        export_sample,
        import_answers,
        labels_of,
    )
    from tog_drake.benchmark.journal import read_run

    console = console_for(as_json)
    if answers is None:
        page = out or folder / "labels.html"
        check_file(page)
        count = export_sample(folder, page, count=sample, seed=seed)
        say(console, f"{count} grasps to judge: open {page} and save the answers, then")
        say(console, f"tog label {folder} --import answers.jsonl")
        print_json(as_json, {"page": str(page), "grasps": count})
        return
    known = import_answers(folder, answers)
    say(console, f"{known} grasps are judged by people")
    run = read_run(folder)
    found = agreements(run.lines, labels_of(run))
    for who, same in found.items():
        kappa = "not defined" if same.kappa is None else f"{same.kappa:.2f}"
        share = "" if same.agree is None else f"{same.agree:.0%} of "
        say(console, f"{who} agree on {share}{same.n}; Cohen's kappa {kappa}")
    print_json(as_json, {"judged": known, "agreement": {w: asdict(s) for w, s in found.items()}})


def command_words(context: typer.Context) -> list[str]:
    """Returns the words of a `tog eval`, with all options that decide what comes of it."""
    words = ["tog", "eval"]
    for option in context.command.params:
        name, value = str(option.name), context.params.get(str(option.name))
        source = context.get_parameter_source(name)
        if name in _DECIDE_NOTHING or source is None or source.name == "DEFAULT":
            continue
        said = option.opts[:1] if option.param_type_name == "option" else []
        if value is True:
            words += said
        else:
            values = value if isinstance(value, list | tuple) else [value]
            words += [word for each in values for word in (*said, str(each))]
    return words


def _parallel(workers: str) -> "tuple[Parallel, int]":
    """Returns how to work on several cells at once, and on how many."""
    from tog_drake.benchmark.processes import in_processes

    kind, colon, address = workers.partition(":")
    if kind == "ray" and (address or not colon):
        from tog_drake.benchmark.cluster import on_cluster

        return on_cluster(address or None), 1
    if not workers.isascii() or not workers.isdecimal() or int(workers) < 1:
        raise InputError(f"--workers {workers!r}; valid: 1 or more, ray or ray:ADDRESS")
    return in_processes, int(workers)


def _print_successes(console: "Console", lines: "Sequence[Line]") -> "dict[str, Any]":
    """Prints who proposed and the tables of what came of it; returns them for a program."""
    from tog_drake.benchmark.failures import failure_rows, fingers_and_pads
    from tog_drake.benchmark.tables import paired_rows, success_rows, view_rows
    from tog_drake.selectors.oracle import ORACLE_NOTE

    found: dict[str, Any] = {
        "rows": success_rows(lines),
        "pairs": paired_rows(lines),
        "views": view_rows(lines),
        "failures": failure_rows(lines),
        "fingers_and_pads": fingers_and_pads(lines),
    }
    if not lines:
        return found
    print_origins(console, [line["record"]["proposer"] for line in lines])
    print_rates(console, found["rows"])
    print_failures(console, found["failures"])
    same = found["fingers_and_pads"]
    say(
        console,
        f"the part between the fingers is the one that the pads press in {same['agree']} of "
        f"{same['n']} lifts; where both are four fifths one part, in {same['clear_agree']} of "
        f"{same['clear']}",
    )
    if any(line["cell"]["selector"] == "oracle" for line in lines):
        say(console, f"oracle: {ORACLE_NOTE}")
        found["oracle"] = ORACLE_NOTE
    return found
