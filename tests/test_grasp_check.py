"""The check of anybody's grasps: right ones pass it, and each mistake in a frame is caught."""

from dataclasses import replace

import numpy as np
import pytest
from tabletop import HAMMER_SIZED, TABLE, look
from things import box, cloud, tube

from tog_drake.grasp_check import PROBLEMS, check_grasps, check_image, turned
from tog_drake.panda import GRASP_Z
from tog_drake.scenario import load_scenario
from tog_drake.values import Grasps, View
from tog_drake.world import build_world
from tog_drake.world import look as first_look

HALF = 0.012  # [m]


def seen_as(points, normal):
    """A cloud of points (N, 3) with normals."""
    made = cloud((points, (150, 0, 0)))
    made.mutable_normals()[:] = normal.T
    return made


def normals_of_box(points):
    """Of the face that each point is on; at an edge, of the upper one."""
    low, high = points.min(axis=0), points.max(axis=0)
    outwards = (points == high).astype(float) - (points == low) * [1.0, 1.0, 0.0]
    return np.where(outwards[:, 2:] > 0, [0.0, 0.0, 1.0], outwards * [1.0, 1.0, 0.0])


POINTS = box((-0.10, -HALF, 0.004), (0.10, HALF, 0.031))
BAR = seen_as(POINTS, normals_of_box(POINTS))


def grasp(x=0.0, y=0.0, z=0.024, *, width=2 * HALF, yaw=0.0, contact=None):
    """From above at a place [m], closing along y of W where yaw [rad] is 0."""
    c, s = np.cos(yaw), np.sin(yaw)
    X_WG = np.eye(4)
    X_WG[:3] = [[-c, -s, 0, x], [-s, c, 0, y], [0, 0, -1, z]]
    pad = X_WG[:3, 3] + width / 2 * X_WG[:3, 1] if contact is None else np.array(contact)
    return Grasps(X_WG[None], np.array([width]), np.array([0.9]), pad[None])


def moved(grasps, x=0.0, y=0.0, z=0.0):
    """In their own axes [m]."""
    X_GG = np.eye(4)
    X_GG[:3, 3] = x, y, z
    return replace(grasps, X_WG=grasps.X_WG @ X_GG)


def mirrored(grasps, camera):
    """As if x of the camera's frame pointed the other way."""
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    X_CG = np.linalg.inv(camera) @ grasps.X_WG
    return replace(grasps, X_WG=camera @ mirror @ X_CG @ mirror)


def share_right(grasps, seen):
    problems = check_grasps(grasps, seen)
    assert set(problems) <= set(PROBLEMS)
    return problems.count("") / len(problems)


# -- on a bar whose right grasps are known -------------------------------------------------------


@pytest.mark.parametrize("turn", [0, 180])
def test_a_grasp_across_the_bar_is_right_and_so_is_its_twin(turn):
    assert check_grasps(turned(grasp(), turn), BAR) == [""]


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        (turned(grasp(), 90), "blocked"),
        (turned(grasp(x=0.5), 0), "empty"),
        (moved(grasp(), z=-GRASP_Z), "empty"),
        (moved(grasp(), z=GRASP_Z), "empty"),
        (moved(grasp(), z=0.07), "empty"),
        (moved(grasp(), y=0.010), "width"),
        (grasp(width=0.010), "width"),
        (grasp(width=0.050), "width"),
        (grasp(yaw=np.pi / 4, width=4.3 * HALF), "slanted"),
        (grasp(contact=(0.0, 0.0, 0.030)), "contact"),
        (grasp(contact=(0.05, HALF, 0.024)), "contact"),
        (replace(grasp(), X_WG=grasp().X_WG @ np.diag([1.0, -1, 1, 1])), "skewed"),
        (replace(grasp(), X_WG=2 * grasp().X_WG), "skewed"),
    ],
)
def test_what_is_wrong_with_a_grasp_is_told(wrong, problem):
    assert check_grasps(wrong, BAR) == [problem]


def test_at_the_end_of_the_bar_the_quarter_turn_does_not_fit_either():
    at_end = turned(grasp(x=0.10, width=0.03), 90)
    assert check_grasps(at_end, BAR)[0] in ("width", "blocked")


def test_on_a_round_thing_every_turn_is_right():
    wall = tube(0.02, 0.004, 0.08)
    can = seen_as(wall, wall * [1 / 0.02, 1 / 0.02, 0.0])
    for yaw in np.radians(range(0, 180, 30)):
        assert check_grasps(grasp(z=0.07, width=0.04, yaw=yaw), can) == [""]


def test_the_side_that_the_camera_does_not_see_may_be_missing():
    side = POINTS[POINTS[:, 1] > 0.011]
    assert check_grasps(grasp(), seen_as(side, np.tile([0.0, 1.0, 0.0], (len(side), 1)))) == [""]
    edge = seen_as(side, np.tile([0.0, 0.0, 1.0], (len(side), 1)))  # faces no finger
    assert check_grasps(grasp(), edge) == ["width"]


def test_no_grasps_have_no_problems():
    assert check_grasps(Grasps.empty(), BAR) == []


# -- on what proposers propose -------------------------------------------------------------------


@pytest.fixture(scope="module", params=["Hammer", "Mug"])
def proposed(request):
    """What the wrist camera sees of a built-in object, and what is proposed on it by default; of
    the grasps every third."""
    scenario = load_scenario(request.param)
    world = build_world(scenario)
    context = first_look(world, scenario, "use it").get_context()
    mine = world.pipeline.GetMyContextFromRoot(context)
    view, seen, grasps = (
        world.pipeline.GetOutputPort(name).Eval(mine) for name in ("view", "cloud", "grasps")
    )
    return view, seen, grasps.take(np.arange(0, len(grasps), 3))


def test_most_of_what_the_antipodal_proposer_proposes_is_right(proposed):
    _, seen, grasps = proposed
    assert share_right(grasps, seen) > 0.8
    assert check_grasps(turned(grasps, 180), seen) == check_grasps(grasps, seen)


def test_of_the_same_grasps_with_a_mistake_hardly_any_is_right(proposed):
    view, seen, grasps = proposed
    assert share_right(turned(grasps, 90), seen) < 0.05
    assert share_right(turned(grasps, 45), seen) < 0.2
    assert share_right(moved(grasps, z=-GRASP_Z), seen) == 0
    assert share_right(moved(grasps, z=GRASP_Z), seen) == 0
    assert share_right(mirrored(grasps, view.X_WC), seen) < 0.1


# -- the picture ---------------------------------------------------------------------------------


def test_the_picture_shows_right_grasps_in_green_and_wrong_ones_in_red():
    view = look([TABLE, HAMMER_SIZED])
    blank = View(np.zeros_like(view.rgb), view.depth, view.intrinsics, view.X_WC)
    both = grasp(x=0.5)
    green = check_image(blank, both, [""])
    red = check_image(blank, both, ["empty"])
    assert green[..., 1].max() > 150 and red[..., 0].max() > 150
    assert (green.astype(int)[..., 1] - green[..., 0]).max() > 100
    assert (red.astype(int)[..., 0] - red[..., 1]).max() > 100
    many = both.take(np.zeros(500, np.int64))
    same = check_image(blank, many.take(np.arange(40)), [""] * 40)
    np.testing.assert_array_equal(check_image(blank, many, [""] * 500), same)
