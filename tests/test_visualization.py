import base64
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.drawing import hand_wireframe
from tog_drake.panda import GRASP_Z
from tog_drake.values import Candidates, Choice, GraspMotion, Grasps
from tog_drake.visualization import (
    MAX_POINTS,
    _bars,
    draw_decision,
    grasp_path,
    make_meshcat,
    replay_html,
    sketch_of,
)


@pytest.fixture
def meshcat():
    return make_meshcat()


def make_cloud(n):
    cloud = PointCloud(n, Fields(BaseField.kXYZs | BaseField.kRGBs))
    random = np.random.default_rng(0)
    cloud.mutable_xyzs()[:] = random.uniform(-0.2, 0.2, (3, n))
    cloud.mutable_rgbs()[:] = random.integers(0, 256, (3, n))
    return cloud


def make_decision():
    X_WG = np.tile(np.eye(4), (3, 1, 1))
    X_WG[:, 0, 3] = [0.4, 0.5, 0.6]
    grasps = Grasps(X_WG, np.full(3, 0.04), np.array([0.9, 0.8, 0.7]), X_WG[:, :3, 3])
    candidates = Candidates(grasps, np.array([0, 2]), np.array([0, 0, 1]))
    return candidates, Choice(2, grasps.take(np.array([2])), "because")


def make_motion(q0=(0.0,) * 7, q1=(0.0,) * 7):
    arm = PiecewisePolynomial.FirstOrderHold([0.0, 2.0], np.array([q0, q1]).T)
    hand = PiecewisePolynomial(np.array([[0.08]]))
    return GraspMotion(arm, hand, 2.0, {"approach": 0.5, "close": 1.0, "lift": 1.5})


def messages(page):
    """What the page sends to its viewer."""
    found = re.findall(r"data:application/octet-binary;base64,([^\"]*)\"", page)
    return [base64.b64decode(message) for message in found]


def test_meshcat_listens_on_this_machine_only(meshcat):
    port = int(meshcat.web_url().rsplit(":", 1)[1])
    bound = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        if not Path(table).exists():
            pytest.skip("the table of sockets is Linux's")
        for row in Path(table).read_text().splitlines()[1:]:
            address, in_hex = row.split()[1].split(":")
            if row.split()[3] == "0A" and int(in_hex, 16) == port:  # listening
                bound.append(address)
    loopback = {"0100007F", "00000000000000000000000001000000"}
    assert bound and set(bound) <= loopback


def test_all_parts_of_a_decision_are_drawn(meshcat):
    candidates, choice = make_decision()
    draw_decision(
        meshcat, cloud=make_cloud(10), candidates=candidates, choice=choice, motion=make_motion()
    )
    for path in (
        "seen/cloud",
        "seen/grasps",
        "seen/candidates/00_red",
        "seen/candidates/01_green",
        "seen/choice/hand",
        "seen/choice/contact",
        "path",
    ):
        assert meshcat.HasPath(f"/decision/{path}"), path
    assert not meshcat.HasPath("/decision/seen/candidates/02_blue")


def test_the_grasp_that_the_motion_carries_out_is_drawn_in_place_of_the_choice():
    candidates, choice = make_decision()
    alternative = candidates.grasps.take(np.array([1]))
    for motion, grasp in (
        (None, choice.grasp),
        (make_motion(), choice.grasp),
        (replace(make_motion(), grasp=alternative), alternative),
    ):
        sketch = sketch_of(choice=choice, motion=motion)
        np.testing.assert_array_equal(sketch.choice, hand_wireframe(grasp)[0])
        np.testing.assert_array_equal(sketch.contact, grasp.p_WContact)


def test_what_a_failed_stage_left_out_is_not_drawn_nor_left_over(meshcat):
    candidates, choice = make_decision()
    draw_decision(meshcat, candidates=candidates, choice=choice, motion=make_motion())
    draw_decision(meshcat, cloud=make_cloud(10), grasps=Grasps.empty())
    assert meshcat.HasPath("/decision/seen/cloud")
    for path in ("seen/grasps", "seen/candidates", "seen/choice", "path"):
        assert not meshcat.HasPath(f"/decision/{path}"), path
    draw_decision(meshcat)
    assert not meshcat.HasPath("/decision")


def test_a_cloud_without_colors_is_drawn_too(meshcat):
    cloud = PointCloud(5)
    cloud.mutable_xyzs()[:] = 0.1
    draw_decision(meshcat, cloud=cloud)
    assert meshcat.HasPath("/decision/seen/cloud")


def test_the_path_is_that_of_the_grasp_frame():
    q0, q1 = (0.0,) * 7, (np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    # At q = 0 the arm stands upright, the hand 0.088 m before the base and turned downwards.
    z = 0.333 + 0.316 + 0.384 - 0.107 - GRASP_Z
    np.testing.assert_allclose(
        grasp_path(make_motion(q0, q1), samples=2), [[0.088, 0, z], [0, 0.088, z]], atol=1e-12
    )
    X_WL0 = RigidTransform([1.0, 2.0, 3.0]).GetAsMatrix4()
    moved = grasp_path(make_motion(q0, q1), X_WL0, samples=2)
    np.testing.assert_allclose(moved, [[1.088, 2, z + 3], [1, 2.088, z + 3]], atol=1e-12)


def test_a_bar_is_a_closed_box_around_its_segment():
    ends = np.array([[[0.0, 0, 0], [0.3, 0, 0]], [[0.1, 0.2, 0.3], [0.1, 0.5, -0.1]]])
    vertices, faces = _bars(ends, 0.01)
    corners = vertices[faces].reshape(2, 12, 3, 3)
    a, b, c = np.moveaxis(corners, 2, 0)
    volume = (np.cross(a, b) * c).sum(axis=(1, 2)) / 6  # positive if the faces look outwards
    np.testing.assert_allclose(volume, 0.02**2 * (np.array([0.3, 0.5]) + 0.02))
    np.testing.assert_allclose(corners[0].reshape(-1, 3).min(axis=0), [-0.01, -0.01, -0.01])
    np.testing.assert_allclose(corners[0].reshape(-1, 3).max(axis=0), [0.31, 0.01, 0.01])


def test_a_replay_stays_small_however_large_the_cloud(meshcat):
    draw_decision(meshcat, cloud=make_cloud(300_000))
    page = replay_html(meshcat, duration=1.0)
    assert len(page) < 3.0e6
    assert max(map(len, messages(page))) > 12 * 0.5 * MAX_POINTS  # but the cloud is there


def test_a_replay_shows_the_decision_from_when_it_was_made_until_the_hand_closes(meshcat):
    candidates, choice = make_decision()
    meshcat.StartRecording(frames_per_second=10.0)
    meshcat.SetObject("/box", Box(0.1, 0.1, 0.1))
    for t in (0.0, 1.0, 2.0, 3.0):
        meshcat.SetTransform("/box", RigidTransform([t, 0, 0]), t)
    draw_decision(meshcat, candidates=candidates, choice=choice)
    page = replay_html(meshcat, duration=3.0, decided=1.0, closed=2.0)
    (animation,) = (message for message in messages(page) if b"set_animation" in message)
    assert b"/box" in animation and b"/decision" in animation and b"/decision/seen" in animation
    assert animation.count(b".visible") == 2
    # Frames and values of both tracks, as MessagePack writes them: 0xc3 is true, 0xc2 false.
    keys = re.findall(rb"\x82\xa4time(.)\xa5value([\xc2\xc3])", animation, re.DOTALL)
    tracks = [(time[0], value == b"\xc3") for time, value in keys]
    assert sorted(tracks) == sorted(
        [(0, False), (10, True), (30, True), (0, True), (20, False), (30, False)]
    )


def test_a_motion_that_stopped_before_closing_keeps_its_drawing(meshcat):
    draw_decision(meshcat, choice=make_decision()[1])
    meshcat.StartRecording(frames_per_second=10.0)
    page = replay_html(meshcat, duration=3.0, decided=1.0, closed=4.0)
    (animation,) = (message for message in messages(page) if b"set_animation" in message)
    assert b"/decision" in animation and b"/decision/seen" not in animation


def test_a_taken_port_is_an_error(meshcat):
    with pytest.raises(RuntimeError):
        make_meshcat(port=int(meshcat.web_url().rsplit(":", 1)[1]))
