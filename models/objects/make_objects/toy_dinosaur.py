"""A toy dinosaur."""

from collections.abc import Sequence

import numpy as np
from kit import Material, Piece, Thing, ellipse, hull, loft, sweep
from pydrake.geometry import Cylinder, Ellipsoid, Sphere

from tog_drake.values import Array

GREEN = Material((0.36, 0.66, 0.20), 600)  # soft plastic with some air in it
DARK_GREEN = Material((0.20, 0.45, 0.13), 600)
ORANGE_PAINT = Material((0.95, 0.50, 0.08))
WHITE_PAINT = Material((0.97, 0.97, 0.95))
BLACK_PAINT = Material((0.03, 0.03, 0.03))


def tube(stations: Sequence[tuple[float, float, float, float]]) -> list[Array]:
    """Rings along stations (x, z, width, height) in the plane y = 0."""
    path = np.array([(x, 0.0, z) for x, z, _, _ in stations])
    return sweep(path, [ellipse(w / 2, h / 2, 16) for _, _, w, h in stations])


NECK = tube(
    [
        (0.030, 0.058, 0.040, 0.044),
        (0.046, 0.074, 0.031, 0.033),
        (0.056, 0.092, 0.026, 0.028),
        (0.062, 0.110, 0.024, 0.025),
    ]
)
TAIL = tube(
    [
        (-0.030, 0.056, 0.040, 0.040),
        (-0.055, 0.052, 0.030, 0.031),
        (-0.085, 0.043, 0.023, 0.024),
        (-0.115, 0.035, 0.018, 0.019),
        (-0.142, 0.031, 0.013, 0.013),
        (-0.150, 0.030, 0.006, 0.006),
    ]
)


def touched(name: str, rings: Sequence[Array]) -> Piece:
    """The contact of a tube: every other point, a little further out to make up for the rest."""
    middles = [r.mean(0) for r in rings]
    coarse = [m + 1.05 * (r[1::2] - m) for r, m in zip(rings, middles, strict=True)]
    return Piece(name, hull(*coarse), drawn=False)


def leg(name: str, x: float, y: float) -> Piece:
    return Piece(f"leg_{name}", Cylinder(0.0095, 0.046), DARK_GREEN, (x, y, 0.023))


def eye(side: str, sign: int) -> list[Piece]:
    white = (0.081, sign * 0.0128, 0.1235)
    black = (0.0828, sign * 0.0155, 0.1242)
    return [
        Piece(f"eye_{side}", Sphere(0.0042), WHITE_PAINT, white, solid=False),
        Piece(f"pupil_{side}", Sphere(0.0024), BLACK_PAINT, black, solid=False),
    ]


def plate(i: int, x: float, z: float, radius: float) -> Piece:
    """A plate on the back."""
    disc = Ellipsoid(radius, 0.0022, radius)
    return Piece(f"plate_{i}", disc, ORANGE_PAINT, (x, 0, z), solid=False)


TOY_DINOSAUR = Thing(
    "toy_dinosaur",
    """
A toy dinosaur (a long-necked one) standing on its four legs, with its tail held out behind.
Frame: z up, table at z = 0; x towards the head.
250 x 54 x 136 mm; soft plastic with some air in it, 600 kg/m3.
""",
    [
        Piece("body", Ellipsoid(0.048, 0.027, 0.026), GREEN, (0, 0, 0.056)),
        Piece("neck", loft(NECK), GREEN, solid=False),
        Piece("tail", loft(TAIL), GREEN, solid=False),
        Piece("head", Ellipsoid(0.026, 0.0155, 0.0155), GREEN, (0.074, 0, 0.120), (0, 0.20, 0)),
        touched("neck_0", NECK[0:2]),
        touched("neck_1", NECK[1:4]),
        touched("tail_0", TAIL[0:2]),
        touched("tail_1", TAIL[1:4]),
        touched("tail_2", TAIL[3:6]),
        leg("front_left", 0.026, 0.0165),
        leg("front_right", 0.026, -0.0165),
        leg("rear_left", -0.026, 0.0165),
        leg("rear_right", -0.026, -0.0165),
        *eye("left", 1),
        *eye("right", -1),
        plate(0, 0.050, 0.098, 0.004),
        plate(1, 0.036, 0.0845, 0.005),
        plate(2, 0.018, 0.0805, 0.006),
        plate(3, 0.0, 0.0815, 0.006),
        plate(4, -0.018, 0.0800, 0.006),
        plate(5, -0.036, 0.0738, 0.005),
        plate(6, -0.054, 0.0672, 0.0045),
        plate(7, -0.074, 0.0585, 0.004),
        plate(8, -0.094, 0.0515, 0.0035),
    ],
)
