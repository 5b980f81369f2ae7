"""Regions of space that name the parts of a scanned object: the first that holds a point wins.

They are given in the object's frame in metres, in the ``regions`` of a ``parts.yaml``:

    - {part: head, half_space: {normal: [0, 1, 0], offset: 0.1}}   # where normal · p >= offset
    - {part: head, box: {min: [-0.1, -0.1, 0], max: [0.1, 0.1, 0.2]}}
    - {part: shaft, cylinder: {from: [0, 0, 0], to: [0, 0, 0.1], radius: 0.02}}
    - {part: tip, sphere: {center: [0, 0, 0.1], radius: 0.01}}
    - {part: handle}                                               # the rest; only the last
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tog_drake.errors import InputError
from tog_drake.values import Array

MAX_REGIONS = 100
_FAR = 10.0  # [m] no number of a region is larger

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class HalfSpace:
    """Where ``normal`` · p is at least ``offset``."""

    normal: Vector
    offset: float  # [m] for a normal of length 1

    def contains(self, p_O: Array) -> NDArray[np.bool_]:
        """Returns which of the points (N, 3) [m] lie in it, (N,)."""
        return np.asarray(p_O @ np.array(self.normal) >= self.offset)


@dataclass(frozen=True)
class Box:
    """Between two corners, along the axes of the object."""

    lower: Vector  # [m]
    upper: Vector  # [m]

    def contains(self, p_O: Array) -> NDArray[np.bool_]:
        """Returns which of the points (N, 3) [m] lie in it, (N,)."""
        return np.asarray(((p_O >= self.lower) & (p_O <= self.upper)).all(axis=1))


@dataclass(frozen=True)
class Cylinder:
    """Around the line from one point to another, with flat ends."""

    begin: Vector  # [m]
    end: Vector  # [m]
    radius: float  # [m]

    def contains(self, p_O: Array) -> NDArray[np.bool_]:
        """Returns which of the points (N, 3) [m] lie in it, (N,)."""
        axis = np.subtract(self.end, self.begin)
        length = np.linalg.norm(axis)
        from_begin = p_O - self.begin
        along = from_begin @ axis / length
        across = np.linalg.norm(from_begin - np.outer(along, axis / length), axis=1)
        return np.asarray((along >= 0) & (along <= length) & (across <= self.radius))


@dataclass(frozen=True)
class Sphere:
    """Around a point."""

    center: Vector  # [m]
    radius: float  # [m]

    def contains(self, p_O: Array) -> NDArray[np.bool_]:
        """Returns which of the points (N, 3) [m] lie in it, (N,)."""
        return np.asarray(np.linalg.norm(p_O - self.center, axis=1) <= self.radius)


@dataclass(frozen=True)
class Rest:
    """All space: what no region before it holds."""

    def contains(self, p_O: Array) -> NDArray[np.bool_]:
        """Returns True for each of the points (N, 3), (N,)."""
        return np.ones(len(p_O), bool)


@dataclass(frozen=True)
class Region:
    """A shape, and the part that it belongs to."""

    part: str
    shape: HalfSpace | Box | Cylinder | Sphere | Rest


def region_of(regions: tuple[Region, ...], p_O: Array) -> NDArray[np.int64]:
    """Returns the first region that holds each of the points (N, 3) [m]: its row, -1 for none."""
    found = np.full(len(p_O), -1)
    for i in reversed(range(len(regions))):
        found[regions[i].shape.contains(p_O)] = i
    return found


def read_regions(content: Any, parts: Collection[str]) -> tuple[Region, ...]:
    """Reads the ``regions`` of a ``parts.yaml``.

    Args:
        content: what stands there.
        parts: that a region may belong to; each must have one.

    Raises:
        InputError: saying which region is wrong, and what would be right.
    """
    if not isinstance(content, list) or not 0 < len(content) <= MAX_REGIONS:
        raise InputError(f"regions must be a list of 1 to {MAX_REGIONS} regions, not {content!r}")
    regions = tuple(_region(entry, f"regions[{i}]", parts) for i, entry in enumerate(content))
    for i, region in enumerate(regions[:-1]):
        if isinstance(region.shape, Rest):
            raise InputError(
                f"regions[{i}] has no shape, so it is all the rest and nothing is left for those "
                "after it; give it a shape, or put it last"
            )
    without = set(parts) - {region.part for region in regions}
    if without:
        raise InputError(f"no region belongs to the part {' or '.join(sorted(without))}")
    return regions


_FIELDS = {
    "half_space": ("normal", "offset"),
    "box": ("min", "max"),
    "cylinder": ("from", "to", "radius"),
    "sphere": ("center", "radius"),
}


def _region(entry: Any, where: str, parts: Collection[str]) -> Region:
    if not isinstance(entry, dict) or not {*entry} <= {"part", *_FIELDS} or len(entry) > 2:
        raise InputError(
            f"{where} must have a part and at most one of {', '.join(_FIELDS)}, not {entry!r}"
        )
    part = entry.get("part")
    if not isinstance(part, str) or part not in parts:
        raise InputError(f"{where}: part {part!r} is none of {', '.join(parts)}")
    kind = next((key for key in entry if key != "part"), None)
    if kind is None:
        return Region(part, Rest())
    given = entry[kind]
    if not isinstance(given, dict) or set(given) != set(_FIELDS[kind]):
        raise InputError(f"{where}: {kind} must have {' and '.join(_FIELDS[kind])}, not {given!r}")
    values = {key: _value(key, value, f"{where}: {kind}") for key, value in given.items()}
    return Region(part, _shape(kind, values, f"{where}: {kind}"))


def _value(key: str, value: Any, where: str) -> Any:
    """A number, or three of them."""
    several = key not in ("offset", "radius")
    numbers = value if several else [value]
    if (
        not isinstance(numbers, list)
        or len(numbers) != (3 if several else 1)
        or not all(type(x) in (int, float) and abs(x) <= _FAR for x in numbers)
    ):
        wanted = "three numbers" if several else "a number"
        raise InputError(
            f"{where}: {key} must be {wanted} from {-_FAR:g} to {_FAR:g}, not {value!r}"
        )
    return tuple(map(float, numbers)) if several else float(value)


def _shape(kind: str, v: dict[str, Any], where: str) -> HalfSpace | Box | Cylinder | Sphere:
    if v.get("radius", 1.0) <= 0:
        raise InputError(f"{where}: radius must be above 0, not {v['radius']:g}")
    if kind == "sphere":
        return Sphere(v["center"], v["radius"])
    if kind == "cylinder":
        if v["from"] == v["to"]:
            raise InputError(f"{where}: from and to must be two points, not {v['from']} twice")
        return Cylinder(v["from"], v["to"], v["radius"])
    if kind == "box":
        if not all(low < high for low, high in zip(v["min"], v["max"], strict=True)):
            raise InputError(
                f"{where}: every number of min {v['min']} must be below that of max {v['max']}"
            )
        return Box(v["min"], v["max"])
    length = float(np.linalg.norm(v["normal"]))
    if length == 0:
        raise InputError(f"{where}: normal must not be zero")
    x, y, z = (c / length for c in v["normal"])
    return HalfSpace((x, y, z), v["offset"])
