"""How points are written: each family's own format, and where its numbers are in it.

The text is anybody's: every pattern here is bounded, so that none takes longer than in proportion
to the text. What the numbers mean is in ``pointing``.
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.json_in_text import find_values
from tog_drake.selectors.vlm.profiles import Format, Profile


@dataclass(frozen=True)
class Told:
    """A point as a model told it."""

    label: str
    x: float  # in the family's scale
    y: float


def find_points(text: str, profile: Profile) -> list[Told]:
    """Returns all points that ``text`` tells in the first of the profile's formats that it has.

    Raises:
        Unanswered: unreadable where there are none, or what is there is not of the format; empty
            where the model says that there are none.
    """
    for written in profile.formats:
        told = list(_FINDERS[written](text, profile))
        if told:
            return told
    raise Unanswered("unreadable", f"no point is found in the format of {profile.name!r}")


_NUMBER = r"[-+]?(?:\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})(?![\d.])"
_TAG = re.compile(r"<points?\s([^<>]*)>([^<>]{0,200})")
_ATTRIBUTE = re.compile(rf"""\b([xy])(\d{{0,4}})\s?=\s?["']?\s?({_NUMBER})(?=["'\s/]|$)""")
_LABEL = re.compile(r"""\b(?:alt|label)\s?=\s?["']([^"']{0,200})["']""")
_COORDS = re.compile(r"""\bcoords\s?=\s?["']([^"']*)["']""")
_BOX = re.compile(
    r"(?:<(?:ref|\|object_ref_start\|)>([^<>]{0,200})<(?:/ref|\|object_ref_end\|)>\s?)?"
    r"<(?:box|\|box_start\|)>([^<>]{0,200})<(?:/box|\|box_end\|)>"
)
_PAIR = rf"\(\s?({_NUMBER})\s?,\s?({_NUMBER})\s?\)"
_BARE_BOX = re.compile(rf"(?:\b([A-Za-z]{{1,30}}):?\s?)?{_PAIR}\s?,\s?{_PAIR}")
_TUPLE = re.compile(rf"""(?:\b([A-Za-z]{{1,30}})["']?\s?:\s?\[?\s?)?{_PAIR}""")
_AROUND = re.compile(r"```[a-z]{0,10}|<\|(?:begin|end)_of_box\|>")


def _find_tags(text: str, profile: Profile) -> Iterator[Told]:
    """Molmo's <point x="63.5" y="44.0" alt="grasp"> and <points x1=".." y1=".." x2=..>."""
    for attributes, content in _TAG.findall(text):
        label = _LABEL.search(attributes)
        values = {(axis, n): float(value) for axis, n, value in _ATTRIBUTE.findall(attributes)}
        for axis, n in values:
            if axis == "x" and ("y", n) in values:
                said = label.group(1) if label else content
                yield Told(said, values["x", n], values["y", n])


def _find_coords(text: str, profile: Profile) -> Iterator[Told]:
    """Molmo2's <points coords="1 1 032 892 2 070 619">: image, then number, x and y of each."""
    for attributes, content in _TAG.findall(text):
        coords, label = _COORDS.search(attributes), _LABEL.search(attributes)
        for group in re.split(r"[;\t]", coords.group(1)) if coords else ():
            numbers = group.split()
            if not all(re.fullmatch(_NUMBER, n) for n in numbers) or len(numbers) % 3 != 1:
                raise Unanswered("unreadable", "coords are not an image and triples of numbers")
            for x, y in zip(numbers[2::3], numbers[3::3], strict=True):
                yield Told(label.group(1) if label else content, float(x), float(y))


def _find_boxes(text: str, profile: Profile) -> Iterator[Told]:
    """InternVL's <ref>grasp</ref><box>[[x1, y1, x2, y2]]</box>, and Qwen2-VL's."""
    tagged = _BOX.findall(text)
    for label, content in tagged:
        numbers = [float(n) for n in re.findall(_NUMBER, content)]
        if len(numbers) not in (2, 4):
            raise Unanswered("unreadable", f"a box of {len(numbers)} numbers")
        yield _told(label, numbers, profile)
    for label, *corners in () if tagged else _BARE_BOX.findall(text):
        yield _told(label, [float(n) for n in corners], profile)


def _find_tuples(text: str, profile: Profile) -> Iterator[Told]:
    """RoboPoint's [(0.461, 0.527)], or "grasp: [(0.461, 0.527)]"."""
    for label, first, second in _TUPLE.findall(text):
        yield _told(label, [float(first), float(second)], profile)


def _find_json(text: str, profile: Profile) -> Iterator[Told]:
    """Points in the last JSON that has any.

    Bare numbers, [[320, 240]], count only where there is nothing else: in prose they may be told in
    another convention.
    """
    values = find_values(text)
    alone = _AROUND.sub("", text).strip()
    for value in values:
        is_bare = not isinstance(value, dict) and not any(isinstance(v, dict) for v in value)
        if not is_bare or (alone.startswith("[") and alone.endswith("]")):
            told = list(_collect(value, "", profile))
            if told:
                return iter(told)
    if values and values[0] in ([], {}):
        raise Unanswered("empty", "the model gives an empty list of points")
    return iter(())


_POINTS = ("point", "point_2d", "points", "coordinates", "coordinate")
_BOXES = ("box_2d", "bbox_2d", "bbox", "box")
_SAID = ("label", "role", "name")
_NAMED = (("x", "y"), ("x_min", "y_min", "x_max", "y_max"), ("x1", "y1", "x2", "y2"))


def _collect(value: Any, label: str, profile: Profile, *, box: bool = False) -> Iterator[Told]:
    """Finds the points in a JSON value; what is around it gives the label unless it has its own."""
    if isinstance(value, dict):
        yield from _collect_from_object(value, label, profile)
    elif isinstance(value, (list, tuple)):
        if value and not any(isinstance(item, (dict, list, tuple)) for item in value):
            sizes = (4,) if box else (2, 4) if "boxes" in profile.formats else (2,)
            if len(value) in sizes and all(_is_number(item) for item in value):
                yield _told(label, [float(item) for item in value], profile)
            return
        for item in value:
            yield from _collect(item, label, profile, box=box)


def _collect_from_object(value: dict[Any, Any], label: str, profile: Profile) -> Iterator[Told]:
    keys = {key.lower(): key for key in value if isinstance(key, str)}
    label = next((str(value[keys[k]]) for k in _SAID if k in keys), label)[:200]
    for names in _NAMED:
        if set(names) <= set(keys):
            numbers = [value[keys[name]] for name in names]
            if not all(_is_number(n) for n in numbers):
                raise Unanswered("unreadable", f"{', '.join(names)} are not numbers")
            yield _told(label, [float(n) for n in numbers], profile, order="xy")
            return
    for key in (k for k in (*_POINTS, *_BOXES) if k in keys):
        inner = value[keys[key]]
        if inner is None or inner == []:
            raise Unanswered("empty", f"the model gives no {key}")
        told = list(_collect(inner, label, profile, box=key in _BOXES))
        if not told:
            raise Unanswered("unreadable", f"{key} is not a pair of numbers")
        yield from told
        return
    for key, inner in value.items():
        if key != "reasoning":
            yield from _collect(inner, str(key), profile)


def _is_number(value: Any) -> bool:
    """Whether ``value`` is a finite number: neither true or false, nor text, nor too long."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) < 10**9
    return isinstance(value, float) and math.isfinite(value)


def _told(label: str, numbers: list[float], profile: Profile, order: str | None = None) -> Told:
    """Returns a pair of coordinates, or the centre of a box of four, in the family's order."""
    first, second = numbers[0], numbers[1]
    if len(numbers) == 4:
        first, second = (numbers[0] + numbers[2]) / 2, (numbers[1] + numbers[3]) / 2
    x, y = (second, first) if (order or profile.order) == "yx" else (first, second)
    return Told(label, x, y)


_FINDERS: dict[Format, Callable[[str, Profile], Iterator[Told]]] = {
    "json": _find_json,
    "tags": _find_tags,
    "coords": _find_coords,
    "boxes": _find_boxes,
    "tuples": _find_tuples,
}
