"""The pages that the program writes: how their templates are filled in."""

from pathlib import Path

import jinja2

_TEMPLATES = Path(__file__).parent / "templates"


def page_environment() -> jinja2.Environment:
    """Returns what fills in the templates of pages.

    Whatever is entered is text, never markup, and what a template names but nobody gave is an
    error (``jinja2.UndefinedError``), not a gap in the page.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}  # as it was put together
    return environment
