import numpy as np
import pytest
import things
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.yaml import yaml_load_typed
from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoChoice, NoGrasp
from tog_drake.selectors.geometric import Geometric, GeometricSelector
from tog_drake.values import Candidates, Workspace


def select(task, cloud, candidates, *, table=0.0, unresolved="fail"):
    selector = GeometricSelector(Geometric(unresolved=unresolved), Workspace(table_height=table))
    return selector.select(things.view(), cloud, candidates, task)


def choose(task, points, colour=things.STEEL, **policy):
    """The choice among grasps all over one thing, and the point that it holds."""
    choice = select(task, things.cloud((points, colour)), things.candidates(points), **policy)
    return choice, choice.grasp.p_WContact[0]


@given(st.floats(-np.pi, np.pi))
@settings(max_examples=6, deadline=None)
def test_a_hammer_is_used_by_its_handle_and_handed_over_by_its_head(yaw):
    points, is_head = things.hammer()
    points = things.turned(points, yaw)
    for task, at_head in [
        ("use the hammer to drive a nail", False),
        ("hand me the hammer", True),
        ("hand me the hammer by the handle", False),
        ("use the hammer, but hold it by the head", True),
        ("grab the hammer, not by the head", False),
    ]:
        choice, contact = choose(task, points)
        row = np.linalg.norm(points - contact, axis=1).argmin()
        assert (choice.status, is_head[row]) == ("ok", at_head), task


@pytest.mark.parametrize(
    ("task", "on_handle"), [("drink from the mug", True), ("hand me the mug", False)]
)
def test_a_mug_is_used_by_its_handle_and_handed_over_by_its_body(task, on_handle):
    points, _ = things.mug()
    choice, contact = choose(task, points)
    assert choice.status == "ok"
    assert (np.hypot(*contact[:2]) > 0.045) == on_handle
    assert choice.part == ("handle" if on_handle else "body")


def test_a_bottle_is_held_by_the_cap_where_the_task_says_so():
    choice, contact = choose("grab the bottle by the cap", things.bottle()[0])
    assert (choice.status, choice.part) == ("ok", "cap")
    assert contact[2] > 0.15


def test_the_reason_says_what_was_measured_and_the_pixel_where():
    choice, contact = choose("hand me the hammer", things.hammer()[0])
    assert "25 cm long" in choice.reason
    assert "wide portion is the head" in choice.reason
    u, v = choice.pixel
    camera = things.view().intrinsics
    assert u == pytest.approx(camera.cx + camera.fx * contact[0] / (0.8 - contact[2]))
    assert v == pytest.approx(camera.cy - camera.fy * contact[1] / (0.8 - contact[2]))


def test_the_colour_leads_to_the_object_even_past_better_grasps():
    red, blue = things.mug((0.0, 0.0))[0], things.mug((0.0, 0.3))[0]
    both = np.vstack([red, blue])  # the better scores come first: on the red one
    cloud = things.cloud((red, things.RED), (blue, things.BLUE))
    choice = select("hold the blue mug by the handle", cloud, things.candidates(both))
    assert choice.status == "ok"
    assert choice.grasp.p_WContact[0, 1] > 0.2


@pytest.mark.parametrize(
    ("task", "why"),
    [
        ("hammer", "says neither part nor purpose"),
        ("frobnicate the hammer", "not understood: 'frobnicate'"),
        ("hold the hammer by the gizmo", "not understood: 'gizmo'"),
    ],
)
def test_a_task_that_is_not_understood_moves_nothing_unless_asked_to(task, why):
    points, _ = things.hammer()
    with pytest.raises(NoChoice, match=f"{why}.*Understood are: .*handle"):
        choose(task, points)
    choice, _ = choose(task, points, unresolved="top-score")
    assert (choice.index, choice.status, choice.part) == (0, "unresolved", None)
    assert why in choice.reason


def test_a_policy_that_there_is_not_is_refused():
    with pytest.raises(InputError, match="'guess'; valid: fail, top-score"):
        GeometricSelector(Geometric(unresolved="guess"), Workspace())


def test_to_leave_things_alone_is_no_choice_whatever_the_policy():
    for policy in ("fail", "top-score"):
        with pytest.raises(NoChoice, match="leave things alone"):
            choose("don't pick anything up", things.hammer()[0], unresolved=policy)


def test_to_pick_up_is_clear_and_any_part_will_do():
    choice, _ = choose("pick up the hammer", things.hammer()[0])
    assert (choice.index, choice.status) == (0, "ok")


def test_a_part_that_the_shape_does_not_show_is_said_to_be_not_found():
    stick = things.box((-0.1, -0.01, 0.004), (0.1, 0.01, 0.02))
    with pytest.raises(NoChoice, match=r"alike all along.*from another side"):
        choose("use the hammer", stick)
    choice, _ = choose("use the hammer", stick, unresolved="top-score")
    assert (choice.status, choice.part) == ("part_not_found", None)
    assert "any grasp on the object instead" in choice.reason


def test_a_part_without_a_grasp_on_it_is_said_so():
    points, _ = things.hammer()
    cloud = things.cloud((points, things.STEEL))
    far = things.candidates(points[points[:, 0] < 0.05])
    with pytest.raises(NoChoice, match=r"none of .* grasps on the object is there"):
        select("hand me the hammer", cloud, far)
    choice = select("hand me the hammer", cloud, far, unresolved="top-score")
    assert (choice.status, choice.part) == ("no_grasp_on_part", None)


def test_a_part_to_avoid_is_never_held_not_even_for_want_of_another():
    points, is_head = things.hammer()
    cloud = things.cloud((points, things.STEEL))
    with pytest.raises(NoChoice, match="every grasp on it is on its head"):
        select("grab the hammer, not by the head", cloud, things.candidates(points[is_head]))


@pytest.mark.parametrize(
    "task",
    [
        "hand me the hammer by the gizmo without touching the head",
        "hand me the hammer by the trunk without touching the head",
    ],
)
def test_a_part_to_avoid_is_kept_off_where_another_is_not_understood_or_not_found(task):
    points, is_head = things.hammer()
    head_first = points[np.argsort(~is_head, kind="stable")]  # the best scores are on the head
    cloud = things.cloud((points, things.STEEL))
    choice = select(task, cloud, things.candidates(head_first), unresolved="top-score")
    assert choice.status in {"unresolved", "part_not_found"}
    assert choice.grasp.p_WContact[0, 0] < 0.09
    assert "away from its head" in choice.reason
    with pytest.raises(NoChoice, match="every grasp on it is on its head"):
        select(task, cloud, things.candidates(points[is_head]), unresolved="top-score")


@pytest.mark.parametrize("policy", ["fail", "top-score"])
@pytest.mark.parametrize("task", ["grab the hammer, not by the head", "grab it, not by the trunk"])
def test_a_part_to_avoid_that_is_not_found_is_no_choice_whatever_the_policy(task, policy):
    stick = things.box((-0.1, -0.01, 0.004), (0.1, 0.01, 0.02))
    with pytest.raises(NoChoice, match=r"keep off the (head|trunk), and where that is cannot be"):
        choose(task, stick, unresolved=policy)


def test_grasps_on_other_objects_do_not_count():
    red, blue = things.mug((0.0, 0.0))[0], things.mug((0.0, 0.3))[0]
    cloud = things.cloud((red, things.RED), (blue, things.BLUE))
    with pytest.raises(NoGrasp, match=r"none of \d+ feasible grasps is on it"):
        select("grab the blue mug", cloud, things.candidates(red))


def test_without_a_grasp_there_is_no_choice_and_without_a_task_an_input_error():
    with pytest.raises(NoGrasp, match="no feasible grasp"):
        select("grab it", PointCloud(0), Candidates.empty())
    with pytest.raises(InputError, match="no words"):
        select(" ", PointCloud(0), Candidates.empty())


def test_the_order_of_grasps_and_points_does_not_matter():
    points, _ = things.hammer()
    picked = things.candidates(points)
    choice = select("hand me the hammer", things.cloud((points, things.STEEL)), picked)
    rng = np.random.default_rng(3)
    rows = rng.permutation(len(picked.grasps))
    shuffled = Candidates(picked.grasps.take(rows), rows, rows)
    cloud = things.cloud((points[rng.permutation(len(points))], things.STEEL))
    again = select("hand me the hammer", cloud, shuffled)
    assert rows[again.index] == choice.index
    assert again.grasp.p_WContact.tolist() == choice.grasp.p_WContact.tolist()


def test_the_height_of_the_table_is_taken_into_account():
    points, _ = things.mug()
    raised = points + np.array([0, 0, 0.7])
    cloud = things.cloud((raised, things.RED))
    choice = select("drink from the red mug", cloud, things.candidates(raised), table=0.7)
    assert (choice.status, choice.part) == ("ok", "handle")


def test_its_config_is_read_from_yaml():
    config = yaml_load_typed(schema=Geometric, data="{min_on_part: 0.8}")
    assert (config.min_on_part, config.unresolved) == (0.8, "fail")


# What each task is about, in the pixels of a recorded view: (u, v) of a box around it.
RECORDED = [
    ("red_mug_6dof", "hold the red mug by the handle", (240, 185, 410, 345)),
    ("ycb_table_1", "hold the red mug by the handle", (315, 170, 410, 275)),
    ("ycb_table_1", "hand me the white bottle", (405, 140, 565, 350)),
    ("ycb_table_3", "hold the orange drill by the handle", (390, 125, 545, 325)),
    ("graspnet_clutter", "hold the orange drill by the handle", (405, 420, 665, 640)),
    ("ycbvideo_4", "hold the blue pitcher by the handle", (240, 65, 455, 350)),
    ("ycbvideo_4", "grab the yellow bottle by the cap", (335, 235, 440, 450)),
]


@pytest.mark.parametrize(("frame", "task", "box"), RECORDED)
def test_on_a_recorded_view_the_object_that_is_named_is_found(shared_data, frame, task, box):
    from tog_drake.cloud import CloudConfig, scene_cloud
    from tog_drake.pinhole import project
    from tog_drake.selectors.targets import find_target
    from tog_drake.task import read_task

    view, workspace = recorded(shared_data / "rgbd" / frame)
    cloud = scene_cloud([view], workspace, CloudConfig())
    points = cloud.xyzs().T.astype(float)
    found = find_target(
        read_task(task), points, cloud.normals().T.astype(float), cloud.rgbs().T, view.rgb
    )
    u, v = project(points[found.mask], view.intrinsics, view.X_WC).T
    inside = (u > box[0]) & (v > box[1]) & (u < box[2]) & (v < box[3])
    assert found.mask.sum() > 500
    assert inside.mean() > 0.9


def recorded(folder):
    import json
    from dataclasses import replace

    import cv2

    from tog_drake.table import find_table
    from tog_drake.values import Intrinsics, View

    info = json.loads((folder / "info.json").read_text())
    rgb = np.ascontiguousarray(cv2.imread(str(folder / "color.png"))[..., ::-1])
    raw = cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED)
    depth = (raw / info["depth_units_per_metre"]).astype(np.float32)
    k = info["intrinsics"]
    camera = Intrinsics(info["width"], info["height"], k["fx"], k["fy"], k["cx"], k["cy"])
    view = View(rgb, depth, camera, np.eye(4))
    table = find_table(view)
    return replace(view, X_WC=table.X_WC), table.workspace
