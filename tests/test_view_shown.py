"""What a model can choose depends on the view that it is shown; two cases are built for it.

The model is ``pointing_model``: it points at what it sees. The grasps are the same in all views.
"""

import pytest
from pointing_model import point_and_answer
from vlm_server import VlmServer, plant_keys

from tog_drake.episode import run_episode
from tog_drake.judge import COMPLIANT_SHARE
from tog_drake.scenario import load_scenario
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.selectors.vlm.specification import read_specification

PART = {"MugHandleHidden": "handle", "BottleFromAbove": "body"}
TASK = {
    "MugHandleHidden": "drink from the mug",
    "BottleFromAbove": "pick up the bottle by its label",
}
STOPPED = "executor: {max_tracking_error: 1.0e-9}"  # what was chosen is known by then


@pytest.fixture(scope="module")
def server():
    with VlmServer(point_and_answer, key=None) as server:
        yield server


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    plant_keys(monkeypatch)


def chosen(server, case, pipeline, *, wrist_alone=False):
    """The record of an episode, and the share of the part for the task in what was chosen."""
    scenario = load_scenario(case, f"pipeline: {{{pipeline}}}")
    if wrist_alone:
        scenario.cameras = {"wrist": scenario.cameras["wrist"]}
    model = read_specification(server.specification("openai"), profile=None)
    scenario.pipeline.selector = Vlm(strategy="cpg", model=model)
    record = run_episode(scenario, name=case, task=TASK[case]).record
    return record, record["chosen_closes_on"].get(PART[case], 0.0)


@pytest.mark.parametrize("case", PART)
def test_a_model_fails_on_the_hands_view_and_succeeds_on_the_least_ambiguous_one(server, case):
    hand, share = chosen(server, case, STOPPED)
    assert share < 1 - COMPLIANT_SHARE
    least_ambiguous, share_then = chosen(
        server, case, f"{STOPPED}, view_selection: {{scorer: !Coverage {{}}}}"
    )
    assert share_then >= COMPLIANT_SHARE
    assert least_ambiguous["view_selection"]["camera"].startswith("side_")
    same = ("proposed", "feasible", "candidates")
    assert [hand["counts"][k] for k in same] == [least_ambiguous["counts"][k] for k in same]


def test_a_model_succeeds_on_a_view_that_the_wrist_camera_went_to(server):
    record, share = chosen(
        server,
        "BottleFromAbove",
        "look: !Active {}, cloud: {fuse: false}, view_selection: {scorer: !Coverage {}}",
        wrist_alone=True,
    )
    assert share >= COMPLIANT_SHARE
    assert record["combined_success"]
    looks = record["attempts"][0]["looks"]
    assert len(looks) > 1
    assert record["view_selection"]["camera"].startswith("wrist")
