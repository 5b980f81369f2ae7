"""A bar muddler."""

import numpy as np
from kit import Material, Piece, Thing, TriangleMesh, bar, hull, join, loft

from tog_drake.values import Array

BEECH = Material((0.78, 0.55, 0.30), 720)
NYLON = Material((0.10, 0.10, 0.11), 1140)
BAND = Material((0.72, 0.73, 0.75))

HEAD_WIDTH = 0.040
FRONT = 0.112  # the head's face


def eight_sided(x: float, width: float, above: float = 0.0) -> Array:
    """A ring across the axis, ``above`` the table."""
    return bar(x, above + width / 2, width, width, 0.27 * width)


# Knob, waist and shoulder; knob and head lie on the table.
HANDLE = (
    eight_sided(-0.112, 0.018, 0.005),
    eight_sided(-0.104, 0.028),
    eight_sided(-0.082, 0.028),
    eight_sided(-0.040, 0.023, 0.0045),
    eight_sided(0.030, 0.023, 0.0070),
    eight_sided(0.056, 0.027, 0.0065),
)
HEAD = loft(
    [
        eight_sided(0.056, 0.031, 0.0045),
        eight_sided(0.062, HEAD_WIDTH),
        eight_sided(FRONT - 0.003, HEAD_WIDTH),
        eight_sided(FRONT, HEAD_WIDTH - 0.005, 0.0025),
    ]
)


def tooth(y: float, z: float) -> TriangleMesh:
    """A low pyramid on the head's face."""
    centre = np.array([FRONT, y, HEAD_WIDTH / 2 + z])
    base = np.array([[0.0, -1, -1], [0, -1, 1], [0, 1, -1], [0, 1, 1]]) * 0.0042
    return hull(centre + base, centre[None] + [0.0018, 0, 0])


TEETH = join([tooth(0.0095 * i, 0.0095 * j) for i in (-1, 0, 1) for j in (-1, 0, 1)])

MUDDLER = Thing(
    "muddler",
    """
A bar muddler lying on head and knob: beech handle, black nylon head with teeth on its face.
Its sections have eight sides, so that it does not roll.
Frame: z up, table at z = 0; x along the handle towards the head.
224 x 40 x 40 mm; handle 720 kg/m3, head 1140 kg/m3.
""",
    [
        Piece("handle", loft(HANDLE), BEECH, solid=False),
        Piece("knob", hull(*HANDLE[0:3]), drawn=False),
        Piece("handle_rear", hull(*HANDLE[2:4]), drawn=False),
        Piece("handle_middle", hull(*HANDLE[3:5]), drawn=False),
        Piece("handle_front", hull(*HANDLE[4:6]), drawn=False),
        Piece("head", HEAD, NYLON),
        Piece("teeth", TEETH, NYLON, mass=0.0, solid=False),
        Piece(
            "band",
            loft([eight_sided(0.047, 0.0268, 0.0062), eight_sided(0.0562, 0.0280, 0.0060)]),
            BAND,
            solid=False,
        ),
    ],
)
