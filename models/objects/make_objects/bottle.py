"""A bottle of water."""

import numpy as np
from kit import Material, Piece, Thing, ellipse, hoop, loft, ring
from pydrake.geometry import Box, Cylinder

from tog_drake.values import Array

WATER = Material((0.55, 0.78, 0.90), 960)  # in a thin bottle, nearly full
PET = Material((0.62, 0.82, 0.92), 700)  # thick at the neck, but hollow
CAP = Material((0.05, 0.25, 0.75), 600)  # hollow
RIDGE = Material((0.03, 0.17, 0.55))
LABEL = Material((0.96, 0.97, 0.98))
PRINT = Material((0.05, 0.30, 0.72))
WAVE = Material((0.20, 0.62, 0.85))
GROOVE = Material((0.42, 0.66, 0.82))

RADIUS = 0.0280
TOP = 0.118  # where the shoulder begins


def level(radius: float, z: float) -> Array:
    return ring(ellipse(radius, radius, 32), "z", z)


def around(radius: float, low: float, high: float) -> list[Array]:
    """A sheet around the body."""
    return [
        level(radius - 0.001, low),
        level(radius, low),
        level(radius, high),
        level(radius - 0.001, high),
    ]


BODY = [
    level(0.0235, 0.0),
    level(0.0265, 0.0025),
    level(RADIUS, 0.0080),
    level(RADIUS, TOP),
    level(0.0270, TOP + 0.009),
    level(0.0235, TOP + 0.020),
    level(0.0180, TOP + 0.030),
    level(0.0125, TOP + 0.037),
]


CAP_RINGS = [level(0.0147, 0.1665), level(0.0147, 0.1810), level(0.0130, 0.1830)]


def ridge(i: int, count: int) -> Piece:
    angle = 2 * np.pi * i / count
    xyz = (0.0147 * np.cos(angle), 0.0147 * np.sin(angle), 0.1745)
    rib = Box(0.0008, 0.0012, 0.0120)
    return Piece(f"ridge_{i:02d}", rib, RIDGE, xyz, (0, 0, angle), solid=False)


BOTTLE = Thing(
    "bottle",
    """
A small bottle of water standing upright, nearly full: pale blue, with a label around it and a blue
screw cap.
Frame: z up along the bottle's axis, table at z = 0.
Diameter 56 mm, 183 mm high; cap 30 x 17 mm. Body (a third of a litre) 960 kg/m3, neck 700, cap 600.
""",
    [
        Piece("body", loft(BODY), WATER),
        Piece("neck", Cylinder(0.0125, 0.0150), PET, (0, 0, 0.1595)),
        Piece("collar", Cylinder(0.0160, 0.0020), PET, (0, 0, 0.1645)),
        Piece("cap", loft(CAP_RINGS), CAP),
        Piece("label", hoop(around(RADIUS + 0.0006, 0.040, 0.092)), LABEL, solid=False),
        Piece("print", hoop(around(RADIUS + 0.0012, 0.056, 0.078)), PRINT, solid=False),
        Piece("wave", hoop(around(RADIUS + 0.0012, 0.047, 0.052)), WAVE, solid=False),
        *(
            Piece(f"groove_{i}", hoop(around(RADIUS + 0.0005, z, z + 0.0015)), GROOVE, solid=False)
            for i, z in enumerate((0.014, 0.022, 0.030, 0.100, 0.108))
        ),
        *(ridge(i, 20) for i in range(20)),
    ],
)
