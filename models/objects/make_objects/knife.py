"""A kitchen knife."""

from collections.abc import Sequence

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft, ring
from pydrake.geometry import Cylinder

from tog_drake.values import Array

STEEL = Material((0.80, 0.81, 0.83), 7850)
GROUND_STEEL = Material((0.93, 0.94, 0.95))
BOLSTER = Material((0.58, 0.59, 0.61), 7850)
# Scales of laminated wood, 1300, on both sides of a tang of 3 mm, a seventh of the thickness.
SCALES = Material((0.42, 0.22, 0.10), 2150)
BRASS = Material((0.83, 0.66, 0.28))

Z = 0.0110  # height of the blade's middle: half the handle's thickness
HALF = 0.0010  # half the thickness of the blade
# The outline of the blade: y is where the edge is, so the spine is below.
SPINE = [(0.010, -0.0130), (0.085, -0.0125), (0.130, -0.0100), (0.155, -0.0055), (0.1700, 0.0030)]
EDGE = [(0.1650, 0.0070), (0.145, 0.0145), (0.115, 0.0195), (0.070, 0.0225), (0.010, 0.0230)]
BEVEL = [(x - 0.002 * (i == 0), y - 0.0042) for i, (x, y) in enumerate(EDGE)]  # where it begins


def flat(outline: Sequence[tuple[float, float]], half: float) -> Array:
    """The outline above and below the blade's middle."""
    section = np.array(outline)
    return np.vstack([ring(section, "z", Z - half), ring(section, "z", Z + half)])


HANDLE = (
    bar(-0.1280, Z, 0.0240, 0.0150, 0.005),
    bar(-0.1240, Z, 0.0300, 0.0200, 0.006),
    bar(-0.1080, Z, 0.0300, 0.0215, 0.006),
    bar(-0.0650, Z, 0.0250, 0.0220, 0.006),
    bar(-0.0060, Z, 0.0270, 0.0220, 0.006),
)
BLADE = hull(flat(SPINE, HALF), flat(BEVEL, HALF), flat(EDGE, 0.0004))
# The ground edge, a hair proud of the blade on both sides.
GROUND = hull(flat(BEVEL[1:], HALF + 0.0002), flat(EDGE[1:], 0.0006), flat([EDGE[0]], 0.0006))


def rivet(i: int, x: float) -> Piece:
    return Piece(f"rivet_{i}", Cylinder(0.0035, 0.0222), BRASS, (x, 0, Z), mass=0.0, solid=False)


KNIFE = Thing(
    "knife",
    """
A kitchen knife lying on its side: steel blade, riveted handle of dark wood, steel bolster.
Frame: z up, table at z = 0; x along the handle towards the tip, y towards the edge.
298 x 36 x 22 mm; blade 170 mm long, 36 mm wide at the heel, 2 mm thick, 10 mm above the table.
Steel 7850 kg/m3; the handle, wood and tang, 2150. It balances in the handle near the bolster, so
the blade is off the table.
""",
    [
        Piece("handle", loft(HANDLE), SCALES, solid=False),
        Piece("handle_end", hull(*HANDLE[0:4]), drawn=False),
        Piece("handle_front", hull(*HANDLE[3:5]), drawn=False),
        Piece(
            "bolster",
            loft([bar(-0.006, Z, 0.027, 0.0215, 0.006), bar(0.012, Z, 0.024, 0.005, 0.001)]),
            BOLSTER,
        ),
        Piece("blade", BLADE, STEEL),
        Piece("ground_edge", GROUND, GROUND_STEEL, solid=False),
        *(rivet(i, x) for i, x in enumerate((-0.105, -0.064, -0.024))),
    ],
)
