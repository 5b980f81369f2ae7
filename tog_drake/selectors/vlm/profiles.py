"""How each family of models says where something is: ``profiles.yaml``, loaded once and checked.

A family is taught by an entry in that file, not by code. How coordinates become pixels is in
``pointing``, how an answer is read in ``answers``.
"""

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_args

from tog_drake.errors import InputError
from tog_drake.files import read_yaml

Order = Literal["xy", "yx"]
Format = Literal[
    "json",  # [{"point": [y, x], "label": "grasp"}], and what else is meant by it
    "tags",  # <point x="63.5" y="44.0" alt="grasp">grasp</point>
    "coords",  # <points coords="1 1 032 892">grasp</points>
    "boxes",  # <ref>grasp</ref><box>[[x1, y1, x2, y2]]</box>
    "tuples",  # grasp: [(0.461, 0.527)]
]
Key = Literal["point", "point_2d", "x, y"]


@dataclass(frozen=True)
class SmartResize:
    """Qwen's: both sides a multiple of ``factor``, the area between the two limits."""

    factor: int  # [pixel]
    min_pixels: int  # [pixel²]
    max_pixels: int  # [pixel²]


@dataclass(frozen=True)
class FitResize:
    """Claude's: made smaller, never larger, until sides and number of patches are within limits."""

    patch: int  # [pixel] side of a patch; one is one token
    edge: int  # [pixel] neither side, rounded up to whole patches, is longer
    tokens: int  # of an image


Resize = SmartResize | FitResize


@dataclass(frozen=True)
class Profile:
    """How one family of models points, and how it is to be asked."""

    name: str
    models: tuple[str, ...]  # patterns of model names, regular expressions in lower case
    order: Order  # of a pair of coordinates
    scale: float | None
    """What stands for the full width and height; None where pixels are told."""
    formats: tuple[Format, ...]  # how points are written, the native one first
    structured: bool  # whether the server is given a JSON schema for the answer
    prompt: str  # the sentence about coordinates, with {width} and {height} of the image seen
    key: Key = "point"  # of a point in JSON
    resize: Resize | None = None  # of the image, before the model sees it; None: it stays
    max_side: int | None = None
    """[pixel] Longer sides are resized before the model sees the image, by no rule that is known;
    None: no such limit is known."""


def load_profiles(path: Path) -> dict[str, Profile]:
    """Reads profiles of the form of ``profiles.yaml``, by name and in the order of the file.

    Raises:
        InputError: if it cannot be read, or an entry is not of that form; the message says where.
    """
    try:
        content = read_yaml(path)
    except InputError as error:
        raise InputError(f"cannot read the profiles {path}: {error}") from error
    if not isinstance(content, dict) or not content:
        raise InputError(f"{path}: no profiles; the file maps names to profiles")
    return {str(n): _profile(str(n), entry, f"{path}: {n}") for n, entry in content.items()}


def find_profile(model: str, named: str | None = None) -> Profile:
    """Returns how ``model`` points.

    Args:
        model: its name as the server knows it, such as "qwen/Qwen3-VL-8B-Instruct-AWQ".
        named: the name of a profile, which then is taken whatever the model's name.

    Raises:
        InputError: no profile has the name ``named``, or none knows the model: no convention is
            ever guessed. The message lists the names.
    """
    names = ", ".join(PROFILES)
    if named is not None:
        profile = PROFILES.get(named.strip().lower())
        if profile is None:
            raise InputError(f"there is no profile {named!r}; use one of {names}")
        return profile
    for profile in PROFILES.values():
        if any(_matches(pattern, model) for pattern in profile.models):
            return profile
    raise InputError(
        f"how the model {model!r} tells coordinates is not known, and it is not guessed: name its "
        f"profile (--profile, or `profile:` in the scenario), one of {names}. `tog vlm check "
        "--vlm ... --profile NAME` finds out which"
    )


def _matches(pattern: str, model: str) -> bool:
    """Whether ``pattern`` is found in a model's name at the start of a word."""
    return re.search(f"(?<![a-z0-9])(?:{pattern})", model.strip().lower()) is not None


def _profile(name: str, entry: Any, where: str) -> Profile:
    """Checks one entry of the file."""
    known = {f.name for f in fields(Profile)} - {"name"}
    if not isinstance(entry, dict) or not set(entry) <= known:
        wrong = sorted(map(str, set(entry) - known)) if isinstance(entry, dict) else [str(entry)]
        raise InputError(f"{where}: unknown {', '.join(wrong)}; use {', '.join(sorted(known))}")
    missing = {"models", "order", "scale", "formats", "structured", "prompt"} - set(entry)
    if missing:
        raise InputError(f"{where}: {', '.join(sorted(missing))} missing")
    scale = entry["scale"]
    if scale != "pixel" and (type(scale) not in (int, float) or not 0 < scale < 1e6):
        raise InputError(f"{where}: scale: {scale!r}; use pixel, or the number for the full width")
    resize = _resize(entry["resize"], f"{where}: resize") if "resize" in entry else None
    if resize is not None and scale != "pixel":
        raise InputError(f"{where}: resize: it matters only where pixels are told")
    max_side = entry.get("max_side")
    if max_side is not None and (type(max_side) is not int or max_side < 1 or scale != "pixel"):
        raise InputError(f"{where}: max_side: {max_side!r}; a whole number, where pixels are told")
    if type(entry["structured"]) is not bool:
        raise InputError(f"{where}: structured: {entry['structured']!r}; use true or false")
    formats = _texts(entry["formats"], f"{where}: formats")
    for used in formats:
        _one_of(used, get_args(Format), f"{where}: formats")
    if "json" in formats and "key" not in entry:
        raise InputError(f"{where}: key missing; json needs one of {', '.join(get_args(Key))}")
    return Profile(
        name=name,
        models=_patterns(entry["models"], f"{where}: models"),
        order=_one_of(entry["order"], get_args(Order), f"{where}: order"),
        scale=None if scale == "pixel" else float(scale),
        formats=formats,  # type: ignore[arg-type]  # checked above
        structured=entry["structured"],
        prompt=_texts([entry["prompt"]], f"{where}: prompt")[0],
        key=_one_of(entry.get("key", "point"), get_args(Key), f"{where}: key"),
        resize=resize,
        max_side=max_side,
    )


def _resize(entry: Any, where: str) -> Resize:
    rules: dict[str, type[SmartResize] | type[FitResize]] = {"smart": SmartResize, "fit": FitResize}
    values = dict(entry) if isinstance(entry, dict) else {}
    rule = rules[_one_of(values.pop("rule", None), tuple(rules), f"{where}: rule")]
    needed = [f.name for f in fields(rule)]
    whole = all(type(value) is int and value > 0 for value in values.values())
    if sorted(values) != sorted(needed) or not whole:
        raise InputError(f"{where}: {entry}; give {', '.join(needed)}, whole numbers above 0")
    return rule(**values)


def _patterns(entry: Any, where: str) -> tuple[str, ...]:
    patterns = _texts(entry, where)
    for pattern in patterns:
        try:
            re.compile(pattern)
        except re.error as error:
            raise InputError(f"{where}: {pattern!r} is no regular expression: {error}") from error
    return patterns


def _texts(entry: Any, where: str) -> tuple[str, ...]:
    if not isinstance(entry, list) or not entry or not all(isinstance(e, str) for e in entry):
        raise InputError(f"{where}: {entry!r}; give text")
    return tuple(entry)


def _one_of(value: Any, valid: tuple[Any, ...], where: str) -> Any:
    if value not in valid:
        raise InputError(f"{where}: {value!r}; use {' or '.join(map(str, valid))}")
    return value


PROFILES: dict[str, Profile] = load_profiles(Path(__file__).with_name("profiles.yaml"))
