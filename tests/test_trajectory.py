"""Whole motions, on clouds made by hand: clear, inside the limits, at rest where it counts."""

import re
from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake import trajectory
from tog_drake.errors import InputError, NoPlan
from tog_drake.panda import A_MAX, J_MAX, MAX_OPENING, Q_LOWER, Q_UPPER, V_MAX, X_HG
from tog_drake.panda_ik import follow_path, inverse_kinematics
from tog_drake.path_planning import straight_line
from tog_drake.planning_model import MakePlanningModel
from tog_drake.time_parameterization import SplineConfig, rest_to_rest
from tog_drake.trajectory import TrajectoryConfig, TrajectoryOptimizer, _limits, plan_motion
from tog_drake.transfer import TransferConfig
from tog_drake.values import Candidates, Choice, FeasibleGrasps

Q_LOOK = np.array([0.0, -0.9564, 0.0, -2.7824, 0.0, 2.2558, 0.7853])
Q_SIDE = Q_LOOK + np.array([-0.9, 0.7, 0, 0.4, 0, 0, 0])  # low, on the right
CONFIG = TrajectoryConfig()


@cache
def planning_model():
    return MakePlanningModel()


def straight(X_from, offset, count):
    """X_L0H along a line of the hand, (count, 4, 4)."""
    X = np.repeat(X_from[None], count, axis=0)
    X[:, :3, 3] += np.linspace(0, 1, count)[:, None] * offset
    return X


def grasp_from_above(x, y):
    """A grasp from above, 3 cm wide, 4 cm above the table."""
    X_WG = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WG[:3, 3] = x, y, 0.04
    X_WH = X_WG @ np.linalg.inv(X_HG)
    q = inverse_kinematics(X_WH[None], np.array([0.785 + np.arctan2(y, x)])).reshape(-1, 7)
    q = q[np.isfinite(q).all(axis=1) & (q > Q_LOWER).all(axis=1) & (q < Q_UPPER).all(axis=1)]
    q_grasp = q[np.argmin(np.abs(q - Q_LOOK).max(axis=1))]
    up = np.array([0.0, 0.0, 1.0])
    q_retreat, q_lift = (
        follow_path(straight(X_WH, height * up, 9)[None], q_grasp[None]) for height in (0.10, 0.15)
    )
    assert np.isfinite(q_retreat).all()
    assert np.isfinite(q_lift).all()
    return FeasibleGrasps(
        X_WG=X_WG[None],
        width=np.array([0.03]),
        score=np.ones(1),
        p_WContact=X_WG[None, :3, 3],
        q_approach=q_retreat[:, ::-1],
        q_lift=q_lift,
    )


def candidates_of(*grasps):
    """Single grasps as candidates, all in one cluster."""
    rows = {
        name: np.concatenate([getattr(grasp, name) for grasp in grasps])
        for name in ("X_WG", "width", "score", "p_WContact", "q_approach", "q_lift")
    }
    count = np.arange(len(grasps))
    return Candidates(FeasibleGrasps(**rows), count, np.zeros_like(count))


@cache
def candidates():
    """One grasp, of a block on the left."""
    return candidates_of(grasp_from_above(0.5, 0.2))


@cache
def choice():
    return Choice(index=0, grasp=candidates().grasps, reason="the only one")


def block(lower, upper):
    """Points 5 mm apart in a box."""
    axes = [np.arange(a, b, 0.005) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def make_cloud(*blocks):
    points = np.concatenate(blocks)
    cloud = PointCloud(len(points))
    cloud.mutable_xyzs()[:] = points.T
    return cloud


TARGET = block([0.45, 0.185, 0.005], [0.55, 0.215, 0.06])
WALL = block([0.35, -0.02, 0.0], [0.65, 0.02, 0.30])
EASY = make_cloud(TARGET)
OVER_A_WALL = make_cloud(TARGET, WALL)


def plan(q_now=Q_SIDE, cloud=OVER_A_WALL, config=CONFIG, seed=0, chosen=None, among=None):
    return plan_motion(
        chosen or choice(), among or candidates(), q_now, cloud, planning_model(), config, seed
    )


@cache
def motion_over_the_wall():
    return plan()


def configurations(motion, start, end, step=0.01):
    """Configurations between two times so close that no joint moves by more than ``step``."""
    q = motion.arm.vector_values(np.linspace(start, end, 3000)).T
    moved = np.cumsum(np.abs(np.diff(q, axis=0)).max(axis=1))
    kept = np.concatenate([[0], 1 + np.flatnonzero(np.diff(moved // (step / 2)) > 0), [2999]])
    assert np.abs(np.diff(q[kept], axis=0)).max() <= step
    return q[kept]


def distance_to(cloud, q):
    """From the robot's spheres to the nearest point, by a search that the planner does not use."""
    p_W, radius, body = planning_model().spheres(q, MAX_OPENING)
    moving = np.array([name != "panda_link0" for name in body])
    distance, _ = cKDTree(cloud.xyzs().T).query(p_W[:, moving])
    return (distance - radius[moving]).min(axis=1)


def test_the_wall_stands_in_the_straight_way():
    straight_way = straight_line(Q_SIDE, choice().grasp.q_pregrasp[0], 0.02)
    assert distance_to(OVER_A_WALL, straight_way).min() < -0.02
    assert distance_to(EASY, straight_way).min() > 0.02


def test_the_way_to_the_pregrasp_keeps_clear_of_a_wall_of_the_table_and_of_itself():
    motion = motion_over_the_wall()
    q = configurations(motion, 0, motion.phase_times["approach"])
    assert distance_to(OVER_A_WALL, q).min() > 0
    assert planning_model().check_configs(q, 0.07).all()
    assert motion.note == "optimised, attempt 1"


def test_approach_and_lift_keep_clear_of_the_table():
    motion = motion_over_the_wall()
    q = configurations(motion, motion.phase_times["approach"], motion.duration)
    assert planning_model().check_configs(q, 0.07).all()


@pytest.mark.parametrize("speed", [1.0, 0.6, 0.3])
def test_every_limit_holds_at_every_time(speed):
    motion = plan(config=TrajectoryConfig(speed=speed))
    times = np.random.default_rng(1).uniform(0, motion.duration, 5000)
    q = motion.arm.vector_values(times).T
    assert (q > Q_LOWER).all()
    assert (q < Q_UPPER).all()
    for order, limit in enumerate((V_MAX, A_MAX, J_MAX), 1):
        rate = motion.arm.MakeDerivative(order).vector_values(times).T
        assert (np.abs(rate) / (speed**order * limit)).max() < 1.001


def test_the_derivatives_are_those_of_the_positions():
    motion = motion_over_the_wall()
    h, times = 1e-5, np.linspace(0.01, motion.duration - 0.01, 500)
    after, before = (motion.arm.vector_values(times + d) for d in (h, -h))
    velocity = motion.arm.MakeDerivative(1).vector_values(times)
    np.testing.assert_allclose((after - before) / (2 * h), velocity, atol=1e-3)
    assert np.abs(velocity).max() > 0.5


def test_the_motion_starts_exactly_where_the_arm_is_and_rests_between_its_phases():
    motion = motion_over_the_wall()
    np.testing.assert_array_equal(motion.arm.value(0.0).ravel(), Q_SIDE)
    for t in (0.0, *motion.phase_times.values(), motion.duration):
        assert np.abs(motion.arm.EvalDerivative(t)).max() < 1e-9
        q = motion.arm.vector_values([max(t - 1e-6, 0), min(t + 1e-6, motion.duration)])
        assert np.abs(np.diff(q, axis=1)).max() < 1e-9
    assert motion.arm.start_time() == motion.hand.start_time() == 0
    assert motion.arm.end_time() == motion.hand.end_time() == motion.duration


def test_the_arm_passes_pregrasp_and_grasp_and_ends_lifted():
    motion, grasp = motion_over_the_wall(), choice().grasp
    assert list(motion.phase_times) == ["approach", "close", "lift", "hold"]
    for t, q in [
        (motion.phase_times["approach"], grasp.q_pregrasp[0]),
        (motion.phase_times["close"], grasp.q_grasp[0]),
        (motion.phase_times["lift"], grasp.q_grasp[0]),
        (motion.phase_times["hold"], grasp.q_lift[0, -1]),
        (motion.duration, grasp.q_lift[0, -1]),
    ]:
        np.testing.assert_allclose(motion.arm.value(t).ravel(), q, atol=1e-9)
    assert motion.duration - motion.phase_times["hold"] >= 2.0


@pytest.mark.parametrize(
    ("first", "last", "speed"), [("approach", "close", 0.15), ("lift", "hold", 0.25)]
)
def test_approach_and_lift_are_straight_and_slow(first, last, speed):
    motion = motion_over_the_wall()
    times = np.linspace(motion.phase_times[first], motion.phase_times[last], 400)
    p = planning_model().X_WG(motion.arm.vector_values(times).T)[:, :3, 3]
    along = (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
    np.testing.assert_allclose(np.abs(along), [0, 0, 1], atol=1e-4)
    aside = (p - p[0]) - np.outer((p - p[0]) @ along, along)
    assert np.linalg.norm(aside, axis=1).max() < 1e-3
    fastest = np.linalg.norm(np.diff(p, axis=0), axis=1).max() / (times[1] - times[0])
    assert 0.5 * speed < fastest < 1.01 * speed


def test_the_hand_is_open_until_the_grasp_and_closed_beyond_contact_before_the_lift():
    motion = motion_over_the_wall()
    closing, lift = motion.phase_times["close"], motion.phase_times["lift"]
    for t in (0.0, closing / 2, closing):
        assert motion.hand.value(t).item() == pytest.approx(0.07)  # 3 cm and a margin of 4 cm
    for t in (lift - CONFIG.settle_time, lift, motion.duration):
        assert motion.hand.value(t).item() == pytest.approx(-0.02)
    times = np.linspace(0, motion.duration, 1000)
    opening = motion.hand.vector_values(times).ravel()
    assert np.abs(np.diff(opening)).max() / (times[1] - times[0]) < 0.1001


def test_a_hand_that_cannot_go_to_a_width_arrives_fully_open():
    scene = (candidates(), Q_LOOK, EASY, planning_model(), CONFIG, 0)
    motion = plan_motion(choice(), *scene, opens_fully=True)
    assert motion.hand.value(motion.phase_times["close"]).item() == MAX_OPENING


def test_a_wide_grasp_opens_the_hand_no_wider_than_it_can():
    wide = FeasibleGrasps(**{**vars(choice().grasp), "width": np.array([0.06])})
    motion = plan(Q_LOOK, EASY, among=candidates_of(wide))
    assert motion.hand.value(0.0).item() == MAX_OPENING


def test_the_same_seed_gives_the_same_motion():
    first, second = motion_over_the_wall(), plan()
    times = np.linspace(0, first.duration, 100)
    assert second.duration == first.duration
    np.testing.assert_array_equal(first.arm.vector_values(times), second.arm.vector_values(times))


def test_a_motion_that_starts_at_the_pregrasp_is_possible():
    q_pregrasp = choice().grasp.q_pregrasp[0]
    motion = plan(q_pregrasp, EASY)
    q = configurations(motion, 0, motion.phase_times["approach"])
    assert np.abs(q - q_pregrasp).max() < 0.01


def test_the_cloud_may_be_empty():
    assert plan(Q_LOOK, make_cloud(np.zeros((0, 3)))).duration > 3


def test_where_no_spline_is_found_the_arm_stops_at_the_corners_of_the_path_and_says_so():
    hurried = TrajectoryConfig(transfer=TransferConfig(spline=SplineConfig(major_iterations=1)))
    motion = plan(config=hurried)
    assert motion.note.startswith("with stops, since 5 attempts to optimise failed")
    assert motion.phase_times["approach"] > motion_over_the_wall().phase_times["approach"]
    q = configurations(motion, 0, motion.phase_times["approach"])
    assert distance_to(OVER_A_WALL, q).min() > 0
    deepcopy(motion).arm.value(1.0)


def blocked_pregrasp():
    """Something where the palm would be before the grasp of ``choice``."""
    p = planning_model().X_WG(choice().grasp.q_pregrasp)[0, :3, 3]
    return block(p + np.array([-0.05, -0.05, 0.05]), p + np.array([0.05, 0.05, 0.1]))


def test_the_first_alternative_that_has_a_motion_is_taken_and_why_is_said():
    among = candidates_of(*(grasp_from_above(0.5, y) for y in (0.2, 0.22, -0.1, -0.2)))
    chosen = replace(choice(), alternatives=(1, 2, 3))
    blocked = make_cloud(TARGET, blocked_pregrasp())
    motion = plan(Q_LOOK, blocked, chosen=chosen, among=among)
    assert motion.grasp_index == 2
    reasons = r"optimised, attempt 1, in place of grasp 0: .* not free.*; grasp 1: .* not free"
    assert re.match(reasons, motion.note)
    at_the_grasp = motion.arm.value(motion.phase_times["close"]).ravel()
    np.testing.assert_allclose(at_the_grasp, among.grasps.q_grasp[2])
    assert plan(Q_LOOK, EASY, chosen=chosen, among=among).grasp_index == 0


def test_where_no_alternative_has_a_motion_every_reason_is_said():
    among = candidates_of(grasp_from_above(0.5, 0.2), grasp_from_above(0.5, 0.21))
    chosen = replace(choice(), alternatives=(1,))
    with pytest.raises(NoPlan, match=r"grasp 0: the pregrasp.*; grasp 1: the pregrasp"):
        plan(Q_LOOK, make_cloud(TARGET, blocked_pregrasp()), chosen=chosen, among=among)


def test_a_blocked_pregrasp_is_named():
    blocked = make_cloud(TARGET, blocked_pregrasp())
    with pytest.raises(NoPlan, match=r"the pregrasp posture is not free: panda_hand .* by .* mm"):
        plan(Q_LOOK, blocked)


def test_a_blocked_approach_is_named_with_the_time():
    # A lid with a hole for the hand, which the elbow meets on the way down.
    lid = block([0.15, -0.5, 0.25], [0.70, 0.5, 0.255])
    lid = lid[np.hypot(lid[:, 0] - 0.5, lid[:, 1] - 0.2) > 0.15]
    with pytest.raises(
        NoPlan, match=r"the approach is not free \d\.\d\d s after its start: panda_link5"
    ):
        plan(Q_LOOK, make_cloud(TARGET, lid))


def test_an_arm_that_touches_something_already_does_not_move():
    p = planning_model().X_WG(Q_LOOK)[:3, 3]
    around = make_cloud(TARGET, block(p - 0.05, p + 0.05))
    with pytest.raises(NoPlan, match=r"the arm's present posture is not free.*by hand"):
        plan(Q_LOOK, around)


@pytest.mark.parametrize("q", [np.zeros(7), np.full(7, np.nan)])
def test_a_posture_that_the_arm_cannot_have_is_refused(q):
    with pytest.raises(NoPlan, match=r"present posture is not possible.*driver"):
        plan(q)


def test_a_choice_without_joint_paths_is_refused():
    with pytest.raises(NoPlan, match="FeasibleGrasps is needed"):
        plan(chosen=Choice.none())


@pytest.mark.parametrize("speed", [0.0, -1.0, 1.5, np.nan])
def test_a_speed_that_is_none_is_refused(speed):
    with pytest.raises(InputError, match="valid: above 0, up to 1"):
        plan(config=TrajectoryConfig(speed=speed))


def test_a_motion_that_breaks_a_limit_is_refused_whoever_made_it(monkeypatch):
    def too_fast(path, limits, start_time, min_duration):
        return rest_to_rest(path, limits.scaled(1.5), start_time, 0.1)

    monkeypatch.setattr(trajectory, "rest_to_rest", too_fast)
    with pytest.raises(NoPlan, match=r"break the (velocity|acceleration) limit of joint \d at"):
        plan(Q_LOOK, EASY)


def test_the_configuration_can_be_written_in_yaml():
    text = "{speed: 0.3, hold_time: 3.0, transfer: {spline: {control_points: 14}}}"
    config = yaml_load_typed(schema=TrajectoryConfig, data=text, defaults=TrajectoryConfig())
    assert config == TrajectoryConfig(
        speed=0.3, hold_time=3.0, transfer=TransferConfig(spline=SplineConfig(control_points=14))
    )


def test_the_system_plans_once_per_change_of_an_input(monkeypatch):
    calls = []

    def counted(*args, **kwargs):
        calls.append(args)
        return plan_motion(*args, **kwargs)

    monkeypatch.setattr(trajectory, "plan_motion", counted)
    system = TrajectoryOptimizer(CONFIG, planning_model(), seed=3)
    context = system.CreateDefaultContext()
    system.GetInputPort("choice").FixValue(context, Value(choice()))
    system.GetInputPort("candidates").FixValue(context, Value(candidates()))
    system.GetInputPort("cloud").FixValue(context, Value(EASY))
    position = system.GetInputPort("panda.position_measured")
    position.FixValue(context, Q_LOOK)
    motion = system.GetOutputPort("motion")
    first = motion.Eval(context)
    context.SetTime(1.0)
    assert motion.Eval(context).duration == first.duration
    assert len(calls) == 1
    position.FixValue(context, Q_SIDE)
    np.testing.assert_array_equal(motion.Eval(context).arm.value(0.0).ravel(), Q_SIDE)
    assert len(calls) == 2


def test_an_error_reaches_the_caller_as_it_was_raised():
    system = TrajectoryOptimizer(CONFIG, planning_model(), seed=0)
    context = system.CreateDefaultContext()
    system.GetInputPort("choice").FixValue(context, Value(Choice.none()))
    system.GetInputPort("candidates").FixValue(context, Value(Candidates.empty()))
    system.GetInputPort("cloud").FixValue(context, Value(EASY))
    system.GetInputPort("panda.position_measured").FixValue(context, Q_LOOK)
    with pytest.raises(NoPlan, match="a row of FeasibleGrasps is needed"):
        system.GetOutputPort("motion").Eval(context)


def test_no_path_widens_the_limits_of_the_robot():
    q_now = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0])
    outside = np.stack([Q_LOWER - 1, Q_UPPER + 1])
    limits = _limits(TrajectoryConfig(), q_now, outside)
    np.testing.assert_array_equal(limits.lower, Q_LOWER)
    np.testing.assert_array_equal(limits.upper, Q_UPPER)


def test_the_way_back_opens_the_hand_and_ends_where_the_motion_began():
    motion = plan_motion(
        choice(), candidates(), Q_SIDE, OVER_A_WALL, planning_model(), CONFIG, 0, with_retreat=True
    )
    back = motion.retreat
    np.testing.assert_allclose(back.arm.value(0), motion.arm.value(motion.duration), atol=1e-9)
    np.testing.assert_allclose(back.arm.value(back.duration).ravel(), Q_SIDE, atol=1e-9)
    q = configurations(back, 0, back.duration)
    assert distance_to(OVER_A_WALL, q).min() > 0
    assert planning_model().check_configs(q, MAX_OPENING).all()
    for t in (0.0, back.phase_times["back"], back.duration):
        assert np.abs(back.arm.EvalDerivative(t)).max() < 1e-9
    opening = back.hand.vector_values([0.0, back.phase_times["back"], back.duration]).ravel()
    np.testing.assert_allclose(opening, [CONFIG.closed, MAX_OPENING, MAX_OPENING])
    assert motion_over_the_wall().retreat is None


def test_a_motion_without_a_way_back_is_carried_out_all_the_same():
    # Just beside the hand's wide side after the lift: nearer than is safe.
    beside = make_cloud(TARGET, block([0.49, 0.312, 0.275], [0.51, 0.322, 0.295]))
    motion = plan_motion(
        choice(), candidates(), Q_LOOK, beside, planning_model(), CONFIG, 0,
        with_retreat=True,
    )  # fmt: skip
    assert motion.retreat is None
    assert "no way back: the posture after the lift is not free" in motion.note
