"""Points in what a model said, as pixels of the image as it was sent.

Where a pair of numbers lies depends on the profile alone, never on how large the numbers are: 0 to
1000 and pixels cannot be told apart at 640×480. Numbers that the convention does not allow are
refused, not rescaled.

Pixels are those of ``pinhole``: centres at whole numbers, the image of width w from −0.5 to
w − 0.5. A family that tells a share r of the width means the image from edge to edge:
u = r · w − 0.5. One that tells pixels names their centres, in the image that the model sees; where
its server resizes, edges stay edges: u = (x + 0.5) · w / w_seen − 0.5. (Claude's documentation
counts from the corner of the image instead, half a pixel that no model resolves.)
"""

import math
import re
from bisect import bisect_left
from collections.abc import Callable

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.point_formats import Told, find_points
from tog_drake.selectors.vlm.profiles import FitResize, Profile, Resize, SmartResize
from tog_drake.selectors.vlm.question import Points

DRIFT = (
    0.01  # of a side: pixels told no farther outside are moved to the edge, as Qwen2.5-VL drifts
)


def seen_size(resize: Resize | None, size: tuple[int, int]) -> tuple[int, int]:
    """Returns the width and height [pixel] of the image that the model sees, sent in ``size``.

    The rules are those of transformers' ``smart_resize`` for Qwen2.5-VL, and of the page
    "Coordinates and bounding boxes" of Claude's documentation. Claude's images are padded to whole
    patches at right and bottom afterwards, which shifts nothing.
    """
    if isinstance(resize, SmartResize):
        return _smart_resize(resize, size)
    if isinstance(resize, FitResize):
        return _fit(resize, size)
    return size


def read_points(text: str, profile: Profile, points: Points) -> dict[str, tuple[float, float]]:
    """Returns the pixel (u, v) of each role, u from 0 to w − 1 and v from 0 to h − 1.

    A point on the very edge is moved to the centre of its pixel, and so is one told in pixels that
    is off by no more than ``DRIFT``.

    Raises:
        Unanswered: unreadable, empty (the model says that there is none), ambiguous (several points
            for a role, or none that says which role it is for), out_of_range (beyond the scale of
            the family) or off_image (told in pixels, beyond the image).
    """
    told = find_points(text, profile)
    return {
        role: _to_pixel(point, profile, points.size)
        for role, point in _by_role(told, points.roles).items()
    }


def _smart_resize(rule: SmartResize, size: tuple[int, int]) -> tuple[int, int]:
    def multiples(scale: float, rounded: Callable[[float], int]) -> tuple[int, int]:
        w, h = (max(1, rounded(s * scale / rule.factor)) * rule.factor for s in size)
        return w, h

    area = size[0] * size[1]
    seen = multiples(1.0, round)
    if seen[0] * seen[1] > rule.max_pixels:
        return multiples(math.sqrt(rule.max_pixels / area), math.floor)
    if seen[0] * seen[1] < rule.min_pixels:
        return multiples(math.sqrt(rule.min_pixels / area), math.ceil)
    return seen


def _fit(rule: FitResize, size: tuple[int, int]) -> tuple[int, int]:
    """The largest size of the same aspect ratio, and no larger than ``size``, that is allowed."""
    long, short = max(size), min(size)

    def scaled(side: int) -> tuple[int, int]:
        return side, max(1, round(side * short / long))

    def too_large(side: int) -> bool:
        patches = [math.ceil(s / rule.patch) for s in scaled(side)]
        return patches[0] * rule.patch > rule.edge or math.prod(patches) > rule.tokens

    largest = max(1, bisect_left(range(1, long + 1), True, key=too_large))
    seen = scaled(largest)
    return seen if size[0] >= size[1] else (seen[1], seen[0])


def _to_pixel(point: Told, profile: Profile, size: tuple[int, int]) -> tuple[float, float]:
    seen = seen_size(profile.resize, size)
    u, v = (
        _along(*axis, profile.scale) for axis in zip((point.x, point.y), seen, size, strict=True)
    )
    return u, v


def _along(value: float, seen: int, side: int, scale: float | None) -> float:
    """Returns where along one side [pixel] a coordinate is."""
    if scale is not None:
        if not 0.0 <= value <= scale:
            raise Unanswered(
                "out_of_range", f"the coordinate {value:g} is not between 0 and {scale:g}"
            )
        pixel = value / scale * side - 0.5
    else:
        if not -DRIFT * seen <= value + 0.5 <= (1 + DRIFT) * seen:
            raise Unanswered(
                "off_image", f"the coordinate {value:g} is outside the image of {seen} pixels"
            )
        pixel = (value + 0.5) * side / seen - 0.5
    return min(max(pixel, 0.0), side - 1.0)


# Which point is for what


def _by_role(told: list[Told], roles: tuple[str, ...]) -> dict[str, Told]:
    """Returns the one point of each role; with one role it need not be labelled with it, but its
    label must not speak against it."""
    found: dict[str, Told] = {}
    for role in roles:
        labelled = [point for point in told if _names(point.label, role)]
        unlabelled = [point for point in told if not _against(point.label, role)]
        places = {(p.x, p.y): p for p in labelled or (unlabelled if len(roles) == 1 else [])}
        if len(places) > 1:
            raise Unanswered("ambiguous", f"there are {len(places)} points for {role!r}")
        if places:
            found[role] = next(iter(places.values()))
    missing = [role for role in roles if role not in found]
    if missing and len(told) >= len(roles):
        raise Unanswered("ambiguous", f"no point is labelled {' or '.join(missing)}")
    if missing:
        raise Unanswered("unreadable", f"there is no point for {' and '.join(missing)}")
    return found


_OPPOSITE = frozenset(
    {"no", "not", "never", "none", "nothing", "nowhere", "neither", "nor", "don", "dont", "doesn"}
    | {"cannot", "avoid", "except", "keep", "off", "bad", "wrong", "unsafe", "unsuitable"}
    | {"dangerous", "forbidden", "reject"}
)
"""Words of labels for the contrary of a place to grasp; "don" and "doesn" since ' parts words."""
_FILLERS = frozenset({"a", "the", "to", "point", "place", "part", "here", "where", "it", "this"})


def _against(label: str, role: str) -> bool:
    """Whether a label may mean the contrary of a role: "do not grasp here", "no suitable place"."""
    return not _OPPOSITE.isdisjoint(set(re.findall(r"[^\W_]+", label.lower())) - {role.lower()})


def _names(label: str, role: str) -> bool:
    """Whether a label is that of a role: "Grasp", "the point to grasp", "grasp: handle".

    Anything freer could say the opposite ("do not grasp here").
    """
    if _against(label, role):
        return False
    words = re.findall(r"[^\W_]+|[:(]", label.lower())
    if len(words) > 1 and words[0] == role.lower() and not words[1].isalnum():
        return True
    return [word for word in words if word not in _FILLERS] == [role.lower()]
