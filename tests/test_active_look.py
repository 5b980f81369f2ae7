"""An episode in which the arm looks a second time at a bottle that it saw from above."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tog_drake.cloud import scene_cloud
from tog_drake.episode import run_episode
from tog_drake.hardware.config import HardwareConfig
from tog_drake.safety import SafetyConfig
from tog_drake.scenario import load_scenario

SETTINGS = """
pipeline:
  cloud: {fuse: false}
  look: !Active {max_looks: 1}
  view_selection: {scorer: !Coverage {}}
  trajectory: {speed: 1.0, lift_speed: 0.5, hold_time: 2.05}
  executor: {look_time: 0.6}
"""


def run(hardware=None, **executor):
    scenario = load_scenario("BottleFromAbove", SETTINGS)
    scenario.cameras = {"wrist": scenario.cameras["wrist"]}
    scenario.hardware = hardware
    for setting, value in executor.items():
        setattr(scenario.pipeline.executor, setting, value)
    return run_episode(scenario, name="BottleFromAbove", task="hand me the bottle")


@pytest.fixture(scope="module")
def episode():
    return run()


def test_the_second_look_is_recorded_with_what_it_was_worth(episode):
    (look,) = episode.record["attempts"][0]["looks"]
    assert look["shown"] < 0.25
    assert look["expected"] > look["shown"] + 0.2
    assert look["duration"] > 0.5
    assert look["planning"] > 0


def test_the_camera_was_where_the_look_was_planned_to_be(episode):
    now, first = episode.decision.views
    assert (now.camera, first.camera) == ("wrist", "wrist#1")
    planned = np.array(episode.record["attempts"][0]["looks"][0]["X_WC"])
    np.testing.assert_allclose(now.view.X_WC[:3, 2:], planned[:3, 2:], atol=0.005)
    assert np.linalg.norm(now.view.X_WC[:3, 3] - first.view.X_WC[:3, 3]) > 0.2


def test_the_clearer_of_both_looks_is_shown(episode):
    selection = episode.record["view_selection"]
    assert selection["camera"] == "wrist"
    assert selection["scores"]["wrist"] > 1.2 * selection["scores"]["wrist#1"]


def test_the_cloud_is_of_both_looks(episode):
    p_W = episode.decision.cloud.xyzs().T
    first = episode.decision.views[1].view
    low = p_W[p_W[:, 2] < 0.5 * p_W[:, 2].max()]
    assert len(low) > 200  # which the first look does not show
    assert np.linalg.norm(first.X_WC[:2, 3] - p_W[:, :2].mean(axis=0)) < 0.05


def test_then_the_bottle_is_grasped_and_nothing_was_touched_on_the_way(episode):
    record = episode.record
    assert record["outcome"] == "lifted", record["message"]
    assert record["collisions"] == {}


def test_an_arm_that_does_not_follow_on_the_way_to_a_look_ends_the_episode_and_it_is_recorded():
    record = run(max_tracking_error=0.0005).record
    assert record["outcome"] == "collision"
    assert "no longer followed its command" in record["message"]
    assert len(record["attempts"][0]["looks"]) == 1
    assert (record["choice"], record["motion"]) == (None, None)
    assert json.loads(json.dumps(record)) == record


def test_a_way_to_a_look_that_is_not_safe_is_not_begun_and_that_is_recorded():
    record = run(HardwareConfig(safety=SafetyConfig(hand_speed=0.05))).record
    assert record["outcome"] == "stopped"
    assert "hand_speed" in record["message"]
    assert len(record["attempts"][0]["looks"]) == 1
    assert record["grasp_success"] is False


def test_an_image_of_holes_alone_ends_the_episode_and_it_is_recorded(monkeypatch):
    cloud = scene_cloud

    def blind(views, *rest):
        return cloud([replace(v, depth=np.zeros_like(v.depth)) for v in views], *rest)

    monkeypatch.setattr("tog_drake.cloud.scene_cloud", blind)
    record = run().record
    assert record["outcome"] == "no_image"
    assert "pixels of the depth image are holes" in record["message"]
    assert record["attempts"][0]["looks"][0]["reason"].startswith("No further look: all")
