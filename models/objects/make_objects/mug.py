"""A small stoneware mug."""

from kit import Material, Piece, Thing, hull, loft, octagon, smooth_path, sweep
from pydrake.geometry import Cylinder
from vessel import circle, wall_and_bottom

from tog_drake.values import Array

STONEWARE = Material((0.78, 0.07, 0.06), 2300)
GLAZE = Material((0.95, 0.93, 0.88))

RADIUS, WALL, HEIGHT = 0.032, 0.0038, 0.082
INNER = RADIUS - WALL
FOOT = 0.0305  # radius on the table
# The outline from the foot up the outside, over the rim and down to the bottom inside.
CUP = loft(
    [
        circle(FOOT, 0.0),
        circle(RADIUS - 0.0003, 0.003),
        circle(RADIUS, 0.006),
        circle(RADIUS, HEIGHT - 0.0015),
        circle(RADIUS - 0.0008, HEIGHT - 0.0003),
        circle(RADIUS - WALL / 2, HEIGHT),
        circle(INNER + 0.0008, HEIGHT - 0.0003),
        circle(INNER, HEIGHT - 0.0015),
        circle(INNER, 0.009),
        circle(INNER - 0.002, 0.0065),
        circle(0.020, 0.006),
    ]
)


def handle_rings() -> list[Array]:
    """33 rings along a C in the plane y = 0."""
    xz = [
        (0.0300, 0.0665),
        (0.0430, 0.0680),
        (0.0535, 0.0655),
        (0.0600, 0.0570),
        (0.0605, 0.0440),
        (0.0580, 0.0320),
        (0.0510, 0.0230),
        (0.0410, 0.0185),
        (0.0300, 0.0180),
    ]
    return sweep(smooth_path(xz, 33), [octagon(0.0125, 0.0085, 0.0022)] * 33)


RINGS = handle_rings()
CUTS = (0, 6, 11, 16, 21, 26, 32)  # rings between the convex pieces of the handle


def handle(i: int) -> Piece:
    """Piece ``i`` of the handle, for contact, from the top."""
    return Piece(f"handle_{i}", hull(*RINGS[CUTS[i] : CUTS[i + 1] + 1]), drawn=False)


MUG = Thing(
    "mug",
    """
A small red stoneware mug standing upright; hollow: twelve wall segments and a bottom.
Frame: z up along the mug's axis, table at z = 0; x towards the handle.
Outer diameter 64 mm, height 82 mm, wall 3.8 mm, handle to x = 65 mm; 2300 kg/m3.
A coffee mug of the usual 80 mm would leave the hand (80 mm) no room: this size of cup can be
taken around the body, at the rim, or by the handle.
""",
    [
        Piece("cup", CUP, STONEWARE, solid=False),
        Piece("handle", loft(RINGS), STONEWARE, solid=False),
        Piece("inside", Cylinder(INNER - 0.0022, 0.0006), GLAZE, (0, 0, 0.0062), solid=False),
        *wall_and_bottom(RADIUS, INNER, HEIGHT, FOOT, 0.006),
        *(handle(i) for i in range(len(CUTS) - 1)),
    ],
)
