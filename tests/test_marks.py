import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.pinhole import unproject
from tog_drake.selectors.marks import (
    TILE,
    Framing,
    Mark,
    contrast,
    draw_contacts,
    draw_grippers,
    frame_things,
    plain,
    text_color,
)
from tog_drake.values import Grasps

PURE = [Mark(str(i + 1), rgb) for i, (_, rgb) in enumerate(CANDIDATE_COLORS)]


def world(n=5, width=640, height=480):
    """A view of a bar on a table, the bar's points, and ``n`` grasps across it from above."""
    view = look([TABLE, HAMMER_SIZED], width=width, height=height)
    p_W = unproject(view)[view.rgb[..., 1] == 0][::7]
    x = np.linspace(0.41, 0.59, n)
    X_WG = np.tile(np.eye(4), (n, 1, 1))
    X_WG[:, :3, :3] = Rotation.from_euler("xyz", [180, 15, 0], degrees=True).as_matrix()
    X_WG[:, :3, 3] = np.column_stack([x, np.zeros(n), np.full(n, 0.015)])
    contact = np.column_stack([x, np.full(n, -0.015), np.full(n, 0.015)])
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


@pytest.mark.parametrize("n", [1, 5, 12])
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


def test_text_can_be_read_on_every_colour():
    assert contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    for _, rgb in CANDIDATE_COLORS:
        assert contrast(text_color(rgb), rgb) >= 4.5
