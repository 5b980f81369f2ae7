"""A deep serving spoon."""

from kit import Material, Piece, Thing, bar, ellipse, hull, loft, ring
from pydrake.geometry import Ellipsoid

from tog_drake.values import Array

STEEL = Material((0.72, 0.73, 0.75))  # hollow as drawn: its pieces state their mass
SHADE = Material((0.50, 0.51, 0.53))
WOOD = Material((0.62, 0.37, 0.16), 720)

BOWL_X = 0.088  # the bowl's middle
WALL, RIM = 0.0028, 0.028  # thickness of the wall, height of the rim
SEGMENTS = 10  # flat wall segments that take the contact
# Flat segments cut the corner; this much wider, they touch where the round wall is seen.
WIDER = 1.016


def oval(a: float, b: float, z: float, count: int) -> Array:
    """A ring around the bowl with half axes ``a`` along x and ``b`` along y."""
    return ring(ellipse(a, b, count, phase=0.5), "z", z, (BOWL_X, 0))


# The outline (half axes, height) from the bottom up the outside, over the rim, down the inside.
BOWL = loft(
    [
        oval(a, b, z, 40)
        for a, b, z in (
            (0.021, 0.014, 0.0),
            (0.029, 0.021, 0.0025),
            (0.0345, 0.0245, 0.0075),
            (0.0365, 0.0264, 0.016),
            (0.038, 0.028, RIM),
            (0.038 - WALL, 0.028 - WALL, RIM),
            (0.0365 - WALL, 0.0264 - WALL, 0.016),
            (0.0335 - WALL, 0.0235 - WALL, 0.010),
            (0.024, 0.0155, 0.0064),
            (0.010, 0.006, 0.006),
        )
    ]
)
BOTTOM = hull(
    oval(0.021, 0.014, 0.0, 14),
    oval(0.029, 0.021, 0.0025, 14),
    oval(0.0345, 0.0245, 0.0068, 14),
)


def wall(i: int) -> Piece:
    """Segment ``i`` of the bowl's wall, for contact."""
    rings = [
        oval((a - inset) * WIDER, (b - inset) * WIDER, z, SEGMENTS)
        for a, b, z in ((0.0348, 0.0247, 0.0065), (0.038, 0.028, RIM))
        for inset in (0.0, WALL)
    ]
    segment = hull(*(r[[i, (i + 1) % SEGMENTS]] for r in rings))
    return Piece(f"bowl_{i}", segment, drawn=False)


NECK = (
    bar(0.0535, 0.0240, 0.016, 0.006, 0.001),
    bar(0.046, 0.0275, 0.013, 0.007, 0.001),
    bar(0.030, 0.0325, 0.010, 0.008, 0.001),
    bar(0.008, 0.0355, 0.010, 0.008, 0.001),
)
HANDLE = (
    bar(0.010, 0.0355, 0.013, 0.011, 0.003),
    bar(-0.020, 0.0345, 0.0155, 0.0125, 0.0035),
    bar(-0.085, 0.0225, 0.0165, 0.013, 0.0035),
    bar(-0.150, 0.0065, 0.0185, 0.013, 0.0035),
    bar(-0.160, 0.0055, 0.0145, 0.009, 0.003),
)

SPOON = Thing(
    "spoon",
    """
A deep serving spoon lying as it does on a table, on its bowl and the end of its handle: steel
bowl and neck, wooden handle. The bowl is hollow: ten wall segments and a bottom.
Frame: z up, table at z = 0; x along the handle towards the bowl.
286 mm long; bowl 76 x 56 x 28 mm; the handle arches to 41 mm. The steel has the mass of 1 mm
sheet, the handle 720 kg/m3.
""",
    [
        Piece("bowl", BOWL, STEEL, mass=0.052, solid=False),
        Piece("inside", Ellipsoid(0.0255, 0.017, 0.0008), SHADE, (BOWL_X, 0, 0.0063), solid=False),
        Piece("bowl_bottom", BOTTOM, drawn=False),
        *(wall(i) for i in range(SEGMENTS)),
        Piece("neck", loft(NECK), STEEL, mass=0.014, solid=False),
        Piece("neck_front", hull(*NECK[0:2]), drawn=False),
        Piece("neck_rear", hull(*NECK[1:4]), drawn=False),
        Piece("handle", loft(HANDLE), WOOD, solid=False),
        Piece("handle_front", hull(*HANDLE[0:2]), drawn=False),
        Piece("handle_middle", hull(*HANDLE[1:3]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[2:5]), drawn=False),
    ],
)
