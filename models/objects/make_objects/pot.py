"""A small saucepan."""

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft
from pydrake.geometry import Cylinder
from vessel import circle, wall_and_bottom

STEEL = Material((0.74, 0.75, 0.78))  # drawn thicker than it is: the pan states its mass
SHADE = Material((0.46, 0.47, 0.50))
RIVET = Material((0.55, 0.56, 0.58), 2700)
BAKELITE = Material((0.06, 0.06, 0.07), 900)  # with a hole for the tang

RADIUS, WALL, HEIGHT = 0.0315, 0.0030, 0.052
INNER = RADIUS - WALL
FOOT = 0.0295  # radius on the table
# The outline from the foot up the outside, over the flared rim and down to the bottom inside.
PAN = loft(
    [
        circle(FOOT, 0.0),
        circle(RADIUS - 0.0003, 0.003),
        circle(RADIUS, 0.006),
        circle(RADIUS, HEIGHT - 0.004),
        circle(RADIUS + 0.0012, HEIGHT - 0.001),
        circle(RADIUS + 0.0008, HEIGHT),
        circle(INNER + 0.0008, HEIGHT),
        circle(INNER, HEIGHT - 0.003),
        circle(INNER, 0.007),
        circle(INNER - 0.002, 0.0045),
        circle(0.020, 0.004),
    ]
)


BRACKET = (bar(0.0300, 0.0390, 0.022, 0.010, 0.002), bar(0.0480, 0.0415, 0.014, 0.010, 0.002))
HANDLE = (
    bar(0.0480, 0.0415, 0.0165, 0.013, 0.004),
    bar(0.0800, 0.0465, 0.0175, 0.014, 0.004),
    bar(0.1420, 0.0560, 0.0210, 0.014, 0.004),
    bar(0.1500, 0.0570, 0.0150, 0.009, 0.003),
)
TILT = -np.arctan2(0.0095, 0.062)  # of the handle, down about y

POT = Thing(
    "pot",
    """
A small steel saucepan standing upright, with one long black handle; hollow: twelve wall segments
and a bottom.
Frame: z up along the pan's axis, table at z = 0; x towards the handle.
Outer diameter 65 mm at the rim, 52 mm high, handle to x = 150 mm and up to z = 63 mm. The steel
has the mass of 1 mm sheet, the handle 900 kg/m3.
It is of the size in which sauces are served and butter is melted: a saucepan of the usual 160 mm
could be held by its body only at the rim, this one across it, too.
""",
    [
        Piece("pan", PAN, STEEL, mass=0.112, solid=False),
        Piece("inside", Cylinder(INNER - 0.0022, 0.0006), SHADE, (0, 0, 0.0042), solid=False),
        *wall_and_bottom(RADIUS, INNER, HEIGHT, FOOT, 0.004),
        Piece("bracket", hull(*BRACKET), RIVET),
        Piece("handle", loft(HANDLE), BAKELITE, solid=False),
        Piece("handle_front", hull(*HANDLE[0:2]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[1:4]), drawn=False),
        # The ring to hang it by.
        Piece(
            "hole",
            Cylinder(0.0045, 0.0148),
            RIVET,
            (0.136, 0, 0.0551),
            (0, TILT, 0),
            0.0,
            solid=False,
        ),
    ],
)
