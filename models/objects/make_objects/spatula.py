"""A slotted turner for the wok."""

import numpy as np
from kit import Material, Piece, Thing, bar, hull, loft

from tog_drake.values import Array

NYLON = Material((0.09, 0.09, 0.10), 1140)
STEEL = Material((0.68, 0.70, 0.72))  # the neck states its mass
HOLLOW_PLASTIC = Material((0.80, 0.10, 0.08), 620)

# The blade rises from its front edge towards the handle. On it, u counts from the front edge
# towards the handle and v from the lower face up.
TILT = np.radians(12)
LENGTH, HALF_WIDTH, THICKNESS = 0.086, 0.031, 0.003
FRONT_EDGE = np.array([0.148, 0.0, 0.0])
U = np.array([-np.cos(TILT), 0.0, np.sin(TILT)])
V = np.array([np.sin(TILT), 0.0, np.cos(TILT)])
SLOTS = (0.016, 0.068)  # where they begin and end, in u


def at(u: float, y: float, v: float) -> Array:
    """A point (3,) on the blade."""
    point: Array = FRONT_EDGE + u * U + v * V + np.array([0.0, y, 0.0])
    return point


def across(u: float, half_width: float, v: float) -> list[Array]:
    """Two points on the blade, at its left and right."""
    return [at(u, -half_width, v), at(u, half_width, v)]


def slab(name: str, u: tuple[float, float], y: tuple[float, float]) -> Piece:
    """A cuboid of the blade's thickness."""
    corners = [at(a, b, c) for a in u for b in y for c in (0.0, THICKNESS)]
    return Piece(name, hull(np.array(corners)), NYLON)


def lip(name: str, side: int) -> Piece:
    """The upturned side at y > 0 (side 1) or y < 0 (-1)."""
    outline = [
        (0.012, THICKNESS),
        (0.012, THICKNESS + 0.004),
        (0.030, THICKNESS + 0.013),
        (LENGTH, THICKNESS + 0.016),
        (LENGTH, THICKNESS),
    ]
    edges = (side * HALF_WIDTH, side * (HALF_WIDTH - 0.003))
    return Piece(name, hull(np.array([at(u, y, v) for y in edges for u, v in outline])), NYLON)


FRONT = hull(
    np.array(
        [
            *across(0.0, HALF_WIDTH - 0.004, 0.0),
            *across(0.0, HALF_WIDTH - 0.004, 0.0012),
            *across(0.004, HALF_WIDTH, 0.0),
            *across(0.004, HALF_WIDTH, 0.0018),
            *across(SLOTS[0], HALF_WIDTH, 0.0),
            *across(SLOTS[0], HALF_WIDTH, THICKNESS),
        ]
    )
)

FOOT = at(LENGTH - 0.012, 0.0, 0.0)  # where the neck stands on the blade
NECK = (
    bar(FOOT[0], FOOT[2] + 0.004, 0.026, 0.005, 0.001),
    bar(0.058, 0.0260, 0.016, 0.006, 0.001),
    bar(0.040, 0.0400, 0.012, 0.008, 0.002),
    bar(0.020, 0.0430, 0.012, 0.008, 0.002),
)
HANDLE = (
    bar(0.026, 0.0425, 0.018, 0.013, 0.004),
    bar(0.005, 0.0405, 0.024, 0.0165, 0.005),
    bar(-0.150, 0.0090, 0.027, 0.018, 0.005),
    bar(-0.158, 0.0090, 0.021, 0.012, 0.004),
)

SPATULA = Thing(
    "spatula",
    """
A slotted turner for the wok lying on the front edge of its blade and the end of its handle:
black nylon blade with upturned sides, steel neck, red handle.
Frame: z up, table at z = 0; x along the handle towards the blade.
306 mm long; blade 86 x 62 mm, 3 mm thick, sides up to 16 mm, its rear 18 mm above the table.
Nylon 1140 kg/m3, hollow handle 620 kg/m3, neck 18 g.
""",
    [
        Piece("blade_front", FRONT, NYLON),
        slab("blade_rear", (SLOTS[1], LENGTH), (-HALF_WIDTH, HALF_WIDTH)),
        slab("blade_bar_0", SLOTS, (-HALF_WIDTH, -0.0205)),
        slab("blade_bar_1", SLOTS, (-0.0115, -0.0045)),
        slab("blade_bar_2", SLOTS, (0.0045, 0.0115)),
        slab("blade_bar_3", SLOTS, (0.0205, HALF_WIDTH)),
        lip("blade_lip_left", 1),
        lip("blade_lip_right", -1),
        Piece("neck", loft(NECK), STEEL, mass=0.018, solid=False),
        Piece("neck_front", hull(*NECK[0:2]), drawn=False),
        Piece("neck_middle", hull(*NECK[1:3]), drawn=False),
        Piece("neck_rear", hull(*NECK[2:4]), drawn=False),
        Piece("handle", loft(HANDLE), HOLLOW_PLASTIC, solid=False),
        Piece("handle_front", hull(*HANDLE[0:2]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[1:4]), drawn=False),
    ],
)
