"""Which of several views is shown, by any scorer."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake.errors import InputError, NoView
from tog_drake.pipeline import PipelineConfig, used_cameras
from tog_drake.task import target_words
from tog_drake.values import CameraView, Candidates
from tog_drake.view_scorers.coverage import Coverage
from tog_drake.view_selection import HandScorer, Scores, ViewSelector, select_view

VIEWS = tuple(
    CameraView(name, look([TABLE, HAMMER_SIZED], eye=eye, width=16, height=12))
    for name, eye in (("wrist", (0.25, 0.0, 0.45)), ("side_1", (0.7, 0.1, 0.4)))
)


class Scripted:
    """A scorer that says what it was told to say, and remembers what it was asked."""

    def __init__(self, answer):
        self.answer = answer
        self.targets = []

    def score(self, views, cloud, candidates, target, task):
        self.targets.append(target)
        if isinstance(self.answer, Exception):
            raise self.answer
        return Scores(self.answer, "as told")


def select(scorer, task="hand me the red mug", **kwargs):
    return select_view(scorer, VIEWS, PointCloud(0), Candidates.empty(), task, **kwargs)


def test_the_view_with_the_highest_score_is_shown_and_every_score_is_kept():
    selected = select(Scripted((0.2, 0.7)))
    assert (selected.camera, selected.status, selected.reason) == ("side_1", "ok", "as told")
    assert selected.view is VIEWS[1].view
    assert selected.scores == {"wrist": 0.2, "side_1": 0.7}


def test_of_equal_views_the_pipelines_own_is_shown():
    assert select(Scripted((0.5, 0.5))).camera == "wrist"


def test_where_no_view_shows_the_target_the_own_camera_is_shown_and_it_is_said():
    selected = select(Scripted((0.0, 0.0)))
    assert (selected.camera, selected.status) == ("wrist", "not_found")


def test_the_own_camera_is_shown_where_nothing_is_compared():
    selected = select(HandScorer())
    assert (selected.camera, selected.status) == ("wrist", "ok")


def test_the_task_names_the_target_unless_it_is_given():
    scorer = Scripted((1.0, 0.0))
    select(scorer)
    select(scorer, target="blue cup")
    assert scorer.targets == ["red mug", "blue cup"]


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("use the hammer to drive a nail", "hammer"),
        ("take the red one", "red"),
        ("pick it up", ""),
        ("", ""),
    ],
)
def test_the_words_of_the_target_are_colour_and_noun_as_far_as_there_are_any(task, words):
    assert target_words(task) == words


def stage(scorer):
    system = ViewSelector(scorer)
    context = system.CreateDefaultContext()
    inputs = {"views": VIEWS, "cloud": PointCloud(0), "candidates": Candidates.empty()}
    for name, value in (inputs | {"task": "use the hammer"}).items():
        system.GetInputPort(name).FixValue(context, Value(value))
    return system, context


def test_it_asks_once_per_task_and_inputs():
    scorer = Scripted((0.1, 0.2))
    system, context = stage(scorer)
    port = system.GetOutputPort("selected_view")
    assert port.Eval(context).camera == "side_1"
    context.SetTime(1.0)
    port.Eval(context)
    assert scorer.targets == ["hammer"]
    system.GetInputPort("task").FixValue(context, Value("use the mug"))
    port.Eval(context)
    assert scorer.targets == ["hammer", "mug"]


def test_a_scorer_that_cannot_tell_ends_the_episode_and_no_view_is_taken_in_its_place():
    system, context = stage(Scripted(NoView("the server is down", status="unreachable")))
    with pytest.raises(NoView, match="the server is down") as raised:
        system.GetOutputPort("selected_view").Eval(context)
    assert (raised.value.outcome, raised.value.status) == ("no_view", "unreachable")


def config(*, compare=False, fuse=False):
    made = PipelineConfig()
    made.cloud.fuse = fuse
    if compare:
        made.view_selection.scorer = Coverage()
    return made


def test_only_the_own_camera_is_read_where_views_are_neither_compared_nor_fused():
    there = ["side_1", "wrist", "side_2"]
    assert used_cameras(config(), there) == ("wrist",)
    every = ("wrist", "side_1", "side_2")
    assert used_cameras(config(compare=True), there) == every
    assert used_cameras(config(fuse=True), there) == every


def test_one_camera_is_too_few_to_compare_or_to_fuse():
    for made in (config(compare=True), config(fuse=True)):
        with pytest.raises(InputError, match=r"one camera, wrist.*--side-cameras"):
            used_cameras(made, ["wrist"])


def test_a_camera_that_is_not_there_is_named_with_those_that_are():
    with pytest.raises(InputError, match="no camera 'wrist'; valid: side_1, side_2"):
        used_cameras(config(), ["side_1", "side_2"])


def test_scores_of_another_number_than_the_views_are_a_defect_that_is_not_hidden():
    with pytest.raises(ValueError, match="zip"):
        select(Scripted((np.float64(0.5),)))
