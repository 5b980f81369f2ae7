"""A porcelain cup for a double espresso."""

from itertools import pairwise

from kit import Material, Piece, Thing, hoop, hull, loft, octagon, smooth_path, sweep
from pydrake.geometry import Cylinder
from vessel import circle, corners, wall

from tog_drake.values import Array

PORCELAIN = Material((0.95, 0.95, 0.93), 2400)
COBALT = Material((0.08, 0.20, 0.58))
SHADE = Material((0.80, 0.80, 0.79))

HEIGHT, RIM, WALL = 0.055, 0.0320, 0.0035
FOOT, SHOULDER = 0.0200, 0.0260  # radii on the table and where the wall begins
SHOULDER_Z, FLOOR = 0.0110, 0.0080


def outer(z: float) -> float:
    """The radius outside at height ``z`` of the wall, a cone."""
    return SHOULDER + (RIM - SHOULDER) * (z - SHOULDER_Z) / (HEIGHT - SHOULDER_Z)


# The outline from the foot up the outside, over the rim and down to the floor inside.
SHELL = loft(
    [
        circle(FOOT, 0.0),
        circle(FOOT, 0.003),
        circle(0.0238, 0.0065),
        circle(SHOULDER, SHOULDER_Z),
        circle(outer(0.030), 0.030),
        circle(RIM, HEIGHT - 0.001),
        circle(RIM - 0.0006, HEIGHT - 0.0002),
        circle(RIM - WALL / 2, HEIGHT),
        circle(RIM - WALL + 0.0006, HEIGHT - 0.0003),
        circle(RIM - WALL, HEIGHT - 0.001),
        circle(outer(0.014) - WALL, 0.014),
        circle(0.0200, FLOOR + 0.001),
        circle(0.0170, FLOOR),
    ]
)


def band(low: float, high: float) -> list[Array]:
    """A stripe painted around the outside: its rings go out, up, and in again."""
    proud, within = 0.0003, -0.001
    levels = ((within, low), (proud, low), (proud, high), (within, high))
    return [circle(outer(z) + d, z) for d, z in levels]


def handle_rings() -> list[Array]:
    """25 rings along a small ear in the plane y = 0."""
    xz = [
        (0.0280, 0.0455),
        (0.0380, 0.0470),
        (0.0470, 0.0445),
        (0.0510, 0.0375),
        (0.0490, 0.0295),
        (0.0420, 0.0220),
        (0.0340, 0.0185),
        (0.0255, 0.0180),
    ]
    return sweep(smooth_path(xz, 25), [octagon(0.0105, 0.0065, 0.0018)] * 25)


RINGS = handle_rings()
CUTS = (0, 7, 12, 17, 24)  # rings between the convex pieces of the handle
BOTTOM = hull(
    corners(FOOT * 1.04, 0.0, 8), corners(FOOT * 1.04, 0.003, 8), corners(0.0250, FLOOR, 8)
)

CUP = Thing(
    "cup",
    """
A white porcelain cup for a double espresso, with a cobalt band and a small ear; standing upright;
hollow: eight wall segments and a bottom.
Frame: z up along the cup's axis, table at z = 0; x towards the handle.
Outer diameter 64 mm at the rim, 40 mm at the foot, 55 mm high, wall 3.5 mm, handle to x = 54 mm;
2400 kg/m3.
""",
    [
        Piece("cup", SHELL, PORCELAIN, solid=False),
        Piece("band", hoop(band(0.0410, 0.0490)), COBALT, solid=False),
        Piece("line", hoop(band(0.0375, 0.0388)), COBALT, solid=False),
        Piece("inside", Cylinder(0.0165, 0.0004), SHADE, (0, 0, FLOOR + 0.0001), solid=False),
        Piece("handle", loft(RINGS), PORCELAIN, solid=False),
        Piece("bottom", BOTTOM, drawn=False),
        *wall((0.0252, 0.0200, FLOOR), (RIM, RIM - WALL, HEIGHT), segments=8),
        *(
            Piece(f"handle_{i}", hull(*RINGS[begin : end + 1]), drawn=False)
            for i, (begin, end) in enumerate(pairwise(CUTS))
        ),
    ],
)
