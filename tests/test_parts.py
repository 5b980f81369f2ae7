import numpy as np
import pytest
import things
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.lexicon import LEXICON
from tog_drake.points import group_means, voxel_numbers
from tog_drake.selectors.parts import PartNotFound, find_part, rule_of

YAW = st.floats(-np.pi, np.pi)


def overlap(mask, truth):
    """Intersection over union."""
    return (mask & truth).sum() / (mask | truth).sum()


@given(YAW)
@settings(max_examples=20, deadline=None)
def test_a_hammers_head_is_its_wide_end_whichever_way_it_lies(yaw):
    points, is_head = things.hammer()
    points = things.turned(points, yaw)
    head = find_part(points, "head", LEXICON.rules["hammer"])
    handle = find_part(points, "handle", LEXICON.rules["hammer"])
    assert overlap(head.mask, is_head) > 0.85
    assert overlap(handle.mask, ~is_head) > 0.85
    assert "wide portion is the head" in head.how


@given(YAW)
@settings(max_examples=20, deadline=None)
def test_a_screwdrivers_handle_is_its_wide_end(yaw):
    points, is_shaft = things.screwdriver()
    points = things.turned(points, yaw)
    assert overlap(find_part(points, "shaft", LEXICON.rules["screwdriver"]).mask, is_shaft) > 0.8
    assert overlap(find_part(points, "handle", LEXICON.rules["screwdriver"]).mask, ~is_shaft) > 0.9


@given(YAW)
@settings(max_examples=20, deadline=None)
def test_a_mugs_handle_is_what_sticks_out_of_the_round_body(yaw):
    points, is_handle = things.mug()
    points = things.turned(points, yaw, (0.5, 0.1))
    handle = find_part(points, "handle", LEXICON.rules["mug"]).mask
    assert handle.sum() > 0.5 * is_handle.sum()
    assert not (handle & ~is_handle).any()
    assert overlap(find_part(points, "body", LEXICON.rules["mug"]).mask, ~is_handle) > 0.9


def test_the_rim_of_a_mug_is_its_upper_edge_without_the_handle():
    points, is_handle = things.mug()
    rim = find_part(points, "rim", LEXICON.rules["mug"]).mask
    assert points[rim, 2].min() > 0.06
    assert not (rim & is_handle & (points[:, 0] > 0.05)).any()


@pytest.mark.parametrize("lying", [False, True])
def test_a_bottles_cap_is_what_is_beyond_its_neck(lying):
    points, is_cap = things.bottle()
    if lying:
        points = points[:, [2, 1, 0]] + [0, 0, 0.04]
    assert overlap(find_part(points, "cap", LEXICON.rules["bottle"]).mask, is_cap) > 0.7
    assert overlap(find_part(points, "body", LEXICON.rules["bottle"]).mask, ~is_cap) > 0.9


@pytest.mark.parametrize("standing", [False, True])
def test_a_drills_handle_is_the_bridge_between_two_bulks(standing):
    body = things.box((-0.09, 0.05, 0.004), (0.09, 0.10, 0.05))
    grip = things.box((0.0, -0.05, 0.010), (0.03, 0.05, 0.04))
    base = things.box((-0.03, -0.10, 0.004), (0.06, -0.05, 0.05))
    points = np.vstack([body, grip, base])
    truth = np.repeat([False, True, False], [len(body), len(grip), len(base)])
    if standing:
        points = points[:, [0, 2, 1]] + [0, 0, 0.104]
    handle = find_part(points, "handle", LEXICON.rules["drill"]).mask
    assert overlap(handle, truth) > 0.6
    assert find_part(points, "body", LEXICON.rules["drill"]).mask[truth].mean() < 0.25


def dinosaur():
    """Along x: a high head, a neck, a thick body on legs and a low tail that tapers."""
    parts = {
        "head": things.box((-0.13, -0.015, 0.10), (-0.09, 0.015, 0.13)),
        "neck": things.box((-0.09, -0.012, 0.05), (-0.05, 0.012, 0.09)),
        "body": things.box((-0.05, -0.03, 0.04), (0.05, 0.03, 0.08)),
        "leg": things.box((-0.03, -0.03, 0.004), (0.03, -0.02, 0.04)),
        "tail": np.vstack(
            [
                things.box((x, -(0.14 - x) / 5, 0.04), (x + 0.01, (0.14 - x) / 5, 0.06))
                for x in np.arange(0.05, 0.13, 0.01)
            ]
        ),
    }
    names = np.repeat(list(parts), [len(p) for p in parts.values()])
    return np.vstack(list(parts.values())), names


@pytest.mark.parametrize("yaw", [0.0, 1.0, 2.5, 4.0])
def test_an_animals_head_is_high_and_its_tail_tapers(yaw):
    points, names = dinosaur()
    points = things.turned(points, yaw)
    for part in ("head", "tail", "body", "leg"):
        found = find_part(points, part, LEXICON.rules["dinosaur"]).mask
        assert (names[found] == part).mean() > 0.75, part
        assert found.sum() > 0.5 * (names == part).sum(), part


def test_a_whisks_handle_ends_at_its_waist_not_where_the_wires_are_half_as_wide():
    handle = things.box((-0.14, -0.012, 0.004), (0.0, 0.012, 0.026))
    steps = np.arange(0.0, 0.10, 0.005)
    wires = [
        things.box((x, -0.008 - 0.22 * x, 0.004), (x + 0.005, 0.008 + 0.22 * x, 0.03))
        for x in steps
    ]
    end = things.box((0.10, -0.03, 0.004), (0.14, 0.03, 0.03))
    points = np.vstack([handle, *wires, end])
    found = find_part(points, "handle", LEXICON.rules["whisk"]).mask
    assert points[found, 0].max() < 0.01
    assert found.sum() > 0.8 * len(handle)


def test_a_knifes_blade_is_its_flat_end_though_it_is_the_wider_one():
    handle = things.box((-0.12, -0.012, 0.004), (0.0, 0.012, 0.02))
    blade = things.box((0.0, -0.018, 0.004), (0.15, 0.018, 0.007))
    points, truth = np.vstack([handle, blade]), np.repeat([False, True], [len(handle), len(blade)])
    assert overlap(find_part(points, "blade", LEXICON.rules["knife"]).mask, truth) > 0.85
    assert overlap(find_part(points, "handle", LEXICON.rules["knife"]).mask, ~truth) > 0.85


@pytest.mark.parametrize("voxel", [0.002, 0.003, 0.005])
def test_a_pots_long_handle_is_no_reason_to_miss_its_body(voxel):
    body = things.tube(0.033, 0.004, 0.055)
    handle = things.box((0.033, -0.011, 0.045), (0.15, 0.011, 0.06))
    points = np.vstack([body, handle])
    points = group_means(voxel_numbers(points, voxel), points)
    truth = points[:, 0] > 0.036
    assert overlap(find_part(points, "handle", LEXICON.rules["pot"]).mask, truth) > 0.85
    assert overlap(find_part(points, "body", LEXICON.rules["pot"]).mask, ~truth) > 0.85


def test_an_umbrellas_tip_is_the_narrow_end_of_its_cloth_and_no_handle():
    grip = things.box((-0.15, -0.016, 0.004), (-0.06, 0.016, 0.036))
    cloth = things.box((-0.06, -0.026, 0.004), (0.13, 0.026, 0.056))
    tip = things.box((0.13, -0.007, 0.02), (0.15, 0.007, 0.034))
    points = np.vstack([grip, cloth, tip])
    names = np.repeat(["handle", "body", "tip"], [len(grip), len(cloth), len(tip)])
    for part in ("handle", "tip"):
        found = find_part(points, part, LEXICON.rules["umbrella"]).mask
        assert (names[found] == part).mean() > 0.9, part


def test_an_elephants_trunk_is_low_and_thin_before_its_high_head():
    parts = {
        "body": things.box((-0.08, -0.035, 0.05), (0.02, 0.035, 0.09)),
        "leg": things.box((-0.07, -0.03, 0.004), (-0.05, -0.01, 0.05)),
        "head": things.box((0.02, -0.03, 0.06), (0.065, 0.03, 0.115)),
        "trunk": things.box((0.065, -0.008, 0.02), (0.12, 0.008, 0.05)),
    }
    names = np.repeat(list(parts), [len(p) for p in parts.values()])
    points = np.vstack(list(parts.values()))
    for part in parts:
        found = find_part(points, part, LEXICON.rules["elephant"]).mask
        assert (names[found] == part).mean() > 0.75, part
        assert found.sum() > 0.5 * (names == part).sum(), part
    with pytest.raises(PartNotFound, match="trunk is hidden"):
        find_part(dinosaur()[0], "trunk", LEXICON.rules["dinosaur"])


def test_what_the_shape_does_not_show_is_said():
    stick = things.box((-0.1, -0.01, 0.004), (0.1, 0.01, 0.02))
    with pytest.raises(PartNotFound, match="20 cm long and alike all along"):
        find_part(stick, "handle", LEXICON.rules["hammer"])
    with pytest.raises(PartNotFound, match="nothing sticks out"):
        find_part(things.tube(0.04, 0.004, 0.09), "handle", LEXICON.rules["mug"])
    with pytest.raises(PartNotFound, match="a long tool shows no tail"):
        find_part(things.hammer()[0], "tail", LEXICON.rules["hammer"])
    with pytest.raises(PartNotFound, match="two bulky portions"):
        find_part(things.tube(0.04, 0.004, 0.09, top=True), "handle", LEXICON.rules["drill"])
    with pytest.raises(PartNotFound, match="only 5 points"):
        find_part(stick[:5], "handle", LEXICON.rules["hammer"])


def test_a_block_is_like_nothing_that_has_parts():
    block = things.box((-0.04, -0.04, 0.004), (0.04, 0.04, 0.06))
    with pytest.raises(PartNotFound, match="neither long, nor round"):
        rule_of((), block)


@pytest.mark.parametrize(
    ("thing", "kind"),
    [(things.hammer, "tool"), (things.mug, "vessel"), (things.bottle, "bottle")],
)
def test_without_a_noun_the_kind_is_read_off_the_shape(thing, kind):
    rule, how = rule_of(("gizmo",), thing()[0])
    assert rule.kind == kind
    assert kind in how
