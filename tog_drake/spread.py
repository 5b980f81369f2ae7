"""Lets commands share options: a dataclass of them is one parameter of a command."""

from collections.abc import Callable, Collection
from dataclasses import fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from typing import Any


def spread(
    *, without: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Lets a command take a dataclass of options; Typer and the help see one for each field.

    Args:
        without: fields that are no options of this command and keep their defaults; the command
            may have other options of these names.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        given = signature(command).parameters.values()
        kinds = {
            p.name: p.annotation
            for p in given
            if isinstance(p.annotation, type) and is_dataclass(p.annotation)
        }

        def fields_of(p: Parameter) -> list[Parameter]:
            options = signature(kinds[p.name]).parameters.values()
            return [option for option in options if option.name not in without]

        spread_out = [
            option.replace(kind=Parameter.KEYWORD_ONLY)
            for p in given
            for option in (fields_of(p) if p.name in kinds else [p])
        ]

        @wraps(command)
        def called(**values: Any) -> None:
            for name, kind in kinds.items():
                known = [field.name for field in fields(kind) if field.name not in without]
                values[name] = kind(**{field: values.pop(field) for field in known})
            command(**values)

        called.__signature__ = Signature(spread_out)  # type: ignore[attr-defined]
        return called

    return decorate
