import numpy as np
import things

from tog_drake.selectors.colour import chromaticity, fit
from tog_drake.selectors.segmentation import cut_out, is_heap, segment


def seen(*parts):
    """Points, normals, colours of a cloud of (points, colour) pairs."""
    cloud = things.cloud(*parts)
    return cloud.xyzs().T.astype(float), cloud.normals().T.astype(float), cloud.rgbs().T


def labels(*parts):
    points, _, rgb = seen(*parts)
    return segment(points, chromaticity(rgb))


def test_things_apart_are_told_apart_and_the_largest_comes_first():
    small = things.box((0.0, 0.0, 0.004), (0.05, 0.05, 0.03))
    large = things.box((0.0, 0.10, 0.004), (0.12, 0.16, 0.06))
    label = labels((small, things.RED), (large, things.RED))
    assert label.tolist() == [1] * len(small) + [0] * len(large)


def test_specks_and_what_is_as_flat_as_the_table_are_nothing():
    speck = things.box((0.3, 0.0, 0.004), (0.306, 0.006, 0.015))
    sheet = things.box((0.0, 0.3, 0.004), (0.10, 0.40, 0.006))
    label = labels((things.hammer()[0], things.STEEL), (speck, things.RED), (sheet, things.RED))
    assert (label[: len(things.hammer()[0])] == 0).all()
    assert (label[len(things.hammer()[0]) :] == -1).all()


def test_what_floats_near_a_thing_of_its_colour_is_held_up_by_it():
    body = things.box((0.0, 0.0, 0.004), (0.10, 0.05, 0.05))
    head = things.box((0.13, 0.0, 0.06), (0.16, 0.05, 0.09))  # its neck is hidden
    assert set(labels((body, things.BLUE), (head, things.BLUE)).tolist()) == {0}
    assert set(labels((body, things.BLUE), (head, things.YELLOW)).tolist()) == {0, 1}


def test_one_thing_that_a_hand_could_hold_is_no_heap():
    assert not is_heap(things.hammer()[0])
    assert not is_heap(things.bottle()[0])
    assert is_heap(things.box((0.0, 0.0, 0.004), (0.4, 0.1, 0.05)))


def test_a_thing_of_two_colours_is_cut_out_of_a_heap_whole():
    orange, black, white = (230, 110, 30), (25, 25, 28), (235, 235, 235)
    front = things.box((0.0, 0.0, 0.004), (0.05, 0.05, 0.05))
    grip = things.box((0.053, 0.0, 0.004), (0.10, 0.05, 0.05))
    back = things.box((0.103, 0.0, 0.004), (0.15, 0.05, 0.05))
    ball = things.tube(0.06, 0.004, 0.05, (0.21, 0.025), top=True)  # touches the back in a line
    points, _, rgb = seen((front, orange), (grip, black), (back, orange), (ball, white))
    drill = len(front) + len(grip) + len(back)
    up = np.array([0.0, 0.0, 1.0])
    side = np.column_stack([points[drill:, :2] - [0.21, 0.025], np.zeros(len(ball))])
    normals = np.vstack([np.tile([1.0, 0.0, 0.0], (drill, 1)), side])
    normals[points[:, 2] > 0.048] = up
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    piece = cut_out(points, normals, chromaticity(rgb), fit(rgb, "orange"))
    assert (piece[:drill] == 0).mean() > 0.95
    assert (piece[drill:] == -1).mean() > 0.9


def test_a_leg_whose_upper_end_is_hidden_belongs_to_what_it_stands_under():
    body = things.box((-0.06, -0.03, 0.06), (0.06, 0.03, 0.10))
    leg = things.box((0.03, -0.03, 0.004), (0.05, -0.015, 0.035))
    beside = things.box((0.03, -0.08, 0.004), (0.05, -0.05, 0.035))
    points = np.vstack([body, leg, beside])
    label = segment(points, np.full((len(points), 3), 1 / 3))
    owner = np.repeat([0, 0, 1], [len(body), len(leg), len(beside)])
    assert label.tolist() == owner.tolist()
