"""A small frying pan."""

import numpy as np
from kit import Material, Piece, Thing, bar, hoop, hull, loft
from pydrake.geometry import Cylinder
from vessel import circle, corners, wall

from tog_drake.values import Array

ALUMINIUM = Material((0.30, 0.31, 0.33), 2700)  # enamelled dark outside
COATING = Material((0.12, 0.12, 0.13))
RIM_METAL = Material((0.72, 0.73, 0.75))
BAKELITE = Material((0.06, 0.06, 0.07), 1000)  # with a hole for the tang
STEEL = Material((0.66, 0.67, 0.69), 7850)

AXIS = -0.075  # x of the pan's axis: the origin lies below the middle of pan and handle
HEIGHT, RIM, FOOT = 0.033, 0.0740, 0.0570
WALL, FLOOR = 0.0028, 0.0030


def level(radius: float, z: float) -> Array:
    """A ring about the pan's axis."""
    return circle(radius, z) + np.array([AXIS, 0.0, 0.0])


# The outline from the foot up the flared outside to the rim, and down to the floor inside.
SHELL = loft(
    [
        level(FOOT, 0.0),
        level(FOOT + 0.0020, 0.0012),
        level(FOOT + 0.0045, 0.0060),
        level(RIM - 0.0010, HEIGHT - 0.0020),
        level(RIM, HEIGHT),
        level(RIM - WALL, HEIGHT),
        level(RIM - WALL - 0.0012, HEIGHT - 0.0020),
        level(FOOT + 0.0018, 0.0070),
        level(FOOT - 0.0020, FLOOR + 0.0006),
        level(FOOT - 0.0080, FLOOR),
    ]
)
RIM_RING = [
    level(radius, z)
    for radius, z in (
        (RIM - WALL, HEIGHT - 0.0012),
        (RIM + 0.0002, HEIGHT - 0.0012),
        (RIM + 0.0002, HEIGHT + 0.0002),
        (RIM - WALL, HEIGHT + 0.0002),
    )
]
LINING = [
    level(radius, z)
    for radius, z in (
        (FOOT - 0.0020, FLOOR + 0.0009),
        (FOOT + 0.0014, 0.0073),
        (RIM - WALL - 0.0016, HEIGHT - 0.0020),
        (RIM - WALL - 0.0010, HEIGHT - 0.0020),
        (FOOT + 0.0022, 0.0068),
        (FOOT - 0.0020, FLOOR),
    )
]


def moved(piece: Piece) -> Piece:
    """A piece made about the origin, put about the pan's axis."""
    return Piece(piece.name, piece.shape, piece.material, (AXIS, 0.0, 0.0), drawn=False)


TANG = (
    bar(AXIS + 0.0660, 0.0215, 0.030, 0.008, 0.002),
    bar(AXIS + 0.0800, 0.0250, 0.016, 0.008, 0.002),
    bar(AXIS + 0.1000, 0.0300, 0.014, 0.008, 0.002),
)
HANDLE = (
    bar(AXIS + 0.0960, 0.0292, 0.0185, 0.0130, 0.004),
    bar(AXIS + 0.1250, 0.0355, 0.0195, 0.0150, 0.005),
    bar(AXIS + 0.2080, 0.0470, 0.0235, 0.0150, 0.005),
    bar(AXIS + 0.2240, 0.0480, 0.0190, 0.0110, 0.004),
)
TILT = -np.arctan2(0.0115, 0.083)  # of the handle, down about y

PAN = Thing(
    "pan",
    """
A small frying pan for eggs or blini standing on the table: dark coated aluminium, flared low rim,
long black handle; hollow: twelve wall segments and a bottom.
Frame: z up, table at z = 0, origin below the middle of pan and handle; x along the handle, away
from the pan, whose axis is at x = -75 mm.
298 mm long, 148 mm across the rim, rim 33 mm and handle 55 mm above the table.
Aluminium 2700 kg/m3 and 3 mm thick, steel tang 7850 (at half its section), handle 1000.
""",
    [
        Piece("pan", SHELL, ALUMINIUM, solid=False),
        Piece("floor", Cylinder(FOOT - 0.002, 0.0004), COATING, (AXIS, 0, 0.0037), solid=False),
        Piece("lining", hoop(LINING), COATING, solid=False),
        Piece("rim", hoop(RIM_RING), RIM_METAL, solid=False),
        moved(Piece("bottom", hull(corners(FOOT + 0.002, 0.0), corners(FOOT + 0.002, FLOOR)))),
        *map(
            moved,
            wall((FOOT + 0.0020, FOOT - 0.0015, 0.0012), (RIM, RIM - WALL - 0.0003, HEIGHT)),
        ),
        Piece("tang", hull(*TANG), STEEL, mass=0.012),
        Piece("handle", loft(HANDLE), BAKELITE, solid=False),
        Piece("handle_front", hull(*HANDLE[0:2]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[1:4]), drawn=False),
        # The ring to hang it by.
        Piece(
            "hole",
            Cylinder(0.0050, 0.0156),
            RIM_METAL,
            (AXIS + 0.207, 0, 0.0469),
            (0, TILT, 0),
            0.0,
            solid=False,
        ),
    ],
)
