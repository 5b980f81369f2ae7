"""A balloon whisk."""

import numpy as np
from kit import (
    Material,
    Piece,
    Thing,
    TriangleMesh,
    ellipse,
    hull,
    join,
    loft,
    octagon,
    ring,
    sweep,
)
from scipy.interpolate import PchipInterpolator

from tog_drake.values import Array

WIRE = Material((0.86, 0.87, 0.90))  # the balloon states its mass
RUBBER = Material((0.09, 0.09, 0.10), 950)
STEEL = Material((0.70, 0.71, 0.73))

LOOPS = 6
GAUGE = 0.0015  # radius of a wire; real ones are 1 mm: too thin for the camera
# The balloon's outline, to the middle of the wires: x, radius.
OUTLINE = np.array(
    [
        (-0.006, 0.0070),
        (0.020, 0.0100),
        (0.055, 0.0180),
        (0.090, 0.0262),
        (0.110, 0.0285),
        (0.128, 0.0265),
        (0.141, 0.0190),
        (0.147, 0.0085),
    ]
)
TIP = 0.1485
FLAT = np.cos(np.pi / LOOPS / 2)  # the balloon's sides are flat between the wires

# The balloon's belly and the handle's end lie on the table, so the axis rises.
BELLY, END = (0.110, (0.0285 + GAUGE) * FLAT), (-0.136, 0.0115)
SLOPE = (BELLY[1] - END[1]) / (BELLY[0] - END[0])


def axis_z(x: float | Array) -> float | Array:
    """The height of the axis."""
    return BELLY[1] + SLOPE * (x - BELLY[0])


def loop(i: int) -> TriangleMesh:
    """Loop ``i``: a wire from the handle around the balloon and back."""
    half = np.vstack([OUTLINE, [(TIP, 0.0)]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(half, axis=0), axis=1))])
    there = PchipInterpolator(along, half)(np.linspace(0, along[-1], 25))
    x = np.concatenate([there[:, 0], there[-2::-1, 0]])
    r = np.concatenate([there[:, 1], -there[-2::-1, 1]])
    path = np.stack([x, np.zeros_like(x), r], axis=1)
    rings = sweep(path, [ellipse(GAUGE, GAUGE, 6)] * len(path))
    angle = (i + 0.5) * np.pi / LOOPS
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    turned = [p @ turn.T for p in rings]
    return loft([p + np.stack([p[:, 0] * 0, p[:, 0] * 0, axis_z(p[:, 0])], 1) for p in turned])


def around(x: float, radius: float) -> Array:
    """A ring of the balloon that holds all wires."""
    outer = radius + GAUGE
    section = ellipse(outer, outer, 2 * LOOPS, phase=0.5)
    return ring(section, "x", x, (0, float(axis_z(x))))


def eight_sided(x: float, width: float) -> Array:
    """A ring of the handle."""
    return ring(octagon(width, width, 0.27 * width), "x", x, (0, float(axis_z(x))))


BALLOON = [around(*point) for point in OUTLINE]
BALLOON.append(around(TIP + GAUGE, 0.004))
HANDLE = (
    eight_sided(-0.144, 0.017),
    eight_sided(-0.136, 0.023),
    eight_sided(-0.105, 0.025),
    eight_sided(-0.050, 0.021),
    eight_sided(-0.012, 0.024),
    eight_sided(-0.002, 0.018),
)

WHISK = Thing(
    "whisk",
    """
A balloon whisk lying on its belly and the end of its handle: six loops of wire, black handle.
Its sections have flat sides, so that it does not roll. Seen as wires; touched as a closed balloon.
Frame: z up, table at z = 0; x along the handle towards the balloon.
294 mm long, balloon 60 mm, handle 25 mm; the wires weigh 45 g, the handle 950 kg/m3.
""",
    [
        Piece("wires", join([loop(i) for i in range(LOOPS)]), WIRE, mass=0.0, solid=False),
        Piece("balloon_rear", hull(*BALLOON[0:3]), mass=0.015, drawn=False),
        Piece("balloon_middle", hull(*BALLOON[2:5]), mass=0.018, drawn=False),
        Piece("balloon_front", hull(*BALLOON[4:]), mass=0.012, drawn=False),
        Piece("handle", loft(HANDLE), RUBBER, solid=False),
        Piece("handle_end", hull(*HANDLE[0:3]), drawn=False),
        Piece("handle_middle", hull(*HANDLE[2:4]), drawn=False),
        Piece("handle_front", hull(*HANDLE[3:6]), drawn=False),
        Piece(
            "ferrule",
            loft([eight_sided(-0.004, 0.0190), eight_sided(0.002, 0.0172)]),
            STEEL,
            mass=0.0,
            solid=False,
        ),
    ],
)
