"""A hand brush."""

from kit import Material, Piece, Thing, TriangleMesh, bar, ellipse, hull, join, loft, octagon, ring
from pydrake.geometry import Cylinder

from tog_drake.values import Array

TEAL_WOOD = Material((0.02, 0.50, 0.55), 700)
HAIR = Material((0.98, 0.95, 0.85), 320)  # and the air between
DARK_PAINT = Material((0.02, 0.36, 0.40))

HEAD_X = 0.053  # the middle of block and bristles


def level(z: float, length: float, width: float, chamfer: float) -> Array:
    """A ring of the head at height ``z``."""
    return ring(octagon(length, width, chamfer), "z", z, (HEAD_X, 0))


def tuft(i: int, j: int) -> TriangleMesh:
    """Tuft ``i`` along x and ``j`` along y from the middle one; it widens towards the table."""
    x, y = i * 0.0090, j * 0.0063
    return loft(
        [
            ring(ellipse(0.0058, 0.0055, 6), "z", 0.0, (HEAD_X + 1.2 * x, 1.53 * y)),
            ring(ellipse(0.0042, 0.0033, 6), "z", 0.030, (HEAD_X + x, y)),
        ]
    )


BLOCK = loft(
    [
        level(0.029, 0.104, 0.033, 0.010),
        level(0.041, 0.104, 0.033, 0.010),
        level(0.045, 0.098, 0.027, 0.008),
    ]
)
TUFTS = join(
    [
        tuft(i, j)
        for i in range(-5, 6)
        for j in range(-2, 3)
        if (abs(i), abs(j)) != (5, 2)  # the corners are cut
    ]
)
BRISTLES = loft([level(0.0, 0.120, 0.050, 0.012), level(0.029, 0.101, 0.031, 0.008)])
HANDLE = (
    bar(0.004, 0.0370, 0.030, 0.014, 0.004),
    bar(-0.020, 0.0410, 0.021, 0.016, 0.005),
    bar(-0.085, 0.0500, 0.026, 0.019, 0.006),
    bar(-0.118, 0.0535, 0.026, 0.017, 0.006),
    bar(-0.128, 0.0545, 0.018, 0.010, 0.003),
)
HOLE = Cylinder(0.004, 0.0172)

BRUSH = Thing(
    "brush",
    """
A hand brush standing on its bristles; its handle sticks out above the table.
Frame: z up, table at z = 0; x along the handle towards the bristles.
241 x 50 x 62 mm; block and handle 700 kg/m3, bristles 320 kg/m3 (hair and air).
""",
    [
        Piece("block", BLOCK, TEAL_WOOD),
        # Seen as tufts, touched and weighed as one block of hair and air.
        Piece("tufts", TUFTS, HAIR, mass=0.0, solid=False),
        Piece("bristles", BRISTLES, HAIR, drawn=False),
        Piece("handle", loft(HANDLE), TEAL_WOOD, solid=False),
        Piece("handle_front", hull(*HANDLE[0:2]), drawn=False),
        Piece("handle_middle", hull(*HANDLE[1:3]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[2:5]), drawn=False),
        Piece("hole", HOLE, DARK_PAINT, (-0.112, 0, 0.0530), (0, 0.1, 0), solid=False),
    ],
)
