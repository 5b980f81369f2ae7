"""Checks YAML against a schema before Drake loads it, to say what would have been valid.

``yaml_load_typed`` refuses unknown fields and tags, but does not name the alternatives nor where
in the file it was. This walks the same schema (dataclasses and Drake's bound structs) and does.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from math import isfinite
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import yaml

from tog_drake.errors import InputError

_PLAIN_TAG = "tag:yaml.org,2002:map"
_NULL_TAG = "tag:yaml.org,2002:null"


def check_yaml(schema: type, content: str, source: str) -> str:
    """Returns ``content`` with redundant tags removed, ready for ``yaml_load_typed``.

    A tag where only one type is possible is redundant to Drake's loader, which would refuse it.

    Raises:
        InputError: if the YAML cannot be parsed, or has an unknown field, tag or scalar.
    """
    try:
        root = yaml.compose(content, Loader=yaml.SafeLoader)
        if root is None:
            return "{}"
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(content)):
            raise InputError(f"{source}: YAML aliases are not supported; write the value out")
        _check(schema, root, "", source)
        return str(yaml.serialize(root))
    except yaml.YAMLError as error:
        raise InputError(f"{source} is not valid YAML: {error}") from error
    except RecursionError as error:
        raise InputError(f"{source} is nested too deeply to be a scenario") from error


def _check(schema: Any, node: yaml.Node, path: str, source: str) -> None:
    where = f"{source}: {path or 'the scenario'}"
    origin = get_origin(schema)
    if origin in (Union, UnionType):
        _check_union(schema, node, path, source)
    elif origin is list:
        if not isinstance(node, yaml.SequenceNode):
            raise InputError(f"{where} must be a list, not {_shown(node)}")
        for i, item in enumerate(node.value):
            _check(get_args(schema)[0], item, f"{path}[{i}]", source)
    elif origin in (dict, Mapping):
        for key, value in _items(node, where):
            _check(get_args(schema)[1], value, f"{path}.{key}", source)
    elif _fields(schema) is not None:
        if node.tag == f"!{schema.__name__}":
            node.tag = _PLAIN_TAG
        elif node.tag.startswith("!"):
            raise InputError(f"{source}: {path}: unknown tag {node.tag}; valid: !{schema.__name__}")
        _check_fields(schema, node, path, source)
    elif schema in (int, float, bool) and isinstance(node, yaml.ScalarNode):
        _check_scalar(schema, node, where)


def _check_union(schema: Any, node: yaml.Node, path: str, source: str) -> None:
    options = [option for option in get_args(schema) if option is not NoneType]
    names = {getattr(option, "__name__", str(option)): option for option in options}
    structs = {name: option for name, option in names.items() if _fields(option) is not None}
    only_structs = len(structs) == len(options)
    valid = ", ".join(f"!{n}" for n in structs)
    if node.tag.startswith("!"):
        name = node.tag[1:]
        if name in structs:
            _check_fields(structs[name], node, path, source)
        elif only_structs:
            raise InputError(f"{source}: {path}: unknown tag !{name}; valid: {valid}")
    elif isinstance(node, yaml.MappingNode) and structs:
        _check_fields(next(iter(structs.values())), node, path, source)
    elif only_structs and not (node.tag == _NULL_TAG and NoneType in get_args(schema)):
        # Drake would take it for the first field of the first of them.
        raise InputError(f"{source}: {path} must be one of {valid}, not {_shown(node)}")


def _check_fields(schema: Any, node: yaml.Node, path: str, source: str) -> None:
    known = _fields(schema)
    assert known is not None
    where = f"{source}: {path or 'the scenario'}"
    for key, value in _items(node, where):
        if key not in known:
            close = get_close_matches(key, known, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise InputError(f"{where} has no field {key!r}{hint}; valid: {', '.join(known)}")
        _check(known[key], value, f"{path}.{key}" if path else key, source)


def _check_scalar(schema: type, node: yaml.ScalarNode, where: str) -> None:
    try:
        value = yaml.safe_load(node.value)
        if schema is bool and isinstance(value, bool):
            return
        if schema is not bool and not isinstance(value, bool) and isfinite(schema(value)):
            return
    except (ValueError, TypeError, OverflowError, yaml.YAMLError):
        pass
    kind = {int: "a whole number", float: "a number", bool: "true or false"}[schema]
    raise InputError(f"{where} must be {kind}, not {_shown(node)}")


def _items(node: yaml.Node, where: str) -> list[tuple[str, yaml.Node]]:
    if not isinstance(node, yaml.MappingNode):
        raise InputError(f"{where} must be a mapping of fields, not {_shown(node)}")
    return [(str(key.value), value) for key, value in node.value]


def _shown(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        return repr(node.value[:60])
    return "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"


def _fields(schema: Any) -> dict[str, Any] | None:
    """The fields of a dataclass or of a bound Drake struct, with their types."""
    if is_dataclass(schema) and isinstance(schema, type):
        hints = get_type_hints(schema)
        return {f.name: hints[f.name] for f in fields(schema)}
    if hasattr(schema, "__fields__"):
        return {f.name: f.type for f in schema.__fields__}
    return None
