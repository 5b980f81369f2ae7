"""What the robot can carry out, and for which reason it cannot."""

from functools import cache

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import LoadModelDirectivesFromString
from pydrake.perception import PointCloud
from tabletop import RED, TABLE, look

from tog_drake.errors import NoFeasibleGrasp, NoGrasp
from tog_drake.feasibility import REASONS, FeasibilityConfig, FeasibilityFilter, feasible_grasps
from tog_drake.panda import MAX_OPENING, Q_LOWER, Q_UPPER
from tog_drake.planning_model import MakePlanningModel
from tog_drake.values import FeasibleGrasps, Grasps, View, Workspace
from tog_drake.visibility import hidden_share

CONFIG = FeasibilityConfig()
Q_NOW = np.array([0.0, -0.2, 0.0, -2.0, 0.0, 1.8, 0.785])
DOWN = [0.0, 0.0, -1.0]


@cache
def planning_model():
    return MakePlanningModel()


def pose(p, approach=DOWN, closing=(0.0, 1.0, 0.0)):
    """X_WG at p; the closing direction is made perpendicular to the approach."""
    z = np.array(approach) / np.linalg.norm(approach)
    x = np.cross(closing, z)
    x /= np.linalg.norm(x)
    X = np.eye(4)
    X[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    X[:3, 3] = p
    return X


def make_grasps(*poses, width=0.03):
    X_WG = np.array(poses)
    count = len(X_WG)
    return Grasps(X_WG, np.full(count, width), np.linspace(1, 0.5, count), X_WG[:, :3, 3])


def make_cloud(*blocks):
    """Points 4 mm apart in boxes, each given by two corners."""
    points = np.concatenate(
        [
            np.stack(
                np.meshgrid(*(np.arange(a, b, 0.004) for a, b in zip(*block, strict=True))), axis=-1
            ).reshape(-1, 3)
            for block in blocks
        ]
        or [np.zeros((0, 3))]
    )
    cloud = PointCloud(len(points))
    cloud.mutable_xyzs()[:] = points.T
    return cloud


def solve(grasps, cloud=None, config=CONFIG, q_now=Q_NOW):
    return feasible_grasps(grasps, cloud or make_cloud(), q_now, planning_model(), config)


def only_reason(grasps, cloud=None, config=CONFIG):
    """The one reason for which all grasps are rejected."""
    with pytest.raises(NoFeasibleGrasp) as error:
        solve(grasps, cloud, config)
    assert list(error.value.rejected) == list(REASONS)
    reasons = [reason for reason, count in error.value.rejected.items() if count]
    assert sum(error.value.rejected.values()) == len(grasps)
    assert len(reasons) == 1
    assert REASONS[reasons[0]] in str(error.value)
    return reasons[0]


def test_a_grasp_like_one_that_failed_is_rejected_also_when_turned_by_half_a_turn():
    tried = make_grasps(pose([0.5, 0.0, 0.02]))
    again = make_grasps(
        pose([0.5, 0.0, 0.02]),
        pose([0.5, 0.02, 0.02], closing=(0, -1, 0.0)),
        pose([0.5, 0.0, 0.02], closing=(1, 0, 0.0)),
        pose([0.55, 0.0, 0.02]),
    )
    result = feasible_grasps(again, make_cloud(), Q_NOW, planning_model(), CONFIG, failed=tried)
    assert result.rejected["failed_before"] == 2
    np.testing.assert_allclose(result.score, again.score[2:])


def random_grasps(count, seed):
    """Tilted up to 60°, above the table, some too low and some too far."""
    rng = np.random.default_rng(seed)
    tilt, around = rng.uniform(0, np.pi / 3, count), rng.uniform(-np.pi, np.pi, count)
    z = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), -np.cos(tilt)])
    p = rng.uniform([0.35, -0.3, 0.0], [0.75, 0.3, 0.2], (count, 3))
    closing = rng.normal(size=(count, 3))
    return make_grasps(*(pose(*row) for row in zip(p, z.T, closing, strict=True)))


HANDLE = ([0.40, -0.014, 0.0], [0.62, 0.014, 0.03])
WALL = ([0.42, 0.10, 0.0], [0.60, 0.13, 0.25])


def test_a_grasp_straight_down_in_front_of_the_robot_is_feasible():
    result = solve(make_grasps(pose([0.5, 0.0, 0.02])), make_cloud(HANDLE))
    assert len(result) == 1
    assert result.rejected == dict.fromkeys(REASONS, 0)
    assert result.q_approach.shape == (1, CONFIG.approach_points, 7)
    assert result.q_lift.shape == (1, CONFIG.lift_points, 7)


def test_a_grasp_far_away_has_no_ik():
    assert only_reason(make_grasps(pose([1.2, 0.0, 0.1]))) == "no_ik"


def test_fingers_inside_a_wall_of_points_are_a_hand_collision():
    cloud = make_cloud(([0.42, 0.02, 0.0], [0.58, 0.06, 0.10]))
    assert only_reason(make_grasps(pose([0.5, 0.0, 0.05])), cloud) == "hand_collision"


def test_a_hand_that_arrives_fully_open_needs_the_room_that_a_narrower_one_does_not():
    thin = ([0.40, -0.01, 0.0], [0.62, 0.01, 0.03])
    beside = make_cloud(thin, ([0.45, 0.051, 0.0], [0.55, 0.054, 0.045]))
    grasp = make_grasps(pose([0.5, 0.0, 0.02]), width=0.02)  # a finger ends at y = 45 or 55 mm
    assert len(solve(grasp, beside)) == 1
    with pytest.raises(NoFeasibleGrasp) as error:
        feasible_grasps(grasp, beside, Q_NOW, planning_model(), CONFIG, opens_fully=True)
    assert error.value.rejected["hand_collision"] == 1


def test_points_between_the_fingers_are_the_target():
    cloud = make_cloud(([0.48, -0.03, 0.0], [0.52, 0.03, 0.06]))
    assert len(solve(make_grasps(pose([0.5, 0.0, 0.03]), width=0.06), cloud)) == 1


def test_a_few_stray_points_inside_the_hand_are_forgiven():
    cloud = PointCloud(2)
    cloud.mutable_xyzs()[:] = np.array([[0.5, 0.04, 0.05], [0.5, -0.04, 0.05]]).T
    assert len(solve(make_grasps(pose([0.5, 0.0, 0.05])), cloud)) == 1
    strict = FeasibilityConfig(stray_points=1)
    assert only_reason(make_grasps(pose([0.5, 0.0, 0.05])), cloud, strict) == "hand_collision"


def test_a_shelf_that_only_the_backed_off_hand_meets_is_a_hand_collision():
    shelf = make_cloud(([0.47, -0.05, 0.27], [0.53, 0.05, 0.29]))
    grasp = make_grasps(pose([0.5, 0.0, 0.02]))
    assert only_reason(grasp, shelf) == "hand_collision"
    # With less backing off, it is above the hand's boxes.
    lower = make_cloud(([0.47, -0.05, 0.29], [0.53, 0.05, 0.30]))
    assert only_reason(grasp, lower, FeasibilityConfig(pregrasp_distance=0.02)) != "hand_collision"


def test_a_hand_that_would_close_on_or_rise_into_another_thing_disturbs_others():
    target = ([0.45, -0.015, 0.0], [0.55, 0.015, 0.06])
    grasp = make_grasps(pose([0.5, 0.0, 0.04]))
    beside = ([0.49, 0.024, 0.02], [0.51, 0.028, 0.06])  # between the target and a finger
    shelf = ([0.49, -0.10, 0.275], [0.51, -0.09, 0.295])  # over the hand's wide side
    for other in (beside, shelf):
        assert only_reason(grasp, make_cloud(target, other)) == "disturbs_others"
    # What is held goes up with the hand, though it is as wide as the hand's way up.
    stem = ([0.445, -0.01, 0.06], [0.46, 0.01, 0.09])
    crown = ([0.45, -0.035, 0.09], [0.47, 0.035, 0.10])
    assert len(solve(grasp, make_cloud(target, stem, crown))) == 1


def test_a_finger_behind_the_one_face_that_was_seen_of_something_is_hidden():
    view = look([TABLE, ((0.45, -0.03, 0.0), (0.55, 0.03, 0.1), RED)], eye=(0.1, 0.0, 0.15))
    # From the side, across the seen face as if it were a sheet: a finger would enter the block.
    sheet = pose([0.455, 0.02, 0.06], [0.0, -1.0, -0.3], (1.0, 0.0, 0.0))
    across = pose([0.50, 0.0, 0.09])
    X_WG, width = np.array([sheet, across]), np.array([0.01, 0.06])
    share = hidden_share(X_WG, width + 0.02, [view])
    assert share[0] > 0.5
    assert share[1] < 0.2
    grasps = Grasps(X_WG, width, np.ones(2), X_WG[:, :3, 3])
    kept = feasible_grasps(grasps, make_cloud(), Q_NOW, planning_model(), CONFIG, views=[view])
    assert kept.rejected["hidden"] == 1
    np.testing.assert_array_equal(kept.width, [0.06])


def test_a_place_is_hidden_only_if_no_view_sees_it():
    block = ((0.45, -0.03, 0.0), (0.55, 0.03, 0.1), RED)
    front, behind = (look([TABLE, block], eye=(x, 0.0, 0.15)) for x in (0.1, 0.9))
    finger = pose([0.60, 0.0, 0.05], closing=(1.0, 0.0, 0.0))[None]  # beyond the block
    opening = np.array([0.03])
    assert hidden_share(finger, opening, [front]) > 0.5
    assert hidden_share(finger, opening, [behind]) == 0
    assert hidden_share(finger, opening, [front, behind]) == 0
    # In a view that does not show the place, nothing is learnt of it.
    away = look([TABLE, block], eye=(0.6, 0.0, 0.3), target=(0.6, 0.8, 0.0))
    assert hidden_share(finger, opening, [away]) == 0
    assert hidden_share(finger, opening, [front, away]) == hidden_share(finger, opening, [front])
    assert hidden_share(finger, opening, []) == 0


def test_an_object_wider_than_the_hand_opens_is_a_hand_collision():
    grasp = make_grasps(pose([0.5, 0.0, 0.05]), width=MAX_OPENING + 0.01)
    assert only_reason(grasp) == "hand_collision"


@pytest.mark.parametrize(
    "X_WG",
    [
        pose([0.5, 0.0, 0.008]),  # the fingers end 9.5 mm beyond G
        pose([0.5, 0.0, 0.03], approach=[1.0, 0.0, 0.0]),  # the palm is wide
        pose([0.5, 0.0, 0.30], approach=[0.0, 0.0, 1.0]),  # from below
    ],
)
def test_a_hand_in_the_table_is_a_table_collision(X_WG):
    assert only_reason(make_grasps(X_WG)) == "table_collision"


def test_the_table_height_counts():
    grasp = make_grasps(pose([0.5, 0.0, 0.05]))
    with pytest.raises(NoFeasibleGrasp) as error:
        feasible_grasps(grasp, make_cloud(), Q_NOW, planning_model(), CONFIG, table_height=0.045)
    assert error.value.rejected["table_collision"] == 1


def test_too_long_a_retreat_or_lift_has_its_own_reason():
    grasp = make_grasps(pose([0.5, 0.0, 0.05]))
    far = FeasibilityConfig(pregrasp_distance=1.2, approach_points=97)
    assert only_reason(grasp, config=far) == "no_approach"
    assert (
        only_reason(grasp, config=FeasibilityConfig(lift_height=1.2, lift_points=97)) == "no_lift"
    )


def test_an_arm_inside_the_cloud_is_an_arm_collision():
    beam = make_cloud(([0.20, -0.5, 0.35], [0.26, 0.5, 0.75]))  # across the upper arm and forearm
    assert only_reason(make_grasps(pose([0.5, 0.0, 0.02])), beam) == "arm_collision"


def test_a_hand_near_the_cloud_at_the_pregrasp_is_an_arm_collision():
    """The way there leads through free space: at its end the hand keeps the clearance as well."""
    beside = make_cloud(([0.44, 0.11, 0.14], [0.56, 0.12, 0.24]))  # 8 mm from the palm
    grasp = make_grasps(pose([0.5, 0.0, 0.02]))
    assert only_reason(grasp, beside) == "arm_collision"


def test_a_grasp_at_the_robots_own_column_is_a_self_collision():
    column = pose([0.05, 0.03, 0.42], approach=[-0.1, -1.5, 1.4], closing=[1.1, -0.3, 2.1])
    short = FeasibilityConfig(pregrasp_distance=0.02, lift_height=0.02)
    assert only_reason(make_grasps(column), config=short) == "self_collision"


def test_the_counts_and_the_feasible_add_up_to_all_proposals():
    grasps = random_grasps(150, seed=0)
    result = solve(grasps, make_cloud(HANDLE, WALL))
    assert len(result) > 20
    assert len(result) + sum(result.rejected.values()) == len(grasps)
    assert {"table_collision", "hand_collision", "no_ik", "no_approach"} <= {
        reason for reason, count in result.rejected.items() if count
    }


def test_paths_are_straight_continuous_and_inside_the_limits():
    result = solve(random_grasps(150, seed=1), make_cloud(HANDLE, WALL))
    back = np.linspace(-CONFIG.pregrasp_distance, 0, CONFIG.approach_points)
    up = np.linspace(0, CONFIG.lift_height, CONFIG.lift_points)
    p, z = result.X_WG[:, None, :3, 3], result.X_WG[:, None, :3, 2]
    for path, line in (
        (result.q_approach, p + back[:, None] * z),
        (result.q_lift, p + up[:, None] * [0.0, 0.0, 1.0]),
    ):
        X_WG = planning_model().X_WG(path)
        assert np.linalg.norm(X_WG[..., :3, 3] - line, axis=-1).max() < 1e-4
        turned = np.swapaxes(result.X_WG[:, None, :3, :3], -1, -2) @ X_WG[..., :3, :3]
        assert np.abs(turned - np.eye(3)).max() < 1e-4
        assert np.abs(np.diff(path, axis=1)).max() <= CONFIG.max_joint_step
        assert (path >= Q_LOWER + CONFIG.limit_margin).all()
        assert (path <= Q_UPPER - CONFIG.limit_margin).all()
    np.testing.assert_array_equal(result.q_approach[:, -1], result.q_lift[:, 0])
    np.testing.assert_array_equal(result.q_grasp, result.q_lift[:, 0])


def test_what_happens_to_a_grasp_depends_on_no_other_grasp():
    grasps = random_grasps(80, seed=2)
    cloud = make_cloud(HANDLE, WALL)
    shuffle = np.random.default_rng(0).permutation(len(grasps))
    first, second = solve(grasps, cloud), solve(grasps.take(shuffle), cloud)
    assert first.rejected == second.rejected
    order, other = np.argsort(first.score), np.argsort(second.score)
    np.testing.assert_array_equal(first.X_WG[order], second.X_WG[other])
    np.testing.assert_allclose(first.q_approach[order], second.q_approach[other], atol=1e-9)
    np.testing.assert_allclose(first.q_lift[order], second.q_lift[other], atol=1e-9)


def test_the_order_best_first_is_kept():
    result = solve(random_grasps(60, seed=3))
    assert (np.diff(result.score) < 0).all()


def test_of_several_configurations_one_near_the_present_posture_is_taken():
    grasp = make_grasps(pose([0.5, 0.0, 0.1]))
    elsewhere = np.array([0.8, 0.3, -0.9, -2.2, 0.7, 2.0, 1.5])
    here, there = solve(grasp).q_grasp[0], solve(grasp, q_now=elsewhere).q_grasp[0]
    assert np.linalg.norm(here - Q_NOW) < np.linalg.norm(there - Q_NOW) - 0.1
    assert np.linalg.norm(there - elsewhere) < np.linalg.norm(here - elsewhere) - 0.1


def test_the_hand_comes_the_other_way_round_where_that_saves_half_a_turn():
    there, back = pose([0.5, 0.0, 0.1]), pose([0.5, 0.0, 0.1], closing=[0.0, -1.0, 0.0])
    result = solve(make_grasps(there, back))
    np.testing.assert_allclose(result.X_WG[0], result.X_WG[1], atol=1e-12)
    np.testing.assert_allclose(result.q_approach[0], result.q_approach[1], atol=1e-9)
    np.testing.assert_allclose(planning_model().X_WG(result.q_grasp), result.X_WG, atol=1e-9)


MOVED_BASE = """
directives:
- add_directives: { file: package://tog_drake/scenes/table.dmd.yaml }
- add_model: { name: panda, file: package://tog_drake/panda/panda_arm.urdf }
- add_weld:
    parent: world
    child: panda::panda_link0
    X_PC: { translation: [0.1, -0.6, 0.0], rotation: !Rpy { deg: [0, 0, 60] } }
- add_model: { name: hand, file: package://tog_drake/panda/panda_hand.urdf }
- add_weld:
    parent: panda::panda_link8
    child: hand::panda_hand
    X_PC: { rotation: !Rpy { deg: [0, 0, -45] } }
"""


def test_a_moved_base_is_respected():
    moved = MakePlanningModel(LoadModelDirectivesFromString(MOVED_BASE).directives)
    X_WL0 = RigidTransform(RollPitchYaw(0, 0, np.pi / 3), [0.1, -0.6, 0.0])
    here = solve(make_grasps(pose([0.5, 0.0, 0.05])))
    X_there = X_WL0.GetAsMatrix4() @ pose([0.5, 0.0, 0.05])
    there = feasible_grasps(make_grasps(X_there), make_cloud(), Q_NOW, moved, CONFIG)
    np.testing.assert_allclose(there.q_approach, here.q_approach, atol=1e-6)
    np.testing.assert_allclose(moved.X_WG(there.q_grasp), there.X_WG, atol=1e-9)
    np.testing.assert_allclose(there.X_WG[0, :3, 2:], X_there[:3, 2:], atol=1e-12)


def test_no_proposals_are_said_to_be_none():
    with pytest.raises(NoGrasp, match="no grasp was proposed"):
        solve(Grasps.empty())


def test_the_message_of_total_failure_counts_by_reason():
    grasps = make_grasps(pose([1.2, 0.0, 0.1]), pose([1.3, 0.0, 0.1]), pose([0.5, 0.0, -0.1]))
    with pytest.raises(NoFeasibleGrasp) as error:
        solve(grasps)
    assert "0 of 3 grasps" in str(error.value)
    assert f"1 {REASONS['table_collision']}" in str(error.value)
    assert f"2 {REASONS['no_ik']}" in str(error.value)


def test_the_config_is_read_from_yaml():
    config = yaml_load_typed(schema=FeasibilityConfig, data="{lift_height: 0.2}")
    assert config == FeasibilityConfig(lift_height=0.2)


def test_the_system_outputs_the_feasible_grasps_and_computes_them_once():
    system = FeasibilityFilter(CONFIG, Workspace(), planning_model())
    context = system.CreateDefaultContext()
    grasps, cloud = make_grasps(pose([0.5, 0.0, 0.05]), pose([1.2, 0.0, 0.1])), make_cloud(HANDLE)
    system.GetInputPort("grasps").FixValue(context, Value(grasps))
    system.GetInputPort("cloud").FixValue(context, Value(cloud))
    system.GetInputPort("view").FixValue(context, Value(View.empty()))
    system.GetInputPort("panda.position_measured").FixValue(context, Q_NOW)
    system.GetInputPort("failed_grasps").FixValue(context, Value(Grasps.empty()))
    port = system.GetOutputPort("feasible_grasps")
    assert isinstance(port.Allocate().get_value(), FeasibleGrasps)
    result = port.Eval(context)
    np.testing.assert_array_equal(result.q_grasp, solve(grasps, cloud).q_grasp)
    context.SetTime(1.0)
    assert port.Eval(context) is result


def test_the_system_measures_the_table_by_the_workspace():
    system = FeasibilityFilter(CONFIG, Workspace(table_height=0.045), planning_model())
    context = system.CreateDefaultContext()
    system.GetInputPort("grasps").FixValue(context, Value(make_grasps(pose([0.5, 0.0, 0.05]))))
    system.GetInputPort("cloud").FixValue(context, Value(make_cloud()))
    system.GetInputPort("view").FixValue(context, Value(View.empty()))
    system.GetInputPort("panda.position_measured").FixValue(context, Q_NOW)
    system.GetInputPort("failed_grasps").FixValue(context, Value(Grasps.empty()))
    with pytest.raises(NoFeasibleGrasp, match="into the table"):
        system.GetOutputPort("feasible_grasps").Eval(context)
