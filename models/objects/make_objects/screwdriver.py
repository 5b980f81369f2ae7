"""A flat-blade screwdriver."""

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft
from pydrake.geometry import Box

ACETATE = Material((0.05, 0.27, 0.80), 1190)
DARK_ACETATE = Material((0.06, 0.07, 0.10), 1190)
STEEL = Material((0.68, 0.70, 0.72), 7850)

WIDTH = 0.034  # of the handle, between flats
Z = WIDTH / 2  # height of its axis
CHAMFER = 0.22  # of a width: nearly a regular octagon


def collar(x: float, width: float) -> "Array":
    return bar(x, Z, width, width, width * CHAMFER)
