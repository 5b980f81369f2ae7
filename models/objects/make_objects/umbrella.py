"""A folded compact umbrella."""

from typing import Literal

import numpy as np
from kit import Material, Piece, Thing, TriangleMesh, bar, hull, join, loft
from pydrake.geometry import Cylinder, Sphere

from tog_drake.values import Array

CLOTH = Material((0.06, 0.11, 0.42))
LIGHT_CLOTH = Material((0.11, 0.20, 0.58))
FOLDED = Material(CLOTH.colour, 620)  # cloth, ribs and the air between
RUBBER = Material((0.07, 0.07, 0.08), 650)  # with a hole for the shaft
STEEL = Material((0.72, 0.73, 0.75), 2700)  # a tube
SNAP = Material((0.80, 0.81, 0.84))

CHAMFER = 0.29  # of the width: a regular octagon
# The canopy's width along x. Its underside lies on the table, so its axis falls to the tip.
PROFILE = ((-0.050, 0.044), (-0.035, 0.054), (0.030, 0.054), (0.110, 0.040), (0.128, 0.020))
HANDLE_Z = 0.027


def canopy_ring(x: float, width: float) -> Array:
    """A ring of the canopy; only its two ends leave the table."""
    z = {-0.050: 0.027, 0.128: 0.018}.get(x, width / 2)
    return bar(x, z, width, width, CHAMFER * width)


RINGS = [canopy_ring(x, width) for x, width in PROFILE]


def folds(which: Literal[0, 1]) -> TriangleMesh:
    """Every other panel of the canopy; between two panels the cloth stands out in a ridge."""
    wedges = []
    for i in range(which, 8, 2):
        j = (i + 1) % 8
        sections = []
        for r in RINGS:
            axis = r.mean(0)
            valley = axis + 0.93 * ((r[i] + r[j]) / 2 - axis)
            sections.append(np.array([axis, r[i], valley, r[j]]))
        wedges.append(loft(sections))
    return join(wedges)


def rib_end(i: int) -> Piece:
    """The knob at the end of rib ``i``."""
    x, y, z = RINGS[0][i] * [1, 0.93, 0.93] + [0, 0, 0.07 * HANDLE_Z]
    ball = Sphere(0.0028)
    return Piece(f"rib_end_{i}", ball, SNAP, (x - 0.001, y, z), mass=0.0, solid=False)


HANDLE = (
    bar(-0.150, HANDLE_Z, 0.020, 0.020, 0.006),
    bar(-0.144, HANDLE_Z, 0.029, 0.029, 0.009),
    bar(-0.112, HANDLE_Z, 0.031, 0.031, 0.009),
    bar(-0.066, HANDLE_Z, 0.026, 0.026, 0.008),
    bar(-0.058, HANDLE_Z, 0.020, 0.020, 0.006),
)
STRAP = [
    bar(x, w / 2, w + 0.0008, w + 0.0008, CHAMFER * w) for x, w in ((0.0, 0.054), (0.018, 0.054))
]

UMBRELLA = Thing(
    "umbrella",
    """
A folded compact umbrella lying on its canopy: black handle, blue canopy in eight folds with a
strap around it, steel tip. Its sections have eight sides, so that it does not roll.
Frame: z up, table at z = 0; x along the handle towards the tip.
296 x 54 x 54 mm. The canopy is 620 kg/m3 (cloth, ribs and air), the handle 650 (hollow), shaft
and tip 2700 (tubes).
""",
    [
        Piece("folds", folds(0), CLOTH, mass=0.0, solid=False),
        Piece("light_folds", folds(1), LIGHT_CLOTH, mass=0.0, solid=False),
        Piece("canopy_rear", hull(*RINGS[0:3]), FOLDED, drawn=False),
        Piece("canopy_front", hull(*RINGS[2:5]), FOLDED, drawn=False),
        Piece("strap", loft(STRAP), CLOTH, mass=0.0, solid=False),
        Piece("snap", Cylinder(0.0045, 0.002), SNAP, (0.009, 0, 0.0540), mass=0.0, solid=False),
        *(rib_end(i) for i in range(8)),
        Piece("handle", loft(HANDLE), RUBBER, solid=False),
        Piece("handle_rear", hull(*HANDLE[0:3]), drawn=False),
        Piece("handle_front", hull(*HANDLE[2:5]), drawn=False),
        Piece("shaft", Cylinder(0.006, 0.012), STEEL, (-0.054, 0, HANDLE_Z), (0, np.pi / 2, 0)),
        Piece("tip", Cylinder(0.005, 0.020), STEEL, (0.136, 0, 0.018), (0, np.pi / 2, 0)),
    ],
)
