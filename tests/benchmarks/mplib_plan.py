"""mplib's ``plan_pose`` for ``bench_peers``: needs mplib and numpy, and nothing of ours.

Runs as a process of its own in mplib's environment. Every line of standard input is one request,
answered by one line of standard output; both are JSON:

- first ``{"urdf", "velocity", "acceleration"}``: the robot with all that it knows, and the limits
  of its seven joints; answered when the planner is built;
- ``{"points"}`` (N, 3) [m]: what must not be touched from now on;
- ``{"q", "X_WH"}``: from positions (9,), fingers last, to a pose of the hand (4, 4); answered by
  ``{"status", "cpu_ms"}`` and, where a motion was found, its ``"seconds"`` and ``"positions"``
  (T, 7), one every ``TIME_STEP``.
"""

import json
import os
import sys
import time

import mplib
import numpy as np
from mplib.urdf_utils import generate_srdf

HAND, CLOUD = "panda_hand", "cloud"
STANDING = ["table", "panda_link0"]  # these do not move: things may touch them, as in our planner
TIME_STEP = 0.02  # [s] between the samples of a motion that is found
POSTURES = 10_000  # drawn to learn which links never meet; mplib's 100 000 take 40 s


def make_planner(request):
    mplib.set_global_seed(0)
    return mplib.Planner(
        request["urdf"],
        HAND,
        srdf=generate_srdf(request["urdf"], num_samples=POSTURES),
        joint_vel_limits=request["velocity"],
        joint_acc_limits=request["acceleration"],
    )


def see(planner, request):
    planner.update_point_cloud(np.array(request["points"]), name=CLOUD)
    planner.acm.set_entry(STANDING, [CLOUD], True)
    return {"status": "seen"}


def plan(planner, request):
    goal, q = mplib.Pose(np.array(request["X_WH"])), np.array(request["q"])
    started = time.process_time()
    found = planner.plan_pose(goal, q, time_step=TIME_STEP)
    answer = {"status": found["status"], "cpu_ms": 1e3 * (time.process_time() - started)}
    if found["status"] == "Success":
        answer |= {"seconds": float(found["duration"]), "positions": found["position"].tolist()}
    return answer


def main():
    # The library prints, too: what it says goes to standard error.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    planner = make_planner(json.loads(sys.stdin.readline()))
    print(json.dumps({"status": "ready"}), file=answers)
    for line in sys.stdin:
        request = json.loads(line)
        answer = (see if "points" in request else plan)(planner, request)
        print(json.dumps(answer), file=answers)


main()
