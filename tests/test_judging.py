"""A model judges grasps: it sees the scene and one hand, and its word is data."""

from dataclasses import replace

import numpy as np
import pytest
from test_strategies import bar_scene
from test_vlm_selector import cloud_of, saying
from vlm_server import KEY, Spoken

from tog_drake.benchmark.judging import VlmJudge, grasp_pictures, vlm_judge
from tog_drake.decision import Decision
from tog_drake.errors import InputError
from tog_drake.values import Choice, GraspMotion

SCENE = bar_scene(n=9)
TASK = 'hand me the bar "now"'


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def decision(row=4, **changes):
    grasp = SCENE.candidates.grasps.take(np.array([row]))
    choice = Choice(index=row, grasp=grasp, reason="")
    cloud = cloud_of(SCENE.points)
    return replace(
        Decision(SCENE.view, cloud, candidates=SCENE.candidates, choice=choice), **changes
    )


def judged(*texts, of=None):
    with saying(*texts) as server:
        judge = VlmJudge(f"vlm:openai:any@{server.base_url('openai')}")
        return judge.judge(of or decision(), TASK), server.received


@pytest.mark.parametrize(("label", "complies"), [("1", True), ("2", False)])
def test_what_the_model_says_is_what_is_recorded(label, complies):
    said, received = judged(f"The bar's end is held.\nFinal answer: {label}")
    assert (said["complies"], said["status"]) == (complies, "ok")
    assert said["model"].startswith("openai:any@")
    (asked,) = received
    assert len(asked.images) == 2
    assert '"hand me the bar \\"now\\""' in asked.text


@pytest.mark.parametrize(
    ("text", "status"),
    [("Both would do.", "unreadable"), (Spoken(None, finish="refusal", refusal="no"), "refused")],
)
def test_an_answer_of_no_use_is_neither_yes_nor_no(text, status):
    said, _ = judged(text)
    assert said["complies"] is None
    assert said["status"] == status


def test_a_model_that_was_unclear_is_asked_once_more():
    said, received = judged("Well.", "Final answer: 2")
    assert said["complies"] is False
    assert len(received) == 2


def test_without_a_choice_nothing_is_asked():
    said, received = judged("1", of=decision(choice=None))
    assert said is None
    assert not received


def test_the_pictures_differ_by_the_one_hand_that_moved():
    plain, drawn = grasp_pictures(decision(4))
    assert plain.shape == drawn.shape
    changed = (plain != drawn).any(axis=2)
    assert 0.001 < changed.mean() < 0.2


def test_what_is_judged_is_the_chosen_grasp_also_where_another_one_is_carried_out():
    _, drawn = grasp_pictures(decision(4))
    other = replace(GraspMotion.still(), grasp_index=0)
    np.testing.assert_array_equal(grasp_pictures(decision(4, motion=other))[1], drawn)
    assert (grasp_pictures(decision(0))[1] != drawn).any()


def test_a_process_has_one_judge_for_all_grasps_of_a_run():
    assert vlm_judge("vlm:openai:gpt-6") is vlm_judge("vlm:openai:gpt-6")
    assert vlm_judge("vlm:openai:gpt-7") is not vlm_judge("vlm:openai:gpt-6")


@pytest.mark.parametrize("wanted", ["gemini:x", "vlm:", "vlm:nobody:x", ""])
def test_a_judge_that_is_no_model_is_refused_with_what_would_be_valid(wanted):
    with pytest.raises(InputError, match="gemini:MODEL"):
        VlmJudge(wanted)


def test_a_judge_without_its_key_is_refused_before_anything_runs(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(InputError, match="OPENAI_API_KEY"):
        VlmJudge("vlm:openai:gpt-6")
