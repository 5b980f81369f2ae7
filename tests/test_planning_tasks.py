"""A sample of what ``benchmarks/bench_planning.py`` counts: planned, and checked by other means."""

from itertools import islice, pairwise

import numpy as np
import pytest
from planning_tasks import exact_checker, planning_tasks

from tog_drake.panda import A_MAX, FINGER_BODIES, J_MAX, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.path_planning import straight_line
from tog_drake.planning_model import MARGIN, MakePlanningModel
from tog_drake.trajectory import TrajectoryConfig, plan_motion

HAND = ("panda_hand", *FINGER_BODIES)
KEPT = 0.8 * MARGIN  # less than the planner's, for what is between its samples


@pytest.fixture(scope="module")
def planned():
    model = MakePlanningModel()
    tasks = list(islice(planning_tasks(7, model), 8))
    config = TrajectoryConfig()
    return model, [
        (task, plan_motion(task.choice, task.candidates, task.q_now, task.cloud, model, config, 0))
        for task in tasks
    ]


def test_every_task_is_planned_to_the_grasp_that_was_chosen(planned):
    assert all(motion.grasp_index == task.choice.index for task, motion in planned[1])


def test_motions_among_obstacles_come_from_the_optimisation(planned):
    assert all(motion.note.startswith("optimised") for _, motion in planned[1])


def test_motions_among_obstacles_keep_all_limits(planned):
    for _, motion in planned[1]:
        times = np.random.default_rng(0).uniform(0, motion.duration, 1000)
        q = motion.arm.vector_values(times).T
        assert (q > Q_LOWER).all() and (q < Q_UPPER).all()
        for order, limit in enumerate((V_MAX, A_MAX, J_MAX), 1):
            rate = motion.arm.MakeDerivative(order).vector_values(times).T
            assert (np.abs(rate) / (TrajectoryConfig().speed ** order * limit)).max() < 1.001


def test_motions_among_obstacles_touch_none_by_drakes_exact_geometry(planned):
    model, motions = planned
    for task, motion in motions:
        checker = exact_checker(model, task, KEPT)
        starts = [0.0, *(motion.phase_times[phase] for phase in ("approach", "lift", "hold"))]
        for start, end in pairwise(starts):
            if start > 0:  # then the hand comes near, and the filter has decided what it may touch
                for name in HAND:
                    hand = model.plant.GetBodyByName(name)
                    checker.SetCollisionFilteredBetween(hand, model.plant.world_body(), True)
                    checker.SetPaddingOneRobotBodyAllEnvironmentPairs(hand.index(), 0.0)
            q = motion.arm.vector_values(np.linspace(start, end, 150)).T
            for positions in model.full_positions(q, motion.hand.value(0.0).item()):
                assert checker.CheckConfigCollisionFree(positions)


def test_obstacles_stand_in_the_straight_way_of_some(planned):
    model, motions = planned
    blocked = 0
    for task, motion in motions:
        checker = exact_checker(model, task, KEPT)
        line = straight_line(task.q_now, task.choice.grasp.q_pregrasp[0], 0.05)
        positions = model.full_positions(line, motion.hand.value(0.0).item())
        blocked += not all(checker.CheckConfigCollisionFree(p) for p in positions)
    assert blocked >= 2
