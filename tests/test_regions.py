import numpy as np
import pytest

from tog_drake.errors import InputError
from tog_drake.regions import (
    Box,
    Cylinder,
    HalfSpace,
    Region,
    Rest,
    Sphere,
    read_regions,
    region_of,
)

PARTS = ("head", "handle")


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (HalfSpace((0.0, 1.0, 0.0), 0.1), [[5, 0.1, 5], [0, 0.2, 0]], [[0, 0.09, 0]]),
        (Box((-1, 0, 0), (0, 1, 2)), [[-0.5, 0.5, 1.9], [0, 0, 0]], [[0.1, 0.5, 1], [0, 0, -1]]),
        (Sphere((1, 0, 0), 0.5), [[1.4, 0, 0], [1, 0.3, 0.3]], [[1.4, 0.4, 0]]),
        (
            Cylinder((0, 0, 1), (0, 2, 1), 0.5),
            [[0, 1, 1.4], [0.4, 0, 1], [0.3, 2, 1.3]],
            [[0, 1, 1.6], [0, -0.1, 1], [0, 2.1, 1], [0.4, 1, 1.4]],
        ),
        (Rest(), [[9, 9, 9]], np.empty((0, 3))),
    ],
)
def test_a_shape_tells_inside_from_outside(shape, inside, outside):
    assert shape.contains(np.array(inside, float)).all()
    assert not shape.contains(np.array(outside, float)).any()


def test_a_half_space_begins_at_its_offset_whatever_the_length_of_its_normal():
    (region,) = read_regions(
        [{"part": "head", "half_space": {"normal": [0, 0, 5], "offset": 0.1}}], ["head"]
    )
    assert region_of((region,), np.array([[0, 0, 0.11], [0, 0, 0.09]])).tolist() == [0, -1]


def test_the_first_region_that_holds_a_point_gives_its_part():
    regions = (
        Region("head", Sphere((0, 0, 0), 1.0)),
        Region("handle", Sphere((0, 0, 0), 2.0)),
        Region("head", Box((0, 0, 0), (5, 5, 5))),
    )
    points = np.array([[0.5, 0, 0], [1.5, 0, 0], [4.0, 1, 1], [-4.0, 0, 0]])
    assert region_of(regions, points).tolist() == [0, 1, 2, -1]


def test_regions_are_read_in_their_order():
    text = [
        {"part": "head", "box": {"min": [0, 0, 0], "max": [1, 1, 1]}},
        {"part": "head", "cylinder": {"from": [0, 0, 0], "to": [0, 0, 1], "radius": 0.1}},
        {"part": "handle", "sphere": {"center": [0, 0, 1], "radius": 0.1}},
        {"part": "handle"},
    ]
    assert [type(r.shape) for r in read_regions(text, PARTS)] == [Box, Cylinder, Sphere, Rest]


@pytest.mark.parametrize(
    ("regions", "message"),
    [
        ([], "a list of 1 to 100 regions"),
        ("head", "a list of 1 to 100 regions"),
        ([{"part": "head"}] * 101, "a list of 1 to 100 regions"),
        ([{"part": "hed"}], "part 'hed' is none of head, handle"),
        ([{"part": ["head"]}], "is none of head, handle"),
        (["head"], r"regions\[0\] must have a part and at most one of half_space, box"),
        ([{"part": "head", "cone": {}}], "at most one of half_space, box, cylinder, sphere"),
        ([{"part": "head"}, {"part": "handle"}], r"regions\[0\] has no shape.*put it last"),
        ([{"part": "head"}], "no region belongs to the part handle"),
        ([{"part": "head", "sphere": {"center": [0, 0, 0]}}], "sphere must have center and radius"),
        ([{"part": "head", "sphere": {"center": [0, 0], "radius": 1}}], "must be three numbers"),
        ([{"part": "head", "sphere": {"center": [0, 0, 0], "radius": 0}}], "must be above 0"),
        ([{"part": "head", "sphere": {"center": [0, 0, 0], "radius": "1"}}], "must be a number"),
        (
            [{"part": "head", "sphere": {"center": [0, 0, float("nan")], "radius": 1}}],
            "must be three numbers from -10 to 10",
        ),
        (
            [{"part": "head", "half_space": {"normal": [0, 0, 0], "offset": 0}}],
            "normal must not be zero",
        ),
        ([{"part": "head", "box": {"min": [0, 0, 0], "max": [1, 0, 1]}}], "below that of max"),
        (
            [{"part": "head", "cylinder": {"from": [0, 0, 0], "to": [0, 0, 0], "radius": 1}}],
            "must be two points",
        ),
    ],
)
def test_what_is_wrong_with_regions_is_said_with_what_would_be_right(regions, message):
    with pytest.raises(InputError, match=message):
        read_regions(regions, PARTS)
