"""The commands about vision-language models: ``tog prompts`` and ``tog vlm ...``."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tog_drake.benchmark.options import SuiteOptions
from tog_drake.errors import InputError
from tog_drake.files import check_file, check_folder
from tog_drake.options import (
    DEFAULT_SCENARIO,
    MODEL_FORMS,
    MODEL_HELP,
    JsonOption,
    KOption,
    ProfileOption,
    RenderingOption,
    ScenarioOption,
    SeedOption,
    SelectorOptions,
    valid,
)
from tog_drake.spread import spread
from tog_drake.terminal import asking, console_for, print_json, say
from tog_drake.view_options import ViewOptions

if TYPE_CHECKING:
    from rich.console import Console

    from tog_drake.benchmark.cells import Cell
    from tog_drake.benchmark.method import Method
    from tog_drake.vlm_export import Exported

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Try out a vision-language model, or have its questions answered elsewhere.",
)

_EXAMPLE = {  # what fills the places of a prompt when it is shown
    "task": "hand me the hammer",
    "target": "hammer",
    "round": 1,
    "rounds": 3,
    "problem": "the answer names none of the labels",
    "answer": "I would take the head.",
    "question": "point",  # the last of the canary's
    "color": "red",
}
_LABELS = {"marked": ("1", "2", "3"), "paper": ("red", "green", "blue")}
_ROLES = {"cpg": ("grasp",), "avoid": ("grasp", "avoid"), "canary": ("disc",)}  # of their points
_SEPARATE = ("gmi", "cpmi", "view")  # an image each: labels are numbers in every rendering


def prompts(
    name: Annotated[
        str | None, typer.Argument(help="Of the prompt; without it all are listed.")
    ] = None,
    prompt: Annotated[
        Path | None, typer.Option(help="File with a text of your own in place of the strategy's.")
    ] = None,
    rendering: RenderingOption = "marked",
    profile: Annotated[
        str | None, typer.Option(help="Of the model: shows how it is told to answer, too.")
    ] = None,
    source: Annotated[
        bool, typer.Option("--source", help="Print the template instead, to be changed.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """List what models are asked, or show one text with example values as it is sent.

    To ask by a text of your own: `tog prompts cpg --source > mine.j2`, change it, look at it with
    `tog prompts cpg --prompt mine.j2`, and give --prompt to whatever asks a model.
    """
    from tog_drake.selectors import prompts as texts
    from tog_drake.selectors.strategies import STRATEGIES, own_prompt
    from tog_drake.selectors.vlm import answers
    from tog_drake.selectors.vlm.profiles import find_profile
    from tog_drake.selectors.vlm.question import Options, Points

    console = console_for(as_json)
    if name is None:
        if prompt is not None or source:
            option = "--source" if source else f"--prompt {prompt}"
            raise InputError(f"{option}: of which? valid: {', '.join(STRATEGIES)}")
        all_of_them = [texts.load(known) for known in texts.names()]
        for text in all_of_them:
            say(console, f"{text.version:<10} {text.about}".rstrip())
        versions = dict(zip(texts.names(), (text.version for text in all_of_them), strict=True))
        print_json(as_json, versions)
        return
    labels = valid(rendering or "marked", _LABELS, "rendering")
    if name in _SEPARATE:
        labels = _LABELS["marked"]
    places = {**_EXAMPLE, "rendering": rendering, "labels": labels, "count": len(labels)}
    if prompt is None:
        asked = texts.load(name)
    else:
        valid(name, STRATEGIES, "strategy")
        asked = own_prompt(prompt, name, "paper" if rendering == "paper" else "marked")
    shown = asked.source.rstrip() if source else asked.render(**places)
    if profile is not None and not source:
        expects = Points(_ROLES[name], (896, 672)) if name in _ROLES else Options(labels)
        shown += "\n\n" + answers.instruction(find_profile("", profile), expects)
    for line in shown.splitlines():
        say(console, line)
    print_json(as_json, {"version": asked.version, "text": shown})


@app.command(epilog="Example: tog vlm check --vlm openai:any@http://localhost:8080/v1")
def check(
    vlm: Annotated[str, typer.Option(help=MODEL_HELP)],
    profile: ProfileOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the image that is shown.")] = 0,
    deadline: Annotated[float, typer.Option(min=0.1, help="[s] for all questions.")] = 120.0,
    as_json: JsonOption = False,
) -> None:
    """Ask a model what is known, to see whether it can be used. Exit 0: all well; 1: not."""
    from tog_drake.record import usage
    from tog_drake.selectors.vlm.canary import check_model
    from tog_drake.selectors.vlm.client import Client
    from tog_drake.selectors.vlm.profiles import find_profile
    from tog_drake.selectors.vlm.specification import read_specification, specification

    console = console_for(as_json)
    if vlm.startswith("replay:"):
        raise InputError(f"--vlm {vlm}: a file is no model to be checked; valid: {MODEL_FORMS}")
    model = read_specification(vlm, profile)
    found = find_profile(model.model, model.profile)
    client = Client(model, profile=found.name)
    with console.status(f"{asking(model, deadline)} ..."):
        report = check_model(
            client, found, max_tokens=model.max_tokens, seconds=deadline, seed=seed
        )
    say(console, f"{specification(model)}, profile {found.name}")
    for finding in report.findings:
        mark = "ok     " if finding.ok else ("PROBLEM" if finding.required else "missing")
        say(console, f"{mark}  {finding.name}: {finding.found}")
    asked = report.exchanges
    took = usage(sum(e.seconds for e in asked), [e.tokens for e in asked], [e.cost for e in asked])
    say(console, f"questions asked: {len(asked)}; {took}")
    told = ("answer", "status", "message", "model", "seconds", "tokens", "cost")
    print_json(
        as_json,
        {
            "model": specification(model),
            "profile": found.name,
            "well": report.well,
            "findings": {finding.name: vars(finding) for finding in report.findings},
            "exchanges": [{key: getattr(e, key) for key in told} for e in asked],
        },
    )
    raise typer.Exit(0 if report.well else 1)


@app.command(
    "export",
    epilog="Example: tog vlm export --vlm gemini:gemini-3.8-flash --cassette mugs.jsonl "
    "builtin --seeds 5",
)
@spread(without=["selector", "fallback", "record", "replay", "deadline"])
def export(
    suite: Annotated[
        str | None,
        typer.Argument(metavar="SUITE", help="As of tog eval: all its episodes are asked for."),
    ] = None,
    *,
    cassette: Annotated[
        Path, typer.Option(help="File with the answers so far; the questions go there too.")
    ],
    options: SelectorOptions,
    task: Annotated[
        str | None, typer.Option(help="What the robot should do, in one scenario.")
    ] = None,
    scenario: ScenarioOption = None,
    object_: Annotated[
        str | None, typer.Option("--object", help="Which object the task is about.")
    ] = None,
    seed: SeedOption = None,
    runs: SuiteOptions,
    views: ViewOptions,
    k: KOption = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 2,
    out: Annotated[
        Path, typer.Option(help="Folder for the batch files, the page and the blank answers.")
    ] = Path("out/vlm-export"),
    as_json: JsonOption = False,
) -> None:
    """Write down the questions of a run or a suite, to be answered elsewhere or by hand.

    Only what the cassette has no answer to. Nothing is sent, and no key is needed.
    """
    from tog_drake.benchmark.method import Method
    from tog_drake.vlm_export import export_questions

    console = console_for(as_json)
    check_folder(out)
    check_file(cassette, "--cassette")
    method, cameras = Method("vlm", k=k, view=views.view), replace(views, view=None)
    cells = _cells(suite, task, scenario, object_, seed, runs, method)
    cells = [replace(cell, views=cameras) for cell in cells]
    exported = export_questions(
        cells,
        replace(options, selector="vlm", fallback="fail"),
        cassette=cassette,
        out=out,
        workers=workers,
        console=console,
    )
    _say_exported(console, exported, cassette, out, "run" if suite is None else f"eval {suite}")
    content = {**vars(exported), "files": [str(file) for file in exported.files]}
    print_json(as_json, content)


def _cells(
    suite: str | None,
    task: str | None,
    scenario: str | None,
    object_: str | None,
    seed: int | None,
    runs: SuiteOptions,
    method: "Method",
) -> "list[Cell]":
    """Returns the episodes that are asked for: of a suite, or the one of a task.

    Raises InputError where that makes no sense.
    """
    from tog_drake.benchmark.suite import load_suite

    if suite is not None and task is None:
        if any(given is not None for given in (scenario, object_, seed)):
            raise InputError("--scenario, --object and --seed go with --task; valid: --seeds")
        return runs.cells(load_suite(suite, runs.scenario_text), [method])
    if suite is None and task is not None:
        return [_cell(task, scenario or DEFAULT_SCENARIO, object_, seed, runs, method)]
    both = "" if task is None else ", not both"
    raise InputError(f"what is to be asked? valid: --task for one scenario, or a suite{both}")


def _cell(
    task: str,
    scenario: str,
    object_: str | None,
    seed: int | None,
    runs: SuiteOptions,
    method: "Method",
) -> "Cell":
    """Returns the one episode of a task; raises InputError where it makes no sense."""
    from tog_drake.benchmark.cells import Cell
    from tog_drake.benchmark.suite import Trial
    from tog_drake.scenario import load_scenario
    from tog_drake.task import read_task

    read_task(task)
    if seed is None:
        seed = load_scenario(scenario, runs.scenario_text).random_seed
    asked = Trial(object_ or "", task, "", frozenset(), scenario)
    return Cell(0, method, seed, (asked,), runs.noise, runs.scenario_text)


def _say_exported(
    console: "Console", exported: "Exported", cassette: Path, out: Path, command: str
) -> None:
    """Says what came of it and what comes next: ``command`` is that of the episodes."""
    for reason in exported.over:
        say(console, f"no question: {reason}")
    say(
        console,
        f"episodes: {exported.decided} decided, {exported.waiting} waiting for answers, "
        f"{len(exported.over)} without a question",
    )
    if not exported.questions:
        say(console, "questions: none pending")
        say(console, f"go on: tog {command} --vlm replay:{cassette}, with the same options")
        return
    say(console, f"questions: {exported.questions} pending")
    say(console, f"for a batch API: {', '.join(map(str, exported.files))}; {exported.how}")
    say(console, f"by hand: look at {out / 'index.html'}, fill in {out / 'answers.jsonl'}")
    say(console, f"then: tog vlm import ANSWERS --cassette {cassette}, and this command again")


@app.command("import", epilog="Example: tog vlm import answers.jsonl --cassette mugs.jsonl")
def import_(
    answers: Annotated[
        Path, typer.Argument(help="Results of a batch, or answers.jsonl filled in by hand.")
    ],
    cassette: Annotated[Path, typer.Option(help="File with the questions, from tog vlm export.")],
    replace: Annotated[
        bool, typer.Option("--replace", help="Correct answers that were given by hand before.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Enter answers from elsewhere, as many as there are. Exit 1: some were of no use."""
    from tog_drake.selectors.vlm.batch_answers import import_answers, read_answers
    from tog_drake.selectors.vlm.cassette import Cassette

    console = console_for(as_json)
    if not cassette.is_file():
        raise InputError(f"there is no cassette {cassette}; tog vlm export writes one")
    imported = import_answers(
        Cassette(cassette, "export"), read_answers(answers), replace_by_hand=replace
    )
    for problem in imported.problems:
        say(console, f"not used: {problem}")
    say(
        console,
        f"answers: {imported.added} added, {imported.replaced} replaced, {imported.known} known "
        f"already, {imported.empty} left empty, {len(imported.problems)} not used",
    )
    say(
        console,
        f"questions in {cassette}: {imported.answered} answered, {imported.pending} pending",
    )
    if imported.added:
        say(console, "then: the same tog vlm export again, for what is pending and more questions")
    print_json(as_json, vars(imported))
    raise typer.Exit(1 if imported.problems else 0)
