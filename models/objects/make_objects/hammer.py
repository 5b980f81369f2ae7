"""A light claw hammer."""

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft, octagon, ring
from pydrake.geometry import Box

from tog_drake.values import Array

STEEL = Material((0.62, 0.64, 0.67), 7850)
EYED_STEEL = Material(STEEL.colour, 0.6 * STEEL.density)  # the handle's end fills the rest
FIBREGLASS = Material((0.95, 0.72, 0.05), 900)
RUBBER = Material((0.07, 0.07, 0.08), 900)

Z = 0.0125  # height of the handle's axis, half the head's thickness
HEAD_X = 0.1155  # the head's axis, which runs along y


def head_ring(y: float, width: float, chamfer: float) -> Array:
    """A ring of the striking end, across the head's axis."""
    return ring(octagon(width, width, chamfer), "y", y, (HEAD_X, Z))


def claw_cut(y: float, x: tuple[float, float], z: tuple[float, float]) -> Array:
    """A cut across the head's axis: a rectangle (4, 3)."""
    return np.array([[x[0], y, z[0]], [x[1], y, z[0]], [x[1], y, z[1]], [x[0], y, z[1]]])


def prong_cut(side: int, y: float, x: tuple[float, float], z: tuple[float, float]) -> Array:
    """A cut across a prong, between two distances ``z`` from the handle's axis."""
    low, high = sorted((side * z[0], side * z[1]))
    return claw_cut(y, x, (Z + low, Z + high))


def prong(name: str, side: int) -> list[Piece]:
    """The prong above (side 1) or below (-1) the gap; it bends towards the handle."""
    root = prong_cut(side, -0.026, (0.108, 0.1215), (0.0012, 0.0095))
    middle = prong_cut(side, -0.044, (0.1045, 0.1130), (0.0030, 0.0105))
    tip = prong_cut(side, -0.060, (0.0955, 0.0990), (0.0045, 0.0112))
    return [
        Piece(name, hull(root, middle), STEEL),
        Piece(f"{name}_tip", hull(middle, tip), STEEL),
    ]


GRIP = loft(
    [
        bar(-0.130, Z, 0.024, 0.019, 0.005),
        bar(-0.126, Z, 0.030, 0.025, 0.006),
        bar(-0.105, Z, 0.030, 0.025, 0.006),
        bar(-0.020, Z, 0.025, 0.022, 0.006),
    ]
)
HANDLE = loft([bar(-0.020, Z, 0.0235, 0.020, 0.005), bar(0.104, Z, 0.019, 0.0155, 0.004)])
CLAW = hull(
    claw_cut(-0.0115, (0.1065, 0.1245), (0.004, 0.021)),
    claw_cut(-0.026, (0.108, 0.1215), (0.003, 0.022)),
)

HAMMER = Thing(
    "hammer",
    """
A light claw hammer lying on its side: yellow fibreglass handle with a black grip, steel head.
Frame: z up, table at z = 0; x along the handle towards the head, y towards the striking face.
256 x 103 x 25 mm. The head is 7850 kg/m3 (its eye is filled by the handle), handle and grip 900.
""",
    [
        Piece("grip", GRIP, RUBBER),
        Piece("handle", HANDLE, FIBREGLASS),
        # The handle's end, to be seen in the head.
        Piece("eye", Box(0.004, 0.014, 0.012), FIBREGLASS, (0.126, 0, Z), mass=0.0, solid=False),
        Piece("head", Box(0.021, 0.023, 0.025), EYED_STEEL, (HEAD_X, 0, Z)),
        Piece("poll", loft([head_ring(y, 0.0165, 0.0045) for y in (0.0115, 0.030)]), STEEL),
        Piece("face", loft([head_ring(y, 0.0215, 0.0060) for y in (0.030, 0.043)]), STEEL),
        Piece("claw", CLAW, STEEL),
        *prong("claw_upper", 1),
        *prong("claw_lower", -1),
    ],
)
