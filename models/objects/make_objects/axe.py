"""A belt hatchet."""

import numpy as np
from kit import Material, Piece, Thing, hull, loft, octagon, ring
from pydrake.geometry import Box

from tog_drake.values import Array

STEEL = Material((0.33, 0.35, 0.38), 7850)
EYED_STEEL = Material(STEEL.colour, 0.6 * STEEL.density)  # the handle's end fills the rest
GROUND_STEEL = Material((0.82, 0.84, 0.86), 7850)
ASH = Material((0.76, 0.52, 0.27), 700)
END_GRAIN = Material((0.60, 0.38, 0.17))

Z = 0.0105  # height of the head's middle plane, half its thickness


def section(x: float, y: float, width: float, height: float, bottom: float = 0.0) -> Array:
    """A ring of the handle, which bends in the plane of the table."""
    outline = octagon(width, height, 0.3 * min(width, height))
    return ring(outline, "x", x, (y, bottom + height / 2))


def cut(y: float, x: tuple[float, float], thickness: float) -> Array:
    """A cut across the head: a rectangle (4, 3)."""
    corners = [(a, y, Z + b * thickness / 2) for a in x for b in (-1, 1)]
    return np.array(corners)


# From the knob at the end to the eye.
HANDLE = (
    section(-0.135, -0.0060, 0.026, 0.016, 0.0025),
    section(-0.129, -0.0060, 0.034, 0.021),
    section(-0.112, -0.0020, 0.030, 0.021),
    section(-0.085, 0.0015, 0.025, 0.020),
    section(-0.020, 0.0035, 0.025, 0.019, 0.0012),
    section(0.050, 0.0010, 0.023, 0.017, 0.0020),
    section(0.102, 0.0, 0.024, 0.015, 0.0030),
)
CUTS = (0, 2, 3, 4, 5, 6)  # rings between the convex pieces of the handle
NAMES = ("knob", "grip", "handle_rear", "handle_middle", "handle_front")

POLL = hull(cut(-0.026, (0.102, 0.128), 0.018), cut(-0.014, (0.100, 0.130), 0.021))
CHEEK = hull(cut(0.019, (0.100, 0.130), 0.020), cut(0.038, (0.096, 0.131), 0.0105))
BLADE = hull(cut(0.038, (0.096, 0.131), 0.0105), cut(0.054, (0.084, 0.134), 0.0055))
# The ground edge is an arc.
EDGE = hull(
    cut(0.054, (0.084, 0.134), 0.0055),
    cut(0.061, (0.0815, 0.1345), 0.0012),
    cut(0.0645, (0.091, 0.126), 0.0010),
    cut(0.0655, (0.100, 0.117), 0.0010),
)

AXE = Thing(
    "axe",
    """
A belt hatchet lying on its side: bent ash handle with a knob, dark steel head, ground edge.
Frame: z up, table at z = 0; x along the handle towards the head, y towards the edge.
270 x 92 x 21 mm, edge 53 mm. The head is 7850 kg/m3 (its eye is filled by the handle), the
handle 700.
""",
    [
        Piece("handle", loft(HANDLE), ASH, solid=False),
        *(
            Piece(name, hull(*HANDLE[begin : end + 1]), drawn=False)
            for name, begin, end in zip(NAMES, CUTS, CUTS[1:], strict=False)
        ),
        Piece("eye", Box(0.032, 0.033, 0.021), EYED_STEEL, (0.115, 0.0025, Z)),
        # The handle's end, to be seen in the head.
        Piece(
            "end_grain",
            Box(0.003, 0.022, 0.013),
            END_GRAIN,
            (0.1310, 0.0, Z),
            mass=0.0,
            solid=False,
        ),
        Piece("poll", POLL, STEEL),
        Piece("cheek", CHEEK, STEEL),
        Piece("blade", BLADE, STEEL),
        Piece("edge", EDGE, GROUND_STEEL),
    ],
)
