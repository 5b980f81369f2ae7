"""A pixel told as each family tells it is found again, and nothing that it cannot mean is."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.answers import read
from tog_drake.selectors.vlm.pointing import DRIFT, seen_size
from tog_drake.selectors.vlm.profiles import PROFILES
from tog_drake.selectors.vlm.question import Points

SIZES = ((640, 480), (1280, 720), (720, 960))
SHARES = (0.013, 0.21, 0.3337, 0.5, 0.78, 0.991)  # of a side: where the points of the table are

# What the families' servers make of these sizes, worked out by hand from the published rules:
# Qwen2.5-VL rounds each side to a multiple of 28; Claude's limits are not reached.
QWEN_SEES = {(640, 480): (644, 476), (1280, 720): (1288, 728), (720, 960): (728, 952)}


def _thousandths(u, v, size):
    return round(1000 * (u + 0.5) / size[0]), round(1000 * (v + 0.5) / size[1])


def _shares(u, v, size, digits):
    return round((u + 0.5) / size[0], digits), round((v + 0.5) / size[1], digits)


def _percent(u, v, size):
    return tuple(round(100 * share, 1) for share in _shares(u, v, size, 6))


def _pixels(u, v, size):
    return round(u), round(v)


def _qwen_pixels(u, v, size):
    w, h = QWEN_SEES[size]
    return round((u + 0.5) * w / size[0] - 0.5), round((v + 0.5) * h / size[1] - 0.5)


def _fenced(items):
    return f"```json\n{json.dumps(items)}\n```"


def _items(points, key):
    return [{key: list(point), "label": role} for role, point in points.items()]


def _reasoned(points):
    items = [{"x": x, "y": y, "label": role} for role, (x, y) in points.items()]
    return json.dumps({"reasoning": "The handle, at [7, 9].", "points": items})


def _boxes(points):
    return "".join(
        f"<ref>{role}</ref><box>[[{x - 4}, {y - 6}, {x + 4}, {y + 6}]]</box>"
        for role, (x, y) in points.items()
    )


def _qwen2_boxes(points):
    return "".join(
        f"<|object_ref_start|>{role}<|object_ref_end|>"
        f"<|box_start|>({x - 4},{y - 6}),({x + 4},{y + 6})<|box_end|>"
        for role, (x, y) in points.items()
    )


def _molmo(points):
    return "".join(
        f' <point x="{x}" y="{y}" alt="{role}">{role}</point>' for role, (x, y) in points.items()
    )


def _molmo2(points):
    return " ".join(
        f'<points coords="1 1 {x:03d} {y:03d}">{role}</points>' for role, (x, y) in points.items()
    )


def _tuples(points):
    return "\n".join(f"{role}: [({x}, {y})]" for role, (x, y) in points.items())


def _swapped(points):
    return {role: (y, x) for role, (x, y) in points.items()}


# Profile -> how its models count, and how they write points {role: (x, y)}.
TOLD = {
    "molmo2": (_thousandths, _molmo2),
    "molmo": (_percent, _molmo),
    "robobrain-2.0": (_qwen_pixels, _tuples),
    "qwen2.5-vl": (_qwen_pixels, lambda points: _fenced(_items(points, "point_2d"))),
    "qwen2-vl": (_thousandths, _qwen2_boxes),
    "qwen3-vl": (_thousandths, lambda points: _fenced(_items(points, "point_2d"))),
    "gemini": (_thousandths, lambda points: json.dumps(_items(_swapped(points), "point"))),
    "gemma": (_thousandths, lambda points: _fenced(_items(_swapped(points), "point"))),
    "glm-v": (
        _thousandths,
        lambda points: f"<|begin_of_box|>{json.dumps(_items(points, 'point_2d'))}<|end_of_box|>",
    ),
    "internvl": (_thousandths, _boxes),
    "robopoint": (lambda u, v, size: _shares(u, v, size, 3), _tuples),
    "grok": (_percent, _reasoned),
    "muse": (
        _thousandths,
        lambda points: ", ".join(
            json.dumps({"label": r, "x_min": x, "y_min": y, "x_max": x, "y_max": y})
            for r, (x, y) in points.items()
        ),
    ),
    "gpt-4": (_pixels, lambda points: f"It is here.\n{_fenced(json.loads(_reasoned(points)))}"),
    "gpt-5": (lambda u, v, size: _shares(u, v, size, 3), _reasoned),
    "gpt": (_pixels, _reasoned),
    "claude-high": (_pixels, _reasoned),
    "claude": (_pixels, _reasoned),
    "pixels": (_pixels, _reasoned),
}


def _error(name, size, pixels):
    """How far [pixel] from the truth the points are that a family tells."""
    count, write = TOLD[name]
    said = write({role: count(*pixel, size) for role, pixel in pixels.items()})
    found = read(said, PROFILES[name], Points(tuple(pixels), size))
    return max(
        abs(got - true)
        for role, pixel in pixels.items()
        for got, true in zip(found[role], pixel, strict=True)
    )


def test_every_profile_is_in_the_table():
    assert set(TOLD) == set(PROFILES)


def test_table_of_how_far_from_the_truth_a_told_pixel_lands():
    print("\n| profile | " + " | ".join(f"{w}×{h}" for w, h in SIZES) + " |")
    print("|---|" + "---:|" * len(SIZES))
    for name in PROFILES:
        errors = []
        for size in SIZES:
            places = [(fu * size[0], fv * size[1]) for fu in SHARES for fv in SHARES]
            errors.append(max(_error(name, size, {"grasp": place}) for place in places))
        print(f"| {name} | " + " | ".join(f"{error:.2f}" for error in errors) + " |")
        assert max(errors) < 1.0, name


@pytest.mark.parametrize("name", TOLD)
@pytest.mark.parametrize("size", SIZES)
def test_points_for_two_roles_are_told_apart(name, size):
    w, h = size
    assert _error(name, size, {"grasp": (0.2 * w, 0.7 * h), "avoid": (0.8 * w, 0.4 * h)}) < 1.0


@pytest.mark.parametrize("name", TOLD)
@settings(max_examples=40)
@given(data=st.data())
def test_any_pixel_of_any_image_is_found_again_within_rounding(name, data):
    size = data.draw(st.sampled_from(SIZES))
    u = data.draw(st.floats(6, size[0] - 7))
    v = data.draw(st.floats(9, size[1] - 10))
    assert _error(name, size, {"grasp": (u, v)}) < 1.0


@pytest.mark.parametrize(
    ("name", "sent", "seen"),
    [
        ("qwen2.5-vl", (896, 672), (896, 672)),  # multiples of 224 stay as they are
        ("qwen2.5-vl", (1920, 1080), (1932, 1092)),  # as qwen-vl-utils makes it
        ("qwen2.5-vl", (20, 20), (56, 56)),
        ("claude", (896, 672), (896, 672)),
        ("claude-high", (2000, 1500), (2000, 1500)),
        ("gemini", (1920, 1080), (1920, 1080)),
    ],
)
def test_a_model_sees_the_size_that_its_server_makes(name, sent, seen):
    assert seen_size(PROFILES[name].resize, sent) == seen


def test_the_default_of_transformers_makes_full_hd_as_it_is_published():
    from tog_drake.selectors.vlm.profiles import SmartResize

    assert seen_size(SmartResize(28, 56 * 56, 1280 * 28 * 28), (1920, 1080)) == (1316, 728)


@pytest.mark.parametrize("name", ["claude", "claude-high"])
@given(w=st.integers(1, 5000), h=st.integers(1, 5000))
def test_what_claude_sees_is_the_largest_image_that_its_limits_allow(name, w, h):
    rule = PROFILES[name].resize

    def fits(width, height):
        across, down = -(-width // 28), -(-height // 28)
        return 28 * max(across, down) <= rule.edge and across * down <= rule.tokens

    seen = seen_size(rule, (w, h))
    assert fits(*seen) and seen[0] <= w and seen[1] <= h
    if seen != (w, h):
        long = max(seen) + 1
        other = max(1, round(long * min(w, h) / max(w, h)))
        assert not fits(long, other)


def test_what_claude_tells_of_a_large_image_is_of_the_smaller_one_that_it_sees():
    w, h = seen_size(PROFILES["claude"].resize, (1920, 1080))
    assert (w, h) != (1920, 1080)
    said = json.dumps({"x": (w - 1) / 2, "y": (h - 1) / 2})
    u, v = read(said, PROFILES["claude"], Points(("grasp",), (1920, 1080)))["grasp"]
    assert (u, v) == pytest.approx((959.5, 539.5))


def _status(text, name, size=(640, 480), roles=("grasp",)):
    try:
        read(text, PROFILES[name], Points(roles, size))
    except Unanswered as failure:
        return failure.status
    return "ok"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gemini", '[{"point": [1001, 500]}]'),
        ("gemini", '[{"point": [-1, 500]}]'),
        ("molmo", '<point x="320" y="44.0">handle</point>'),  # pixels, where per cent are meant
        ("molmo2", '<points coords="1 1 1200 300">handle</points>'),
        ("robopoint", "[(320, 240)]"),
        ("robopoint", "[(0.3, 1.01)]"),
        ("gpt-5", '{"x": 320, "y": 240}'),
        ("qwen3-vl", '[{"point_2d": [1003, 40], "label": "grasp"}]'),
    ],
)
def test_a_number_beyond_the_scale_is_refused_not_rescaled(name, said):
    assert _status(said, name) == "out_of_range"


@pytest.mark.parametrize("name", ["pixels", "gpt", "gpt-4", "claude", "claude-high", "qwen2.5-vl"])
def test_a_pixel_told_outside_the_image_is_off_image_but_for_a_little_drift(name):
    w, h = seen_size(PROFILES[name].resize, (640, 480))
    profile, points = PROFILES[name], Points(("grasp",), (640, 480))
    inside = read(
        json.dumps({"x": w + DRIFT * w - 1, "y": -0.5 - DRIFT * h + 0.1}), profile, points
    )
    assert inside == {"grasp": (639, 0)}
    assert _status(json.dumps({"x": w + DRIFT * w, "y": 5}), name) == "off_image"
    assert _status(json.dumps({"x": 5, "y": -0.6 - DRIFT * h}), name) == "off_image"


def test_swapped_coordinates_are_noticed_only_where_they_are_impossible():
    # (600, 100) told as y, x: 600 is below the image.
    assert _status('{"x": 100, "y": 600}', "pixels") == "off_image"
    # (300, 100) told as y, x is a point like any other.
    assert read('{"x": 100, "y": 300}', PROFILES["pixels"], Points(("grasp",), (640, 480))) == {
        "grasp": (100.0, 300.0)
    }


def test_the_same_numbers_are_another_place_in_another_family():
    said, points = '[{"point": [250, 500]}]', Points(("grasp",), (640, 480))
    gemini = read(said, PROFILES["gemini"], points)["grasp"]
    qwen = read(said, PROFILES["qwen3-vl"], points)["grasp"]
    pixels = read(said, PROFILES["pixels"], Points(("grasp",), (640, 600)))["grasp"]
    assert gemini == (319.5, 119.5)
    assert qwen == (159.5, 239.5)
    assert pixels == (250, 500)


@pytest.mark.parametrize(
    "name", [p.name for p in PROFILES.values() if p.scale is not None and "json" in p.formats]
)
def test_the_edges_of_the_scale_are_the_first_and_the_last_pixel(name):
    profile = PROFILES[name]
    points = Points(("grasp",), (640, 480))
    full = profile.scale
    assert read(json.dumps({"x": 0, "y": 0}), profile, points)["grasp"] == (0, 0)
    assert read(json.dumps({"x": full, "y": full}), profile, points)["grasp"] == (639, 479)
