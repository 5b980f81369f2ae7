"""A flat-blade screwdriver."""

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft
from pydrake.geometry import Box

from tog_drake.values import Array

ACETATE = Material((0.05, 0.27, 0.80), 1190)
DARK_ACETATE = Material((0.06, 0.07, 0.10), 1190)
STEEL = Material((0.68, 0.70, 0.72), 7850)
DARK_PAINT = Material(DARK_ACETATE.colour)

WIDTH = 0.034  # of the handle between two flats
Z = WIDTH / 2  # height of the axis
CHAMFER = 0.22  # of the width; 0.29 would be a regular octagon


def eight_sided(x: float, width: float) -> Array:
    """A ring across the axis."""
    return bar(x, Z, width, width, width * CHAMFER)


def groove(i: int) -> Piece:
    """A dark strip on flat ``i`` of the handle, counted from the top."""
    angle = i * np.pi / 4
    flat = WIDTH / 2 if i % 2 == 0 else WIDTH * (1 - CHAMFER) / np.sqrt(2)  # from the axis
    r = flat - 0.00015
    xyz = (-0.055, -np.sin(angle) * r, Z + np.cos(angle) * r)
    strip = Box(0.066, 0.0048, 0.0006)
    return Piece(f"groove_{i}", strip, DARK_PAINT, xyz, (angle, 0, 0), solid=False)


HANDLE = loft(
    [
        eight_sided(-0.105, 0.026),
        eight_sided(-0.100, WIDTH),
        eight_sided(-0.008, WIDTH),
        eight_sided(-0.002, 0.030),
    ]
)
COLLAR = loft([eight_sided(-0.002, 0.025), eight_sided(0.010, 0.015)])
SHAFT = loft([eight_sided(0.010, 0.008), eight_sided(0.100, 0.008)])
TIP = hull(
    bar(0.100, Z, 0.008, 0.008, 0.00234),
    bar(0.107, Z, 0.010, 0.004, 0.0005),
    bar(0.115, Z, 0.0095, 0.0014, 0.0003),
)

SCREWDRIVER = Thing(
    "screwdriver",
    """
A flat-blade screwdriver lying on a flat of its eight-sided handle, so that it does not roll.
Frame: z up, table at z = 0; x along the shaft towards the tip.
220 mm long; handle 105 x 34 x 34 mm, acetate 1190 kg/m3; shaft 8 mm, steel 7850 kg/m3, its
underside 13 mm above the table.
""",
    [
        Piece("handle", HANDLE, ACETATE),
        Piece("collar", COLLAR, DARK_ACETATE),
        Piece("shaft", SHAFT, STEEL),
        Piece("tip", TIP, STEEL),
        *(groove(i) for i in range(8) if i != 4),  # 4 lies on the table
    ],
)
