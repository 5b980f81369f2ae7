"""A toy elephant."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from kit import Material, Piece, Thing, ellipse, hull, loft, sweep
from pydrake.geometry import Cylinder, Ellipsoid, Sphere

from tog_drake.values import Array

GREY = Material((0.47, 0.53, 0.62), 600)  # soft plastic with some air in it
DARK_GREY = Material((0.38, 0.43, 0.52), 600)
PINK = Material((0.90, 0.62, 0.66), 600)
IVORY = Material((0.97, 0.94, 0.84), 600)
NAIL_PAINT = Material((0.93, 0.90, 0.82))
WHITE_PAINT = Material((0.97, 0.97, 0.95))
BLACK_PAINT = Material((0.03, 0.03, 0.03))


def tube(stations: Sequence[tuple[float, float, float]]) -> list[Array]:
    """Round rings along stations (x, z, diameter) in the plane y = 0."""
    path = np.array([(x, 0.0, z) for x, z, _ in stations])
    return sweep(path, [ellipse(d / 2, d / 2, 16) for _, _, d in stations])


# From the face down, forward, and up at the end.
TRUNK = tube(
    [
        (0.073, 0.082, 0.024),
        (0.085, 0.066, 0.022),
        (0.093, 0.048, 0.0195),
        (0.101, 0.034, 0.0175),
        (0.113, 0.028, 0.0160),
        (0.123, 0.034, 0.0150),
        (0.128, 0.045, 0.0145),
    ]
)
CUTS = (0, 2, 4, 6)  # rings between the convex pieces of the trunk
TAIL = tube([(-0.048, 0.074, 0.008), (-0.060, 0.060, 0.006), (-0.064, 0.042, 0.0055)])


def touched(name: str, rings: Sequence[Array]) -> Piece:
    """The contact of a tube: every other point, a little further out to make up for the rest."""
    middles = [r.mean(0) for r in rings]
    coarse = [m + 1.05 * (r[1::2] - m) for r, m in zip(rings, middles, strict=True)]
    return Piece(name, hull(*coarse), drawn=False)


def leg(name: str, x: float, y: float) -> list[Piece]:
    nails = [
        Piece(
            f"nail_{name}_{i}",
            Sphere(0.0028),
            NAIL_PAINT,
            (x + 0.0108 * np.cos(a), y + 0.0108 * np.sin(a), 0.0034),
            solid=False,
        )
        for i, a in enumerate((-0.65, 0.0, 0.65))
    ]
    return [Piece(f"leg_{name}", Cylinder(0.0125, 0.050), DARK_GREY, (x, y, 0.025)), *nails]


def side(name: str, sign: int) -> list[Piece]:
    """What the head has on either side: ear, eye, tusk."""
    turn = sign * 0.55  # an ear stands off the head to the rear
    ear = (0.044, sign * 0.0350, 0.0930)
    inner = (0.0461, sign * 0.0362, 0.0920)
    tusk = (0.0870, sign * 0.0145, 0.0690)
    return [
        Piece(f"ear_{name}", Ellipsoid(0.0045, 0.0215, 0.0270), GREY, ear, (0, 0, turn)),
        Piece(
            f"ear_inner_{name}",
            Ellipsoid(0.0030, 0.0160, 0.0205),
            PINK,
            inner,
            (0, 0, turn),
            0.0,
            solid=False,
        ),
        Piece(
            f"eye_{name}", Sphere(0.0042), WHITE_PAINT, (0.0740, sign * 0.0160, 0.1010), solid=False
        ),
        Piece(
            f"pupil_{name}",
            Sphere(0.0026),
            BLACK_PAINT,
            (0.0768, sign * 0.0168, 0.1016),
            solid=False,
        ),
        Piece(f"tusk_{name}", Ellipsoid(0.0130, 0.0032, 0.0032), IVORY, tusk, (0, 0.35, 0)),
    ]


TOY_ELEPHANT = Thing(
    "toy_elephant",
    """
A toy elephant standing on its four legs, its trunk curled up at the end.
Frame: z up, table at z = 0; x towards the head.
202 x 110 x 121 mm with its ears, body 60 mm wide; soft plastic with some air in it, 600 kg/m3.
""",
    [
        Piece("body", Ellipsoid(0.052, 0.030, 0.034), GREY, (-0.006, 0, 0.070)),
        Piece("head", Ellipsoid(0.027, 0.024, 0.026), GREY, (0.054, 0, 0.094)),
        Piece("trunk", loft(TRUNK), GREY, solid=False),
        *(
            touched(f"trunk_{i}", TRUNK[begin : end + 1])
            for i, (begin, end) in enumerate(pairwise(CUTS))
        ),
        Piece("tail", hull(*TAIL), DARK_GREY),
        Piece(
            "tuft", Ellipsoid(0.0036, 0.0036, 0.0065), DARK_GREY, (-0.0645, 0, 0.0420), solid=False
        ),
        *leg("front_left", 0.024, 0.0165),
        *leg("front_right", 0.024, -0.0165),
        *leg("rear_left", -0.034, 0.0165),
        *leg("rear_right", -0.034, -0.0165),
        *side("left", 1),
        *side("right", -1),
    ],
)
