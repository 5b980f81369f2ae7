"""How often and how fast a motion is found among obstacles: ``make bench`` prints the table.

A hundred tasks of ``planning_tasks``, each planned to its grasp alone and, where that fails, to
those that a selector would name in its place. Times are of the process, so that other work on the
machine distorts them little.
"""

import time
from dataclasses import replace
from itertools import islice

import numpy as np
from planning_tasks import planning_tasks

from tog_drake.errors import NoPlan
from tog_drake.planning_model import MakePlanningModel
from tog_drake.trajectory import TrajectoryConfig, plan_motion

TASKS, SEED = 100, 1


def _plan(task, choice, model):
    """Returns the motion (None where there is none), why, and the seconds that it took."""
    config, start = TrajectoryConfig(), time.process_time()
    try:
        motion = plan_motion(choice, task.candidates, task.q_now, task.cloud, model, config, 0)
    except NoPlan as error:
        return None, str(error), time.process_time() - start
    return motion, motion.note, time.process_time() - start


def _median_and_p90(values):
    return f"median {np.median(values):.3g}, p90 {np.percentile(values, 90):.3g}"


def test_plan_among_obstacles(capsys):
    model = MakePlanningModel()
    optimised, rescued, ms, ways, failures = 0, 0, [], [], []
    for task in islice(planning_tasks(SEED, model), TASKS):
        motion, note, seconds = _plan(task, replace(task.choice, alternatives=()), model)
        ms.append(1e3 * seconds)
        optimised += note.startswith("optimised")
        if motion is None:
            failures.append(note)
            rescued += _plan(task, task.choice, model)[0] is not None
        else:
            ways.append(motion.phase_times["approach"])
    planned = TASKS - len(failures)
    with capsys.disabled():
        print(f"\n{TASKS} tasks with obstacles, seed {SEED}: planned")
        print(f"  by the optimisation               {optimised}")
        print(f"  or with stops at corners          {planned}")
        print(f"  or to another grasp of the scene  {planned + rescued}")
        print(f"  [ms] {_median_and_p90(ms)}; way to the pregrasp [s] {_median_and_p90(ways)}")
        for failure in failures:
            print(f"  failed: {failure}")
    assert planned > 0.9 * TASKS
