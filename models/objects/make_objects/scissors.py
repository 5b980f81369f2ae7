"""A pair of kitchen scissors."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from kit import Material, Piece, Thing, hoop, hull, join, loft, octagon, ring
from pydrake.geometry import Box, Cylinder

from tog_drake.values import Array

STEEL = Material((0.80, 0.81, 0.83), 7850)
SHADOW = Material((0.45, 0.46, 0.48), 7850)
SCREW = Material((0.35, 0.36, 0.38), 7850)
SLOT = Material((0.10, 0.10, 0.10))
PLASTIC = Material((0.95, 0.33, 0.04), 1250)  # ABS of 1050 and the tang within

Z = 0.0090  # height of the middle plane, half the handles' thickness
WIDTH, THICKNESS = 0.0100, 0.0180  # of a bow's bar, in and across that plane
BLADE = 0.0028  # thickness of one blade

# The corners of a bow's middle line at y > 0. Its inner side goes on to the pivot.
PIVOT_END = (-0.012, 0.0068)
CORNERS = [
    (-0.050, 0.0068),
    (-0.100, 0.0090),
    (-0.114, 0.0235),
    (-0.105, 0.0430),
    (-0.068, 0.0415),
]


def rounded(corners: Sequence[tuple[float, float]], cut: float) -> Array:
    """The closed line with each corner replaced by a parabola from ``cut`` [m] before it on."""
    points = np.array(corners)
    line = []
    for before, here, after in zip(
        np.roll(points, 1, 0), points, np.roll(points, -1, 0), strict=True
    ):
        a = here + cut * (before - here) / np.linalg.norm(before - here)
        b = here + cut * (after - here) / np.linalg.norm(after - here)
        for t in np.linspace(0, 1, 7):
            line.append((1 - t) ** 2 * a + 2 * t * (1 - t) * here + t**2 * b)
    return np.array(line)


def across(p: Array, direction: Array, side: int) -> Array:
    """A ring of a bow's bar, square to ``direction``; ``side`` mirrors it in y."""
    normal = np.array([-direction[1], direction[0]]) / np.linalg.norm(direction)
    section = octagon(WIDTH, THICKNESS, 0.0035)
    xy = p + section[:, :1] * normal
    return np.column_stack([xy[:, 0], side * xy[:, 1], Z + section[:, 1]])


def bow_seen(side: int) -> Piece:
    """A bow as it is seen: a rounded loop, and the bar from it to the pivot."""
    line = rounded(CORNERS, 0.006)
    tangents = np.roll(line, -1, 0) - np.roll(line, 1, 0)
    loop = hoop([across(p, t, side) for p, t in zip(line, tangents, strict=True)])
    start, end = np.array(PIVOT_END), np.array(CORNERS[1]) * 0.4 + np.array(CORNERS[0]) * 0.6
    shank = [across(p, end - start, side) for p in (start, end)]
    name = "left" if side > 0 else "right"
    return Piece(f"bow_{name}", join([loop, loft(shank)]), PLASTIC, solid=False, mass=0.038)


def bow_touched(side: int) -> list[Piece]:
    """The same for contact: straight bars between the corners."""
    name = "left" if side > 0 else "right"
    points = np.array([*CORNERS, CORNERS[0]])
    points[0] = PIVOT_END
    bars = []
    for i, (a, b) in enumerate(pairwise(points)):
        reach = 0.0008 * (b - a) / np.linalg.norm(b - a)  # so that the corners are filled
        ends = [across(a - (i > 0) * reach, b - a, side), across(b + reach, b - a, side)]
        bars.append(Piece(f"bow_{name}_{i}", hull(*ends), drawn=False))
    return bars


def blade_outline(side: int) -> Array:
    """One blade, (N, 2): its cutting edge lies a little beyond the middle line."""
    outline = [(-0.016, -0.004), (-0.014, 0.0110), (0.006, 0.0125), (0.060, 0.0088)]
    outline += [(0.096, 0.0030), (0.0995, 0.0), (0.060, -0.0020), (0.004, -0.0030)]
    return np.array(outline) * [1, side]


def blade(name: str, side: int, low: float, material: Material) -> Piece:
    section = blade_outline(side)
    return Piece(name, hull(ring(section, "z", low), ring(section, "z", low + BLADE)), material)


SCISSORS = Thing(
    "scissors",
    """
A pair of kitchen scissors lying closed on its side: steel blades, orange handles with two bows,
open inside.
Frame: z up, table at z = 0; x from the bows to the tips.
218 x 96 x 18 mm; blades 100 mm beyond the handles, 5.6 mm thick together, 6 mm above the table.
Steel 7850 kg/m3; each handle 38 g (about 30 cm3, of ABS with the blade's tang in it).
""",
    [
        bow_seen(1),
        bow_seen(-1),
        *bow_touched(1),
        *bow_touched(-1),
        blade("blade_lower", -1, Z - BLADE, SHADOW),
        blade("blade_upper", 1, Z, STEEL),
        Piece("screw", Cylinder(0.0055, 0.0110), SCREW, (0, 0, Z)),
        Piece(
            "slot", Box(0.0090, 0.0014, 0.0004), SLOT, (0, 0, Z + 0.0056), (0, 0, 0.6), solid=False
        ),
    ],
)
