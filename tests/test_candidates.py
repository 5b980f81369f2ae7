import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed

from tog_drake.candidates import CandidatePicker, CandidatesConfig, pick_candidates
from tog_drake.errors import InputError, NoGrasp
from tog_drake.values import FeasibleGrasps, Grasps

CORNERS = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0]])


def grasps_at(points, score):
    points = np.asarray(points, dtype=float)
    X_WG = np.tile(np.eye(4), (len(points), 1, 1))
    X_WG[:, :3, 3] = points
    return Grasps(X_WG, np.full(len(points), 0.03), np.asarray(score, dtype=float), points)


def three_clumps(per_clump=20, seed=0):
    rng = np.random.default_rng(seed)
    points = np.repeat(CORNERS, per_clump, axis=0) + rng.normal(0, 0.005, (3 * per_clump, 3))
    return grasps_at(points, rng.random(3 * per_clump))


def test_each_candidate_is_the_most_confident_of_its_cluster():
    grasps = three_clumps()
    picked = pick_candidates(grasps, CandidatesConfig(k=3), seed=0)
    clumps = np.repeat([0, 1, 2], 20)
    best = {int(20 * c + grasps.score[clumps == c].argmax()) for c in range(3)}
    assert set(picked.index.tolist()) == best
    assert (np.diff(grasps.score[picked.index]) <= 0).all()  # best confidence first
    for rank, row in enumerate(picked.index):
        assert (picked.cluster == rank).tolist() == (clumps == clumps[row]).tolist()


def test_auto_finds_as_many_candidates_as_there_are_clumps():
    assert len(pick_candidates(three_clumps(), CandidatesConfig(k="auto"), seed=0)) == 3


def test_auto_tries_no_more_than_k_max():
    assert len(pick_candidates(three_clumps(), CandidatesConfig(k="auto", k_max=2), seed=0)) == 2


@pytest.mark.parametrize("k", [4, "auto"])
def test_one_grasp_is_one_candidate(k):
    picked = pick_candidates(grasps_at([[0, 0, 0]], [0.5]), CandidatesConfig(k=k), seed=0)
    assert picked.index.tolist() == [0]


def test_fewer_grasps_than_k_are_all_candidates():
    picked = pick_candidates(grasps_at(CORNERS, [0.1, 0.9, 0.5]), CandidatesConfig(k=8), seed=0)
    assert picked.index.tolist() == [1, 2, 0]


def test_grasps_at_one_place_are_one_candidate():
    picked = pick_candidates(grasps_at(np.zeros((5, 3)), [1, 3, 2, 0, 0]), CandidatesConfig(k=3), 0)
    assert picked.index.tolist() == [1]


@given(st.integers(1, 40), st.integers(1, 6), st.booleans(), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_order_of_the_grasps_does_not_matter(count, k, auto, seed):
    rng = np.random.default_rng(seed)
    grasps = grasps_at(rng.integers(0, 4, (count, 3)) / 10, rng.integers(0, 3, count) / 2)
    grasps = grasps.take(np.arange(count))
    grasps.X_WG[:, 0, 3] += np.arange(count)  # no two are the same grasp
    config = CandidatesConfig(k="auto" if auto else k)
    shuffle = rng.permutation(count)
    picked = pick_candidates(grasps, config, seed=7)
    again = pick_candidates(grasps.take(shuffle), config, seed=7)
    assert shuffle[again.index].tolist() == picked.index.tolist()
    assert again.cluster.tolist() == picked.cluster[shuffle].tolist()
    assert 1 <= len(picked) <= (config.k_max if auto else k)
    assert set(picked.cluster.tolist()) == set(range(len(picked)))


@pytest.mark.parametrize("k", [0, -3, "many", "", "2.5"])
def test_a_senseless_k_is_an_input_error_that_says_what_is_valid(k):
    with pytest.raises(InputError, match="at least 1, or 'auto'"):
        pick_candidates(three_clumps(), CandidatesConfig(k=k), seed=0)
    with pytest.raises(InputError, match="at least 1, or 'auto'"):
        CandidatePicker(CandidatesConfig(k=k), seed=0)


def test_a_k_max_below_one_is_an_input_error():
    with pytest.raises(InputError, match="k_max is 0"):
        pick_candidates(three_clumps(), CandidatesConfig(k_max=0), seed=0)


def test_no_grasp_at_all_is_no_grasp():
    with pytest.raises(NoGrasp):
        pick_candidates(Grasps.empty(), CandidatesConfig(), seed=0)


@pytest.mark.parametrize(("text", "k"), [("{k: auto}", "auto"), ("{k: 4}", 4), ("{}", 6)])
def test_k_is_read_from_yaml_as_a_number_or_auto(text, k):
    assert yaml_load_typed(schema=CandidatesConfig, data=text).k == k


def test_k_may_be_given_as_text_as_the_command_does():
    picked = pick_candidates(three_clumps(), CandidatesConfig(k="3"), seed=0)
    assert len(picked) == 3


def test_the_stage_computes_once_per_input_and_keeps_the_joint_solutions():
    points = three_clumps()
    feasible = FeasibleGrasps(
        points.X_WG, points.width, points.score, points.p_WContact, rejected={"no_ik": 4}
    )
    picker = CandidatePicker(CandidatesConfig(k=3), seed=0)
    context = picker.CreateDefaultContext()
    picker.GetInputPort("feasible_grasps").FixValue(context, Value(feasible))
    port = picker.GetOutputPort("candidates")
    first = port.Eval(context)
    context.SetTime(1.0)
    assert port.Eval(context) is first
    assert len(first) == 3
    assert first.grasps.rejected == {"no_ik": 4}
