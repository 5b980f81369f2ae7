"""The commands about vision-language models: ``tog prompts`` and ``tog vlm ...``."""

from typing import Annotated

import typer

from tog_drake.options import MODEL_HELP, JsonOption, ProfileOption, RenderingOption, valid
from tog_drake.terminal import console_for, print_json, say

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Try out a vision-language model, or have its questions answered elsewhere.",
)

_EXAMPLE = {  # what fills the places of a prompt when it is shown
    "task": "hand me the hammer",
    "count": 3,
    "round": 1,
    "rounds": 3,
    "problem": "the answer names none of the labels",
    "answer": "I would take the head.",
}
_LABELS = {"marked": ("1", "2", "3"), "paper": ("red", "green", "blue")}
_SEPARATE = ("gmi", "cpmi")  # an image each: there the labels are numbers in every rendering


def prompts(
    name: Annotated[
        str | None, typer.Argument(help="Of the prompt; without it all are listed.")
    ] = None,
    rendering: RenderingOption = "marked",
    as_json: JsonOption = False,
) -> None:
    """List what models are asked, or show one text with example values as it is sent."""
    from tog_drake.selectors import prompts as texts

    console = console_for(as_json)
    if name is None:
        versions = {known: texts.load(known).version for known in texts.names()}
        for version in versions.values():
            say(console, version)
        print_json(as_json, versions)
        return
    prompt = texts.load(name)
    labels = valid(rendering or "marked", _LABELS, "rendering")
    if name in _SEPARATE:
        labels = _LABELS["marked"]
    text = prompt.render(**_EXAMPLE, rendering=rendering, labels=labels)
    for line in text.splitlines():
        say(console, line)
    print_json(as_json, {"version": prompt.version, "text": text})


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
    model = read_specification(vlm, profile)
    found = find_profile(model.model, model.profile)
    client = Client(model, profile=found.name)
    with console.status("asking ..."):
        report = check_model(
            client, found, max_tokens=model.max_tokens, seconds=deadline, seed=seed
        )
    say(console, f"{specification(model)}, profile {found.name}")
    for finding in report.findings:
        mark = "ok     " if finding.ok else ("PROBLEM" if finding.required else "missing")
        say(console, f"{mark}  {finding.name}: {finding.found}")
    asked = report.exchanges
    took = usage(sum(e.seconds for e in asked), [e.tokens for e in asked], [e.cost for e in asked])
    say(console, f"{len(asked)} questions: {took}")
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
