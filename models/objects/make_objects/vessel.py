"""What round hollow things share: seen as one round wall, touched as flat segments of it."""

from kit import Piece, ellipse, hull, ring

from tog_drake.values import Array

# Flat segments cut the corner. By number of segments: this much wider, they stand out at their
# corners by as much as they fall short between them, and so touch where the round wall is seen.
WIDER = {8: 1.040, 12: 1.017}


def circle(radius: float, z: float) -> Array:
    """A ring of the wall as it is seen."""
    return ring(ellipse(radius, radius, 48), "z", z)


def corners(radius: float, z: float, segments: int = 12) -> Array:
    """The corners between wall segments; segment i lies between corners i and i + 1."""
    return ring(ellipse(radius, radius, segments, phase=-0.5), "z", z)


def wall(
    low: tuple[float, float, float], high: tuple[float, float, float], segments: int = 12
) -> list[Piece]:
    """The segments of a wall, for contact, between two levels (outer radius, inner radius, z)."""
    wider = WIDER[segments]
    rings = [
        corners(radius * wider, z, segments)
        for i in (0, 1)
        for radius, z in ((low[i], low[2]), (high[i], high[2]))
    ]
    slabs = [hull(*(r[[i, (i + 1) % segments]] for r in rings)) for i in range(segments)]
    return [Piece(f"wall_{i:02d}", slab, drawn=False) for i, slab in enumerate(slabs)]


def wall_and_bottom(
    outer: float, inner: float, height: float, foot: float, thickness: float
) -> list[Piece]:
    """The bottom and the segments of a straight wall, for contact.

    Args:
        outer, inner: radii of the wall [m].
        height: of the rim [m].
        foot: radius on the table [m].
        thickness: of the bottom [m].
    """
    bottom = Piece("bottom", hull(corners(foot, 0.0), corners(foot, thickness)), drawn=False)
    return [bottom, *wall((outer, inner, 0.001), (outer, inner, height))]
