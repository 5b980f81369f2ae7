"""A folded compact umbrella."""

from typing import Literal

import numpy as np
from kit import Material, Piece, Thing, TriangleMesh, bar, hull, join, loft
from pydrake.geometry import Cylinder, Sphere

from tog_drake.values import Array

CLOTH = Material((0.06, 0.11, 0.42))
LIGHT_CLOTH = Material((0.25, 0.42, 0.85))
STRAP_CLOTH = Material((0.04, 0.07, 0.28))
FOLDED = Material(CLOTH.colour, 620)  # cloth, ribs and the air between
RUBBER = Material((0.07, 0.07, 0.08), 650)  # with a hole for the shaft
STEEL = Material((0.72, 0.73, 0.75), 2700)  # a tube
SNAP = Material((0.80, 0.81, 0.84))

CHAMFER = 0.29  # of the width: a regular octagon
# The canopy's width along x. Its underside lies on the table, so its axis falls to the tip.
PROFILE = ((-0.050, 0.044), (-0.035, 0.054), (0.030, 0.054), (0.110, 0.040), (0.128, 0.020))
HANDLE_Z = 0.027
WINDING = np.radians(70) / 0.178  # [rad/m] of the folded cloth about the axis


def canopy_ring(x: float, width: float) -> Array:
    """A ring of the canopy; only its two ends leave the table."""
    z = {-0.050: 0.027, 0.128: 0.018}.get(x, width / 2)
    return bar(x, z, width, width, CHAMFER * width)


RINGS = [canopy_ring(x, width) for x, width in PROFILE]


def gore(i: int, x: Array) -> TriangleMesh:
    """Gore ``i`` of eight as it is seen: laid over the next one, all wound around the canopy."""
    at, width = np.array(PROFILE).T
    t = np.linspace(0.0, 1.0, 7)  # from the fold, which stands out, to under the next gore
    sections = []
    for station in x:
        axis = [np.interp(station, at, [r.mean(0)[2] for r in RINGS])]
        radius = 0.505 * np.interp(station, at, width) * (1.0 - 0.07 * t)
        angle = (i + t) * np.pi / 4 + WINDING * (station - at[0])
        y, z = radius * np.cos(angle), axis + radius * np.sin(angle)
        arc = np.column_stack([np.full(len(t), station), y, z])
        sections.append(np.vstack([[[station, 0.0, axis[0]]], arc]))
    return loft(sections)


def folds(which: Literal[0, 1]) -> TriangleMesh:
    """Every other gore of the canopy."""
    x = np.unique([*np.linspace(PROFILE[0][0], PROFILE[-1][0], 16), *(x for x, _ in PROFILE)])
    return join([gore(i, x) for i in range(which, 8, 2)])


def rib_end(i: int) -> Piece:
    """The knob at the end of rib ``i``."""
    angle = i * np.pi / 4
    y, z = 0.0205 * np.cos(angle), HANDLE_Z + 0.0205 * np.sin(angle)
    ball = Sphere(0.0028)
    return Piece(f"rib_end_{i}", ball, SNAP, (-0.051, y, z), mass=0.0, solid=False)


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
A folded compact umbrella lying on its canopy: black handle, blue canopy wound in eight folds
with a strap around it, steel tip. Its sections have eight sides, so that it does not roll.
Frame: z up, table at z = 0; x along the handle towards the tip.
296 x 54 x 54 mm. The canopy is 620 kg/m3 (cloth, ribs and air), the handle 650 (hollow), shaft
and tip 2700 (tubes).
""",
    [
        Piece("folds", folds(0), CLOTH, mass=0.0, solid=False),
        Piece("light_folds", folds(1), LIGHT_CLOTH, mass=0.0, solid=False),
        Piece("canopy_rear", hull(*RINGS[0:3]), FOLDED, drawn=False),
        Piece("canopy_front", hull(*RINGS[2:5]), FOLDED, drawn=False),
        Piece("strap", loft(STRAP), STRAP_CLOTH, mass=0.0, solid=False),
        Piece("snap", Cylinder(0.0045, 0.002), SNAP, (0.009, 0, 0.0540), mass=0.0, solid=False),
        *(rib_end(i) for i in range(8)),
        Piece("handle", loft(HANDLE), RUBBER, solid=False),
        Piece("handle_rear", hull(*HANDLE[0:3]), drawn=False),
        Piece("handle_front", hull(*HANDLE[2:5]), drawn=False),
        Piece("shaft", Cylinder(0.006, 0.012), STEEL, (-0.054, 0, HANDLE_Z), (0, np.pi / 2, 0)),
        Piece("tip", Cylinder(0.005, 0.020), STEEL, (0.136, 0, 0.018), (0, np.pi / 2, 0)),
    ],
)
