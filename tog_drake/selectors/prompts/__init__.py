"""The texts that a vision-language model is sent: Jinja templates, one file each, with a version.

The first line of ``gsi.j2`` is ``{# gsi/1 #}``, its name and version; the version goes up whenever
the text changes, since answers to another text are other answers. The second says in a comment,
for people, what a model is shown and asked. The task enters as data: a JSON
string, in quotes, whatever it contains.
"""

import json
import re
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import jinja2

from tog_drake.errors import InputError

_FOLDER = Path(__file__).parent
_HEAD = re.compile(r"\{# ([a-z]+/[1-9][0-9]*) #\}\n(?:\{# (.+) #\}\n)?")


@dataclass(frozen=True)
class Prompt:
    """One text with its places for what changes."""

    version: str  # name and version, such as "gsi/1"
    about: str  # what a model is shown, and how many questions it is asked
    source: str  # the file as it is
    template: jinja2.Template = field(repr=False)

    def render(self, **values: Any) -> str:
        """Returns the text with ``values`` in place; one that is missing is an error."""
        return self.template.render(values).strip()


def names() -> tuple[str, ...]:
    """Returns the names of all prompts, sorted."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.j2")))


@cache
def load(name: str) -> Prompt:
    """Returns the prompt of that name.

    Raises:
        InputError: there is none, naming those that there are.
    """
    if name not in names():
        raise InputError(f"unknown prompt {name!r}; valid: {', '.join(names())}")
    source = (_FOLDER / f"{name}.j2").read_text(encoding="utf-8")
    head = _HEAD.match(source)
    if head is None or head[1].split("/")[0] != name:
        raise InputError(f"prompt {name}: its first line must be {{# {name}/VERSION #}}")
    return Prompt(head[1], head[2] or "", source, _environment().from_string(source))


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined,
        autoescape=False,  # the text is read by a model, not by a browser
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["quoted"] = lambda text: json.dumps(text, ensure_ascii=False)
    return environment
