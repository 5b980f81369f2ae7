"""The oracle's choice, on closing regions written by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import QueryObject
from pydrake.perception import PointCloud

from tog_drake.errors import NoChoice, NoGrasp
from tog_drake.object_parts import load_parts
from tog_drake.resources import resource_dir
from tog_drake.selectors.oracle import choose_by_labels
from tog_drake.values import Candidates, FeasibleGrasps, Grasps, View

HANDLE, HEAD, CUP = ("hammer", "handle"), ("hammer", "head"), ("cup", "body")
PARTS = load_parts(resource_dir("models") / "objects" / "hammer" / "parts.yaml")


def _grasps(scores, type_=Grasps, **more):
    n = len(scores)
    X_WG = np.tile(np.eye(4), (n, 1, 1))
    X_WG[:, 0, 3] = np.arange(n)  # far apart
    return type_(X_WG, np.full(n, 0.03), np.array(scores, dtype=float), np.ones((n, 3)), **more)


def _choose(regions, task="use the hammer", *, around=None, proposed=(), seen=()):
    """A choice among grasps with these closing regions, of which one point is ``seen``."""

    def closing_region(grasps, query, beside=0.0):
        if len(grasps) != len(regions):
            return proposed
        return regions if around is None or beside == 0 else around

    labels = SimpleNamespace(
        objects={"hammer": PARTS},
        closing_region=closing_region,
        nearest_part=lambda p_W, query, reach: ([HANDLE, CUP], np.array(seen, dtype=int)),
    )
    n = len(regions)
    paths = {"q_approach": np.zeros((n, 2, 7)), "q_lift": np.zeros((n, 2, 7))}
    grasps = _grasps(np.linspace(0.9, 0.5, n), FeasibleGrasps, **paths)
    grasps.rejected.update(no_ik=3, arm_collision=0)
    return choose_by_labels(
        labels,
        "hammer",
        View.empty(),
        PointCloud(len(seen)),
        _grasps([0.5] * len(proposed)),
        Candidates(grasps, np.arange(n), np.zeros(n, dtype=int)),
        task,
        QueryObject(),
    )


def test_of_the_grasps_on_an_allowed_part_alone_the_best_score_wins():
    choice = _choose([{HEAD: 1.0}, {HANDLE: 0.9, HEAD: 0.1}, {HANDLE: 1.0}, {HANDLE: 1.0}])
    assert (choice.index, choice.part) == (2, "handle")
    assert choice.alternatives == (3, 1)


def test_one_that_may_slide_onto_a_forbidden_part_is_taken_where_all_may():
    regions = [{HANDLE: 1.0}, {HANDLE: 1.0}, {HANDLE: 1.0}]
    at_the_end = {HANDLE: 0.7, HEAD: 0.3}
    assert _choose(regions, around=[at_the_end, {HANDLE: 1.0}, at_the_end]).index == 1
    assert _choose(regions, around=[at_the_end] * 3).index == 0


def test_where_every_grasp_is_mixed_the_least_mixed_is_taken_down_to_four_fifths():
    choice = _choose([{HANDLE: 0.8, HEAD: 0.2}, {HANDLE: 0.9, HEAD: 0.1}, {HANDLE: 0.79}])
    assert choice.index == 1
    assert choice.alternatives == (0,)
    with pytest.raises(NoChoice, match="none of 1 feasible grasps closes on handle of hammer"):
        _choose([{HANDLE: 0.79, HEAD: 0.21}])


def test_where_the_task_names_no_part_any_part_of_the_target_will_do():
    choice = _choose([{CUP: 1.0}, {HEAD: 1.0}, {HANDLE: 1.0}], "pick up the hammer")
    assert (choice.index, choice.part) == (1, "head")
    assert choice.alternatives == (2,)


def test_a_part_to_avoid_is_not_allowed_even_where_it_is_that_of_the_intent():
    choice = _choose([{HEAD: 1.0}, {HANDLE: 1.0}], "hand me the hammer, not by the head")
    assert (choice.index, choice.part) == (1, "handle")
    assert choice.alternatives == ()


def test_a_task_that_says_to_leave_things_alone_is_no_choice():
    with pytest.raises(NoChoice, match="allows no labelled part of hammer; its parts are handle"):
        _choose([{HANDLE: 1.0}], "don't pick the hammer up")


def test_grasps_on_other_things_alone_are_no_grasp_and_it_says_whether_the_target_is_hidden():
    with pytest.raises(NoGrasp, match=r"none of 1 .* on hammer: 0 of the cloud's 3 points"):
        _choose([{CUP: 1.0}], seen=(1, 1, -1))


def test_a_target_that_is_seen_but_not_proposed_is_said_to_be_so():
    with pytest.raises(NoGrasp, match=r"2 of the cloud's 3 points .* none of the 2 grasps propo"):
        _choose([{CUP: 1.0}], seen=(0, 0, 1), proposed=({CUP: 1.0}, {CUP: 0.6, HANDLE: 0.4}))


def test_a_target_whose_grasps_were_all_rejected_is_told_from_a_hidden_one():
    message = r"all 1 grasps proposed on it were rejected \(rejected of all 2: no_ik 3\)"
    with pytest.raises(NoGrasp, match=message):
        _choose([{CUP: 1.0}], seen=(0, 0, 1), proposed=({CUP: 1.0}, {HEAD: 0.6, CUP: 0.4}))
