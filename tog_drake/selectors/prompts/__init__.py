"""The texts that a vision-language model is sent: Jinja templates, one file each, with a version.

The first line of ``gsi.j2`` is ``{# gsi/1 #}``, its name and version; the version goes up whenever
the text changes, since answers to another text are other answers. The second says in a comment,
for people, what a model is shown and asked. The task enters as data: a JSON
string, in quotes, whatever it contains.

A file of one's own may take the place of a strategy's text; its version is a digest of it. It is
rendered in Jinja's sandbox, and without the task in it, it is none.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from jinja2.sandbox import SandboxedEnvironment

from tog_drake.errors import InputError

_FOLDER = Path(__file__).parent
MAX_BYTES = 50_000  # of a file of one's own
_HEAD = re.compile(r"\{# ([a-z]+/[1-9][0-9]*) #\}\n(?:\{# (.+) #\}\n)?")


@dataclass(frozen=True)
class Prompt:
    """One text with its places for what changes."""

    version: str  # name and version, such as "gsi/1"; of a file of one's own "NAME/DIGEST"
    about: str  # what a model is shown, and how many questions it is asked
    source: str  # the file as it is
    template: jinja2.Template = field(repr=False)

    def render(self, **values: Any) -> str:
        """Returns the text with ``values`` in place.

        Raises:
            InputError: it has a place for another value, or an expression in it fails.
        """
        try:
            return self.template.render(values).strip()
        except Exception as error:  # whatever an expression comes to
            raise InputError(
                f"prompt {self.version} cannot be filled in: {error}; its places may be: "
                f"{', '.join(sorted(values))}"
            ) from error


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


def read(file: Path, example: Mapping[str, Any]) -> Prompt:
    """Returns the prompt in a file of one's own.

    Args:
        file: a Jinja template in UTF-8.
        example: values for all its places, the task among them.

    Raises:
        InputError: it cannot be read, is no template, asks for another value than those of the
            example, or leaves the task out.
    """
    valid = "valid: a text as `tog prompts STRATEGY --source` prints it, with the task in it"
    try:
        with file.open("rb") as opened:
            data = opened.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise InputError(f"prompt {file}: it has more than {MAX_BYTES} bytes; {valid}")
        source = data.decode()
        template = _environment().from_string(source)
    except OSError as error:
        raise InputError(
            f"prompt {file} cannot be read: {error.strerror or error}; name a file"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"prompt {file}: it is not text in UTF-8; {valid}") from error
    except jinja2.TemplateSyntaxError as error:
        raise InputError(f"prompt {file}, line {error.lineno}: {error.message}; {valid}") from error
    version = f"{file.stem}/{hashlib.sha256(data).hexdigest()[:12]}"
    prompt = Prompt(version, "", source, template)
    text = prompt.render(**example)
    if json.dumps(example["task"], ensure_ascii=False) not in text:
        raise InputError(
            f"prompt {file} leaves the task out, so a model would not know of it; write "
            "{{ task | quoted }} where it belongs"
        )
    return prompt


@cache
def _environment() -> jinja2.Environment:
    environment = SandboxedEnvironment(
        undefined=jinja2.StrictUndefined,
        autoescape=False,  # the text is read by a model, not by a browser
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["quoted"] = lambda text: json.dumps(text, ensure_ascii=False)
    return environment
