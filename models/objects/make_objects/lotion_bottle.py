"""A pump bottle of lotion."""

import numpy as np
from kit import Material, Piece, Thing, bar, ellipse, hull, loft, ring
from pydrake.geometry import Cylinder

from tog_drake.values import Array

LOTION = Material((0.93, 0.72, 0.68), 900)  # in a thin bottle, nearly full
PLASTIC = Material((0.94, 0.94, 0.92), 950)
HOLLOW_PLASTIC = Material(PLASTIC.colour, 500)
LABEL = Material((0.97, 0.96, 0.93))
PRINT = Material((0.08, 0.42, 0.40))


def level(z: float, a: float, b: float) -> Array:
    """A ring of the body at height ``z`` with half axes ``a`` along x and ``b`` along y."""
    return ring(ellipse(a, b, 32), "z", z)


def patch(z: tuple[float, float], half_angle: float, proud: float) -> list[Array]:
    """Rings of a sheet on the front of the body, ``proud`` of it, as far as ``half_angle``."""
    t = np.linspace(-half_angle, half_angle, 13)
    outline = [
        np.stack([(0.021 + d) * np.cos(t), (0.030 + d) * np.sin(t)], axis=1)
        for d in (proud, -0.001)
    ]
    return [ring(np.vstack([outline[0], outline[1][::-1]]), "z", h) for h in z]


BODY = loft(
    [
        level(0.0, 0.0190, 0.0275),
        level(0.004, 0.0210, 0.0300),
        level(0.088, 0.0210, 0.0300),
        level(0.098, 0.0195, 0.0275),
        level(0.106, 0.0165, 0.0215),
        level(0.110, 0.0140, 0.0155),
    ]
)
KNOB = hull(
    level(0.131, 0.0135, 0.0135),
    level(0.144, 0.0135, 0.0135),
    level(0.147, 0.0100, 0.0110),
)
NOZZLE = (
    bar(0.008, 0.1400, 0.015, 0.011, 0.003),
    bar(0.038, 0.1395, 0.010, 0.008, 0.002),
    bar(0.046, 0.1365, 0.008, 0.008, 0.002),
)

LOTION_BOTTLE = Thing(
    "lotion_bottle",
    """
A pump bottle of lotion standing upright, its pump locked down: rosy oval body with a label, white
pump of collar, knob and nozzle.
Frame: z up along the bottle's axis, table at z = 0; x towards nozzle and label.
Body 42 x 60 x 110 mm, 147 mm with the pump; nozzle to x = 46 mm. The body is 900 kg/m3 (nearly
full), collar and stem 500, knob and nozzle 950.
""",
    [
        Piece("body", BODY, LOTION),
        Piece("collar", Cylinder(0.0160, 0.0180), HOLLOW_PLASTIC, (0, 0, 0.119)),
        Piece("stem", Cylinder(0.0080, 0.0030), HOLLOW_PLASTIC, (0, 0, 0.1295)),
        Piece("knob", KNOB, PLASTIC),
        Piece("nozzle", hull(*NOZZLE), PLASTIC),
        Piece("label", loft(patch((0.022, 0.080), 1.1, 0.0003)), LABEL, solid=False),
        Piece("print", loft(patch((0.052, 0.070), 0.8, 0.0006)), PRINT, solid=False),
        Piece("small_print", loft(patch((0.032, 0.037), 0.6, 0.0006)), PRINT, solid=False),
    ],
)
