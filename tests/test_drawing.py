from dataclasses import replace

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tog_drake.drawing import (
    CANDIDATE_COLORS,
    HOLE_COLOR,
    candidate_color,
    decision_image,
    depth_image,
    depth_range,
    draw_grasps,
    encode_png,
    hand_wireframe,
    project_segments,
)
from tog_drake.panda import FINGER_THICKNESS, FINGERTIP_Z, GRASP_Z, PALM_Z
from tog_drake.values import Candidates, Choice, Grasps, Intrinsics, View

GRAY = 128


def make_view(X_WC=None):
    """A gray image of a camera at W's origin, unless told, that looks along z."""
    return View(
        rgb=np.full((480, 640, 3), GRAY, np.uint8),
        depth=np.zeros((480, 640), np.float32),
        intrinsics=Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5),
        X_WC=np.eye(4) if X_WC is None else X_WC,
    )


def make_grasps(positions, across=0.04, R=None):
    """Grasps whose U is ``across`` [m] wide, and whose contacts lie where its arms are."""
    X_WG = np.tile(np.eye(4), (len(positions), 1, 1))
    X_WG[:, :3, 3] = positions
    if R is not None:
        X_WG[:, :3, :3] = R
    n = len(positions)
    contact = X_WG[:, :3, 3] + X_WG[:, :3, 1] * across / 2
    return Grasps(X_WG, np.full(n, across - FINGER_THICKNESS), np.linspace(0.9, 0.5, n), contact)


# Approach along W's x, so that the hand lies flat in the image; closing along W's y.
SIDEWAYS = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])


def pixel(u, v):
    return round(v), round(u)


def test_colors_follow_the_order_of_the_paper_and_differ():
    names = " ".join(name for name, _ in CANDIDATE_COLORS)
    assert names == "red green blue yellow cyan magenta orange purple pink lime brown white"
    colors = np.array([color for _, color in CANDIDATE_COLORS], float)
    apart = np.linalg.norm(colors[:, None] - colors, axis=2) + 1e3 * np.eye(12)
    assert apart.min() > 60
    assert candidate_color(12) == candidate_color(0)


@given(
    st.lists(st.floats(-3, 3), min_size=6, max_size=6),
    st.floats(0.0, 0.08),
)
def test_wireframe_is_a_u_through_the_middle_of_the_fingers_in_any_pose(pose, width):
    R = Rotation.from_rotvec(pose[:3]).as_matrix()
    hand = hand_wireframe(make_grasps([pose[3:]], width + FINGER_THICKNESS, R))[0]
    left, palm, right, stem = (hand - pose[3:]) @ R  # in G
    h = width / 2 + FINGER_THICKNESS / 2
    np.testing.assert_allclose(left, [[0, -h, FINGERTIP_Z], [0, -h, PALM_Z]], atol=1e-12)
    np.testing.assert_allclose(palm, [[0, -h, PALM_Z], [0, h, PALM_Z]], atol=1e-12)
    np.testing.assert_allclose(right, [[0, h, PALM_Z], [0, h, FINGERTIP_Z]], atol=1e-12)
    np.testing.assert_allclose(stem, [[0, 0, PALM_Z], [0, 0, -GRASP_Z]], atol=1e-12)


def test_wireframe_lands_on_the_pixels_worked_out_by_hand():
    hand = hand_wireframe(make_grasps([[0.1, 0, 0.5]], 0.04, SIDEWAYS))[0]
    left, palm, _, stem = project_segments(hand, make_view())
    # u = 600 x / 0.5 + 319.5 with x = 0.1 + z_G; v = 600 y / 0.5 + 239.5.
    tip, back, flange = 1200 * 0.1095 + 319.5, 1200 * 0.0625 + 319.5, 1200 * -0.0034 + 319.5
    np.testing.assert_allclose(left, [[tip, 215.5], [back, 215.5]])
    np.testing.assert_allclose(palm, [[back, 215.5], [back, 263.5]])
    np.testing.assert_allclose(stem, [[back, 239.5], [flange, 239.5]])


def test_wireframe_moves_with_the_pose_of_the_camera():
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("xyz", [2.5, 0.3, -0.7]).as_matrix()
    X_WC[:3, 3] = [0.3, -0.2, 0.6]
    X_CG = np.eye(4)
    X_CG[:3, :3], X_CG[:3, 3] = SIDEWAYS, [0.1, 0, 0.5]
    X_WG = X_WC @ X_CG
    seen = hand_wireframe(make_grasps([X_WG[:3, 3]], 0.04, X_WG[:3, :3]))[0]
    straight = hand_wireframe(make_grasps([[0.1, 0, 0.5]], 0.04, SIDEWAYS))[0]
    np.testing.assert_allclose(
        project_segments(seen, make_view(X_WC)), project_segments(straight, make_view())
    )


def test_segments_are_cut_off_where_they_pass_the_camera():
    front, behind = [0.0, 0.1, 1.0], [0.0, 0.1, -1.0]
    both, other_way, hidden = project_segments(
        np.array([[front, behind], [behind, front], [behind, [0.1, 0, -2]]]), make_view()
    )
    np.testing.assert_allclose(both[0], [319.5, 299.5])
    np.testing.assert_allclose(both[1], [319.5, 239.5 + 600 * 0.1 / 0.02])  # at the near plane
    np.testing.assert_allclose(other_way, both[::-1])
    assert np.isnan(hidden).all()


def test_hands_around_and_behind_the_camera_do_no_harm():
    grasps = make_grasps([[0, 0, 0.0], [0, 0, 0.03], [0.02, 0, -0.5]])
    image = draw_grasps(make_view(), grasps, (255, 0, 0), contacts=True)
    assert image.shape == (480, 640, 3)
    behind = draw_grasps(make_view(), grasps.take(np.array([2])), (255, 0, 0), contacts=True)
    assert (behind == GRAY).all()


def test_lines_have_their_color_within_a_dark_outline():
    view = make_view()
    image = draw_grasps(view, make_grasps([[0.1, 0, 0.5]], 0.04, SIDEWAYS), (255, 0, 0))
    u, v = 425, 215.5  # amid the finger at −y
    column = image[int(v) - 12 : int(v) + 13, u].astype(int)
    assert column[12].tolist() == [255, 0, 0]
    assert column[:12].sum(axis=1).min() < 180  # the ground has 384, the line 255
    assert (column[0] == GRAY).all()
    assert (view.rgb == GRAY).all()  # the view itself is left alone


def test_lines_grow_with_the_image():
    def reddish(scale):
        camera = Intrinsics(640 * scale, 480 * scale, 600.0 * scale, 600.0 * scale, 320, 240)
        view = replace(
            make_view(), rgb=np.zeros((480 * scale, 640 * scale, 3), np.uint8), intrinsics=camera
        )
        image = draw_grasps(view, make_grasps([[0.1, 0, 0.5]], 0.04, SIDEWAYS), (255, 0, 0))
        return (image[..., 0] > 200).mean()

    assert 0.8 < reddish(2) / reddish(1) < 1.25


def test_the_best_grasp_is_drawn_on_top():
    grasps = make_grasps([[0.1, 0, 0.5], [0.1, 0, 0.5]], 0.04, SIDEWAYS)
    image = draw_grasps(make_view(), grasps, [(255, 0, 0), (0, 0, 255)])
    assert image[pixel(425, 215.5)].tolist() == [255, 0, 0]


def test_opacity_mixes_the_lines_with_the_image():
    grasps = make_grasps([[0.1, 0, 0.5]], 0.04, SIDEWAYS)
    image = draw_grasps(make_view(), grasps, (255, 0, 0), opacity=0.25)
    np.testing.assert_allclose(image[pixel(425, 215.5)], [160, 96, 96], atol=1)


def make_decision():
    """Four grasps in a row down the image; the last two are candidates."""
    grasps = make_grasps([[0.1, y, 0.5] for y in (-0.12, -0.04, 0.04, 0.12)], 0.04, SIDEWAYS)
    candidates = Candidates(grasps, np.array([2, 3]), np.array([0, 0, 0, 1]))
    choice = Choice(3, grasps.take(np.array([3])), "because")
    return candidates, choice


def test_the_decision_shows_grasps_faint_candidates_colored_and_the_choice_bold():
    candidates, choice = make_decision()
    image = decision_image(make_view(), candidates, choice).astype(int)
    v = [239.5 + 1200 * y - 24 for y in (-0.12, -0.04, 0.04, 0.12)]  # their fingers at −y
    faint, red, green = (image[pixel(425, v[i])] for i in (0, 2, 3))
    assert np.ptp(faint) == 0 and GRAY < faint[0] < 190
    assert red.tolist() == list(candidate_color(0))
    assert green.tolist() == list(candidate_color(1))

    def thickness(i):
        rows = slice(int(v[i]) - 15, int(v[i]) + 16)
        return (np.abs(image[rows, 425] - candidate_color(i - 2)).sum(axis=1) < 60).sum()

    assert thickness(3) >= thickness(2) + 2


def test_the_choice_has_a_dot_at_its_contact_point():
    candidates, choice = make_decision()
    image = decision_image(make_view(), candidates, choice).astype(int)
    u, v = 1200 * 0.1 + 319.5, 1200 * 0.14 + 239.5
    assert image[pixel(u, v)].tolist() == list(candidate_color(1))
    for angle in np.arange(0, 6):
        ray = [
            image[pixel(u + r * np.cos(angle), v + r * np.sin(angle))].min() for r in range(4, 8)
        ]
        assert max(ray) > 200  # its white ring


def test_where_a_model_points_there_is_a_cross_that_leaves_the_pixel_free():
    candidates, choice = make_decision()
    pointed = replace(choice, pointed={"grasp": (100.0, 120.0), "avoid": (200.0, 120.0)})
    image = decision_image(make_view(), candidates, pointed)
    upright = np.array([[17, 0], [0, 17], [-17, 0], [0, -17]])
    tilted = np.array([[12, 12], [-12, 12], [12, -12], [-12, -12]])
    for center, arms, others in (((100, 120), upright, tilted), ((200, 120), tilted, upright)):
        assert image[pixel(*center)].tolist() == [GRAY] * 3
        assert all(image[pixel(*(center + arm))].max() < 40 for arm in arms)
        assert all(image[pixel(*(center + other))].tolist() == [GRAY] * 3 for other in others)


def test_a_choice_that_is_no_candidate_is_white():
    candidates, _ = make_decision()
    choice = Choice(0, candidates.grasps.take(np.array([0])), "because")
    image = decision_image(make_view(), candidates, choice)
    assert image[pixel(425, 239.5 - 144 - 24)].tolist() == [255, 255, 255]


def test_a_decision_that_was_not_made_leaves_the_image_as_it_is():
    view = make_view()
    assert (decision_image(view) == view.rgb).all()
    none = Candidates(Grasps.empty(), np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert (decision_image(view, none) == view.rgb).all()


def test_depth_is_brighter_the_nearer_it_is_and_holes_stand_out():
    depth = np.tile(np.linspace(0.4, 0.8, 100, dtype=np.float32), (4, 1))
    depth[0, :10], depth[1, :10], depth[2, :10] = 0, np.nan, np.inf
    image = depth_image(depth)
    luminance = image[3].astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) <= 1).all() and luminance[0] - luminance[-1] > 100
    assert (image[:3, :10] == HOLE_COLOR).all()
    assert not (image[3] == HOLE_COLOR).all(axis=1).any()
    near, far = depth_range(depth)
    assert 0.4 <= near < 0.42 and 0.78 < far <= 0.8


def test_depth_that_is_constant_or_all_holes_can_be_shown():
    assert (depth_image(np.zeros((5, 6), np.float32)) == HOLE_COLOR).all()
    assert depth_range(np.zeros((5, 6), np.float32)) is None
    flat = depth_image(np.full((5, 6), 0.5, np.float32))
    assert (flat == flat[0, 0]).all() and not (flat == HOLE_COLOR).all()


def test_png_keeps_every_pixel_and_the_order_of_the_colors():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    png = encode_png(image)
    assert png.startswith(b"\x89PNG")
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert (decoded[..., ::-1] == image).all()
