"""What round hollow things share: seen as one round wall, touched as flat segments of it."""

from kit import Piece, ellipse, hull, ring

from tog_drake.values import Array

SEGMENTS = 12  # flat wall segments that take the contact
# Flat segments cut the corner; this much wider, they touch where the round wall is seen.
WIDER = 1.017


def circle(radius: float, z: float) -> Array:
    """A ring of the wall as it is seen."""
    return ring(ellipse(radius, radius, 48), "z", z)


def corners(radius: float, z: float) -> Array:
    """The corners between wall segments; segment i lies between corners i and i + 1."""
    return ring(ellipse(radius, radius, SEGMENTS, phase=-0.5), "z", z)


def wall_and_bottom(
    outer: float, inner: float, height: float, foot: float, thickness: float
) -> list[Piece]:
    """The bottom and the segments of the wall, for contact.

    Args:
        outer, inner: radii of the wall [m].
        height: of the rim [m].
        foot: radius on the table [m].
        thickness: of the bottom [m].
    """
    bottom = Piece("bottom", hull(corners(foot, 0.0), corners(foot, thickness)), drawn=False)
    rings = [corners(r * WIDER, z) for r in (outer, inner) for z in (0.001, height)]
    segments = [hull(*(r[[i, (i + 1) % SEGMENTS]] for r in rings)) for i in range(SEGMENTS)]
    walls = [Piece(f"wall_{i:02d}", wall, drawn=False) for i, wall in enumerate(segments)]
    return [bottom, *walls]
