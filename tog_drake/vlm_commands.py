"""The commands about vision-language models: ``tog prompts`` and ``tog vlm ...``."""

from typing import Annotated

import typer

from tog_drake.options import (
    JsonOption,
    RenderingOption,
    valid,
)
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
