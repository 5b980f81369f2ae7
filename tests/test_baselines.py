import numpy as np
import pytest
from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoChoice
from tog_drake.selectors.baselines import RandomSelector, TopScoreSelector
from tog_drake.values import Candidates, Grasps, Intrinsics, View

VIEW = View(
    np.zeros((48, 64, 3), np.uint8),
    np.ones((48, 64), np.float32),
    Intrinsics(64, 48, 50, 50, 32, 24),
    np.eye(4),
)
CLOUD = PointCloud(0)


def candidates(score=(0.2, 0.9, 0.5, 0.4), index=(2, 3)):
    count = len(score)
    p = np.column_stack([np.linspace(-0.1, 0.1, count), np.zeros(count), np.full(count, 0.5)])
    grasps = Grasps(np.tile(np.eye(4), (count, 1, 1)), np.full(count, 0.03), np.array(score), p)
    return Candidates(grasps, np.array(index, dtype=np.int64), np.zeros(count, dtype=np.int64))


SELECTORS = [TopScoreSelector(), RandomSelector(seed=0)]


def test_top_score_takes_the_most_confident_of_all_grasps_not_of_the_candidates_alone():
    choice = TopScoreSelector().select(VIEW, CLOUD, candidates(), "hand me the hammer")
    assert choice.index == 1
    assert choice.grasp.score.tolist() == [0.9]
    assert (choice.status, choice.part) == ("ok", None)
    assert "0.90" in choice.reason


def test_the_pixel_is_where_the_view_shows_the_contact():
    choice = TopScoreSelector().select(VIEW, CLOUD, candidates(score=(1.0, 0.0)), "grab it")
    assert choice.pixel == pytest.approx((32 - 50 * 0.1 / 0.5, 24))


def test_random_takes_each_candidate_and_nothing_else():
    seen = {
        RandomSelector(seed=seed).select(VIEW, CLOUD, candidates(), "grab it").index
        for seed in range(30)
    }
    assert seen == {2, 3}


def test_random_repeats_itself_under_the_same_seed():
    selector = RandomSelector(seed=5)
    picked = candidates(score=np.linspace(0, 1, 50), index=range(50))
    first = selector.select(VIEW, CLOUD, picked, "grab it")
    assert selector.select(VIEW, CLOUD, picked, "grab it").index == first.index


@pytest.mark.parametrize("selector", SELECTORS)
def test_without_a_candidate_there_is_no_choice(selector):
    with pytest.raises(NoChoice):
        selector.select(VIEW, CLOUD, Candidates.empty(), "grab it")


@pytest.mark.parametrize("selector", SELECTORS)
def test_an_empty_task_is_an_input_error_even_where_the_task_is_not_read(selector):
    with pytest.raises(InputError, match="no words"):
        selector.select(VIEW, CLOUD, candidates(), " ")
