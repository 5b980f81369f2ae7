import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.perception import PointCloud

from tog_drake.errors import NoChoice
from tog_drake.selector import GraspSelector
from tog_drake.selectors.baselines import TopScoreSelector
from tog_drake.values import Candidates, Choice, Grasps, View


class Scripted:
    """A selector that counts its calls and returns what it was given."""

    def __init__(self, answer):
        self.answer = answer
        self.tasks = []

    def select(self, view, cloud, candidates, task):
        self.tasks.append(task)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def stage(selector, task="hand me the hammer"):
    system = GraspSelector(selector)
    context = system.CreateDefaultContext()
    inputs = {"view": View.empty(), "cloud": PointCloud(0), "candidates": Candidates.empty()}
    for name, value in (inputs | {"task": task}).items():
        system.GetInputPort(name).FixValue(context, Value(value))
    return system, context


def test_it_selects_once_per_task_and_inputs():
    selector = Scripted(Choice.none())
    system, context = stage(selector)
    port = system.GetOutputPort("choice")
    port.Eval(context)
    context.SetTime(1.0)
    port.Eval(context)
    assert selector.tasks == ["hand me the hammer"]
    system.GetInputPort("task").FixValue(context, Value("use it"))
    port.Eval(context)
    assert selector.tasks == ["hand me the hammer", "use it"]


def test_an_error_of_the_selector_reaches_the_caller_with_its_words():
    system, context = stage(Scripted(NoChoice("two red mugs")))
    with pytest.raises(NoChoice, match="two red mugs"):
        system.GetOutputPort("choice").Eval(context)


def test_the_choice_on_the_port_is_the_selectors():
    grasps = Grasps(np.eye(4)[None], np.array([0.03]), np.array([0.5]), np.array([[0, 0, 1.0]]))
    picked = Candidates(grasps, np.zeros(1, np.int64), np.zeros(1, np.int64))
    system, context = stage(TopScoreSelector())
    system.GetInputPort("candidates").FixValue(context, Value(picked))
    choice = system.GetOutputPort("choice").Eval(context)
    assert (choice.index, choice.status) == (0, "ok")
