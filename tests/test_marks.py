from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake.drawing import CANDIDATE_COLORS, hand_wireframe, project_segments
from tog_drake.pinhole import project, unproject
from tog_drake.selectors.discs import RADIUS, contrast, place_discs, text_color
from tog_drake.selectors.marks import (
    BESIDE,
    TILE,
    Framing,
    Mark,
    _unmistakable,
    draw_contacts,
    draw_grippers,
    frame_things,
    plain,
    whole_image,
)
from tog_drake.values import Grasps
from tog_drake.visibility import mark_states

PURE = [Mark(str(i + 1), rgb) for i, (_, rgb) in enumerate(CANDIDATE_COLORS)]


@cache
def bar(width, height):
    view = look([TABLE, HAMMER_SIZED], width=width, height=height)
    return view, unproject(view)[view.rgb[..., 1] == 0][::7]


def world(n=5, width=640, height=480):
    """A view of a bar on a table, the bar's points, and ``n`` grasps across it from above."""
    view, p_W = bar(width, height)
    x = np.linspace(0.41, 0.59, n)
    X_WG = np.tile(np.eye(4), (n, 1, 1))
    X_WG[:, :3, :3] = Rotation.from_euler("xyz", [180, 15, 0], degrees=True).as_matrix()
    X_WG[:, :3, 3] = np.column_stack([x, np.zeros(n), np.full(n, 0.015)])
    contact = np.column_stack([x, np.full(n, -0.015), np.full(n, 0.03)])  # seen
    return view, p_W, Grasps(X_WG, np.full(n, 0.03), np.linspace(0.9, 0.5, n), contact)


@given(
    st.tuples(st.integers(-900, 900), st.integers(-900, 900)),
    st.integers(1, 300),
    st.tuples(st.integers(3, 7), st.integers(3, 7)),
    st.tuples(st.floats(-2000, 2000), st.floats(-2000, 2000)),
)
def test_a_pixel_comes_back_from_any_framing(corner, per_tile, tiles, pixel):
    crop = (per_tile * tiles[0], per_tile * tiles[1])
    framing = Framing(corner, crop, (TILE * tiles[0], TILE * tiles[1]))
    np.testing.assert_allclose(framing.to_view(framing.from_view(pixel)), pixel, atol=1e-8)
    np.testing.assert_allclose(framing.from_view(framing.to_view(pixel)), pixel, atol=1e-8)
    # The outer edges of the crop, half a pixel beyond the centres, are those of the picture.
    np.testing.assert_allclose(framing.from_view(np.array(corner) - 0.5), [-0.5, -0.5], atol=1e-9)


@pytest.mark.parametrize("size", [(640, 480), (1280, 720), (480, 640), (320, 240)])
def test_the_marked_canvas_is_one_that_no_provider_resizes(size):
    view, p_W, grasps = world(width=size[0], height=size[1])
    framing = frame_things(view, p_W, grasps)
    width, height = framing.size
    assert width % 224 == 0 and height % 224 == 0
    assert max(width, height) <= 1568 and min(width, height) <= 768
    assert np.ceil(width / 28) * np.ceil(height / 28) <= 1568
    assert plain(view, framing).shape == (height, width, 3)
    assert framing.crop[0] * height == framing.crop[1] * width  # square pixels
    assert framing.scale <= 224 / 48


@pytest.mark.parametrize("size", [(640, 480), (1280, 720), (480, 640)])
def test_the_things_and_the_fingers_fill_the_marked_picture(size):
    view, p_W, grasps = world(width=size[0], height=size[1])
    framing = frame_things(view, p_W, grasps)
    fingers = project_segments(hand_wireframe(grasps)[:, [0, 2]].reshape(-1, 2, 3), view)
    seen = np.vstack([project(p_W, view.intrinsics, view.X_WC), fingers.reshape(-1, 2)])
    shown = framing.from_view(seen)
    assert (shown >= 0).all() and (shown <= np.array(framing.size) - 1).all()
    assert (np.ptp(shown, axis=0) / framing.size).max() > 0.7


def lower_part(view, rows):
    """What a camera sees that misses the upper rows of a view."""
    camera = view.intrinsics
    return replace(
        view,
        rgb=view.rgb[rows:].copy(),
        depth=view.depth[rows:].copy(),
        intrinsics=replace(camera, height=camera.height - rows, cy=camera.cy - rows),
    )


@pytest.mark.parametrize("rows", [130, 180, 220])
def test_a_hand_that_reaches_beyond_the_view_is_not_cut(rows):
    view, _, grasps = world(4)
    view = lower_part(view, rows)
    p_W = unproject(view)[view.rgb[..., 1] == 0]
    framing = frame_things(view, p_W, grasps)
    hands = project_segments(hand_wireframe(grasps)[:, :3].reshape(-1, 2, 3), view).reshape(-1, 2)
    assert (hands[:, 1] < -10).any()
    shown = framing.from_view(hands)
    assert (shown >= 5).all() and (shown <= np.array(framing.size) - 6).all()
    image = draw_grippers(view, framing, grasps, PURE[:4], "marked")
    assert (plain(view, framing)[0] == BESIDE).all()
    states = mark_states(grasps, view, dots=False)
    assert "shown" in states
    for i in (i for i in range(4) if states[i] == "shown"):  # finger tips: no other hand hides them
        u, v = np.rint(shown.reshape(4, 6, 2)[i, [0, 5]]).astype(int).T
        assert (image[v, u] == PURE[i].color).all()


def test_of_a_hand_whose_palm_and_stem_are_out_of_the_picture_a_finger_is_named():
    view, p_W, grasps = world(2)
    tips = frame_things(view, p_W, grasps.take(np.array([0])))
    palm = project_segments(hand_wireframe(grasps)[0, [1, 3]], view).reshape(-1, 2)
    upper = int(palm[:, 1].max()) + 4  # only what is below is in the picture
    framing = replace(tips, corner=(tips.corner[0], upper))
    hands = framing.from_view(
        project_segments(hand_wireframe(grasps).reshape(-1, 2, 3), view)
    ).reshape(-1, 4, 2, 2)
    assert (hands[0, [1, 3], :, 1] < 0).all() and (hands[0, [0, 2], :, 1] > 0).any()
    _, named = place_discs(
        framing.size,
        _unmistakable(hands, framing.size, apart=8.0),
        lines=hands[:, :3].reshape(-1, 2, 2),
        stems=hands[:, 3],
        things=np.zeros((0, 2)),
        thickness=4.0,
    )
    start, end = hands[0, [0, 2]].transpose(1, 0, 2)
    share = np.clip(
        np.sum((named[0] - start) * (end - start), 1) / np.sum((end - start) ** 2, 1), 0, 1
    )
    off = np.linalg.norm(start + share[:, None] * (end - start) - named[0], axis=1)
    assert off.min() < 1.0


def test_nothing_to_frame_shows_the_whole_view():
    view, _, grasps = world(0)
    framing = frame_things(view, np.zeros((0, 3)), grasps)
    corners = framing.from_view([[0, 0], [639, 479]])
    assert (corners >= 0).all() and (corners <= np.array(framing.size) - 1).all()


@pytest.mark.parametrize(("crop", "corner"), [(60, (33, 17)), (140, (80, 30)), (300, (-90, -210))])
def test_the_picture_shows_each_pixel_where_the_framing_says(crop, corner):
    view, _, _ = world(0)
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    view = replace(view, rgb=np.stack([u / 3, v / 2, 0 * u + 77], axis=-1).round().astype(np.uint8))
    framing = Framing(corner, (4 * crop, 3 * crop), (896, 672))
    x, y = np.meshgrid(np.arange(5, 896, 31), np.arange(5, 672, 31))
    there = framing.to_view(np.stack([x, y], axis=-1).reshape(-1, 2))
    inside = ((there > 4) & (there < [635, 475])).all(axis=1)
    shown = plain(view, framing)[y.ravel(), x.ravel()].astype(float)
    assert inside.any()
    # A value grows by one over three pixels across and two down: this is within 1.5 pixels.
    np.testing.assert_allclose(shown[inside][:, :2], there[inside] / [3, 2], atol=1.0)
    beside = ((there < -4) | (there > [643, 483])).any(axis=1)
    assert (shown[beside] == BESIDE).all()
    assert beside.any() == (crop == 300)


def test_the_whole_image_is_the_view_itself():
    view, _, _ = world(0)
    assert (plain(view, whole_image(view)) == view.rgb).all()


@pytest.mark.parametrize("size", [(640, 480), (1280, 720), (480, 640)])
@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_a_dot_is_drawn_where_the_camera_sees_the_contact(size, rendering):
    view, p_W, grasps = world(3, width=size[0], height=size[1])
    framing = frame_things(view, p_W, grasps) if rendering == "marked" else whole_image(view)
    ground = plain(view, framing)
    for i in range(3):
        one = grasps.take(np.array([i]))
        # Without discs, of whose colour there would be more.
        image = draw_contacts(view, framing, one, PURE[:1], "paper")
        v, u = np.nonzero((image != ground).any(axis=2))
        middle = framing.to_view([(u.min() + u.max()) / 2, (v.min() + v.max()) / 2])
        truth = project(one.p_WContact, view.intrinsics, view.X_WC)[0]
        np.testing.assert_allclose(middle, truth, atol=0.5)


@pytest.mark.parametrize("draw", [draw_grippers, draw_contacts])
def test_discs_and_leaders_hide_neither_fingers_nor_palms_nor_dots(draw, n=12):
    view, p_W, grasps = world(n)
    framing = frame_things(view, p_W, grasps)
    without, image = (draw(view, framing, grasps, PURE[:n], kind) for kind in ("paper", "marked"))
    seen = np.zeros(image.shape[:2], np.uint8)
    if draw is draw_grippers:
        hands = project_segments(hand_wireframe(grasps)[:, :3].reshape(-1, 2, 3), view)
        cv2.polylines(seen, list(framing.from_view(hands).round().astype(np.int32)), False, 1, 3)
    else:
        for contact in framing.from_view(project(grasps.p_WContact, view.intrinsics, view.X_WC)):
            cv2.circle(seen, contact.round().astype(int).tolist(), 9, 1, cv2.FILLED)
    assert seen.any()
    assert (image[seen > 0] == without[seen > 0]).all()


@pytest.mark.parametrize("n", [1, 6])
@pytest.mark.parametrize("draw", [draw_grippers, draw_contacts])
def test_each_label_is_there_and_the_same_input_gives_the_same_picture(draw, n):
    view, p_W, grasps = world(n)
    framing = frame_things(view, p_W, grasps)
    image = draw(view, framing, grasps, PURE[:n], "marked")
    assert (image == draw(view, framing, grasps, PURE[:n], "marked")).all()
    changed = (image != plain(view, framing)).any(axis=2)
    for mark in PURE[:n]:
        there = (image == mark.color).all(axis=2) & changed
        assert there.sum() > 300


@pytest.mark.parametrize("mark", PURE, ids=[name for name, _ in CANDIDATE_COLORS])
def test_the_number_can_be_read_on_its_disc(mark):
    view, p_W, grasps = world(1)
    framing = frame_things(view, p_W, grasps)
    numbered, blank = (
        draw_contacts(view, framing, grasps, [replace(mark, label=label)], "marked")
        for label in (mark.label, "")
    )
    written = (numbered != blank).any(axis=2)
    assert (blank[written] == mark.color).all()  # all of it on the disc's colour
    ink = (numbered[written] == text_color(mark.color)).all(axis=1)
    assert ink.sum() > 25
    v, u = np.nonzero(written)
    assert np.ptp(v) >= 10 and np.hypot(np.ptp(u), np.ptp(v)) < 2 * RADIUS - 8
    assert contrast(text_color(mark.color), mark.color) >= 4.5


def test_contrast_is_that_of_the_guidelines():
    assert contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    assert contrast((118, 118, 118), (255, 255, 255)) == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_of_hands_at_the_same_place_every_colour_is_seen(rendering):
    view, p_W, grasps = world(1)
    three = grasps.take(np.array([0, 0, 0]))
    framing = frame_things(view, p_W, grasps)
    image = draw_grippers(view, framing, three, PURE[1:4], rendering)
    fingers = project_segments(hand_wireframe(grasps)[0, [0, 2]], view)
    for start, end in framing.from_view(fingers):
        u, v = np.rint(np.linspace(start, end, 30)).astype(int).T
        for mark in PURE[1:4]:
            assert (image[v, u] == mark.color).all(axis=1).sum() >= 3


@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_of_dots_at_the_same_place_every_colour_is_seen(rendering):
    view, p_W, grasps = world(1)
    framing = frame_things(view, p_W, grasps)
    three = grasps.take(np.array([0, 0, 0]))
    image = draw_contacts(view, framing, three, PURE[:3], rendering)
    ground = plain(view, framing)
    u, v = framing.from_view(project(grasps.p_WContact, view.intrinsics, view.X_WC))[0].astype(int)
    around = image[v - 70 : v + 71, u - 70 : u + 71].reshape(-1, 3)
    assert ground.shape == image.shape
    for mark in PURE[:3]:
        assert (around == mark.color).all(axis=1).sum() >= 40


def test_the_hand_nearest_to_the_camera_is_on_top():
    view, _, grasps = world(1)
    two = grasps.take(np.array([0, 0]))
    two.X_WG[0, 2, 3] -= 0.002  # the first is farther away
    framing = whole_image(view)
    image = draw_grippers(view, framing, two, PURE[:2], "paper")
    there = [(image == mark.color).all(axis=2).sum() for mark in PURE[:2]]
    assert there[1] > there[0]


def test_the_paper_shows_the_whole_image_without_numbers():
    view, _, grasps = world(3)
    for draw in (draw_grippers, draw_contacts):
        image = draw(view, whole_image(view), grasps, PURE[:3], "paper")
        assert image.shape == view.rgb.shape
        unlabelled = [replace(mark, label="") for mark in PURE[:3]]
        assert (image == draw(view, whole_image(view), grasps, unlabelled, "paper")).all()


def hidden_and_outside(grasps, view):
    """Three grasps: one as it was, one with contacts below the table, one beside the view."""
    X_WG, contact = grasps.X_WG.copy(), grasps.p_WContact.copy()
    for values in (X_WG[:, :3, 3], contact):
        values[1, 2] -= 0.1
        values[2] += [0.0, 2.0, 0.0]
    return replace(grasps, X_WG=X_WG, p_WContact=contact)


@pytest.mark.parametrize("dots", [False, True])
def test_a_mark_is_dashed_where_its_place_is_hidden_and_dropped_where_it_is_outside(dots):
    view, _, grasps = world(3)
    changed = hidden_and_outside(grasps, view)
    assert mark_states(grasps, view, dots=dots) == ("shown", "shown", "shown")
    assert mark_states(changed, view, dots=dots) == ("shown", "dashed", "dropped")


@pytest.mark.parametrize("draw", [draw_grippers, draw_contacts])
@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_a_dashed_mark_shows_its_colour_and_what_is_beneath_it(draw, rendering):
    view, p_W, grasps = world(3)
    grasps = hidden_and_outside(grasps, view)
    framing = whole_image(view) if rendering == "paper" else frame_things(view, p_W, grasps)
    one = grasps.take(np.array([1]))
    dashed = draw(view, framing, one, PURE[1:2], "paper")
    # Without depth nothing is known to be hidden, so the same mark is solid.
    blind = replace(view, depth=np.zeros_like(view.depth))
    solid = draw(blind, framing, one, PURE[1:2], "paper")
    ink, all_ink = ((image == PURE[1].color).all(axis=2) for image in (dashed, solid))
    assert ink.sum() > 40
    assert (ink & all_ink).sum() < 0.75 * all_ink.sum()
    outside = draw(view, framing, grasps.take(np.array([2])), PURE[2:3], rendering)
    np.testing.assert_array_equal(outside, plain(view, framing))
