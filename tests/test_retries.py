"""An episode whose first grasp closes on air: the robot feels it, looks again and does better."""

from dataclasses import replace

import numpy as np
import pytest

from tog_drake import pipeline
from tog_drake.episode import run_episode
from tog_drake.panda import grasps_apart
from tog_drake.scenario import load_scenario
from tog_drake.values import Grasps

SETTINGS = """
pipeline:
  retries: 1
  selector: !TopScore {}
  trajectory: {speed: 1.0, lift_speed: 0.5, hold_time: 2.05}
  executor: {look_time: 0.6}
"""
TOO_HIGH = 0.09  # [m]


class _WithBadOnesFirst:
    """A proposer whose most confident grasps are 9 cm too high, all about the same place."""

    def __init__(self, proposer):
        self._proposer = proposer

    def propose(self, cloud, view):
        good = self._proposer.propose(cloud, view)
        bad = good.take(np.zeros(3, np.int64))
        bad.X_WG[:, 2, 3] += TOO_HIGH + np.array([0.0, 0.01, 0.02])
        bad = replace(bad, score=np.array([1.0, 0.999, 0.998]))
        columns = ("X_WG", "width", "score", "p_WContact")
        return Grasps(*(np.concatenate([getattr(g, c) for g in (bad, good)]) for c in columns))


def _stand_for_questions(decision):
    return (decision.choice.grasp.score[0],)


@pytest.fixture(scope="module")
def episode():
    make_proposer = pipeline.make_proposer
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "make_proposer", lambda *a: _WithBadOnesFirst(make_proposer(*a)))
        patch.setattr("tog_drake.episode.exchanges_of", _stand_for_questions)
        return run_episode(load_scenario("Hammer", SETTINGS), name="Hammer", task="use the hammer")


def test_a_grasp_that_held_nothing_is_followed_by_one_that_holds(episode):
    record = episode.record
    assert (record["outcome"], record["message"]) == ("lifted", None)
    assert record["sim"]["seconds"] > 10


def test_every_attempt_is_recorded_with_what_the_hand_felt(episode):
    first, second = episode.record["attempts"]
    assert first["choice"]["score"] == 1.0
    assert first["opening"] < 0.002
    assert second["choice"] == episode.record["choice"]
    assert second["opening"] > 0.005


def test_what_a_model_was_asked_at_the_first_look_is_kept_apart_from_the_last(episode):
    assert episode.exchanges_before == (1.0,)


def test_the_second_grasp_is_unlike_the_one_that_failed(episode):
    assert episode.record["rejected"]["failed_before"] == 3
    failed = episode.decision.grasps.X_WG[0]
    place, _ = grasps_apart(episode.decision.motion.grasp.X_WG[0], failed)
    assert place > 0.03
