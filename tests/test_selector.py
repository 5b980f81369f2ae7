import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.perception import PointCloud

from tog_drake.errors import NoChoice
from tog_drake.selector import ALTERNATIVES, GraspSelector, choose
from tog_drake.selectors.baselines import TopScoreSelector
from tog_drake.values import Candidates, Choice, Grasps, SelectedView, View


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
    inputs = {
        "selected_view": SelectedView.none(),
        "cloud": PointCloud(0),
        "candidates": Candidates.empty(),
    }
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


def row_of_grasps(x, cluster=None):
    """Grasps at x [m], best first; one in sight of the camera at W would be."""
    X_WG = np.tile(np.eye(4), (len(x), 1, 1))
    X_WG[:, 0, 3], X_WG[:, 2, 3] = x, 1.0
    score = np.linspace(1.0, 0.5, len(x))
    grasps = Grasps(X_WG, np.full(len(x), 0.03), score, X_WG[:, :3, 3])
    cluster = np.zeros(len(x), np.int64) if cluster is None else np.array(cluster)
    return Candidates(grasps, np.zeros(1, np.int64), cluster)


def test_a_choice_names_the_most_confident_of_its_cluster_to_try_in_its_place():
    candidates = row_of_grasps([0.0, 0.1, 0.2, 0.3, 0.4], cluster=[0, 1, 0, 1, 0])
    assert choose(2, View.empty(), candidates, "").alternatives == (0, 4)


def test_a_selector_that_knows_the_worth_of_each_grasp_decides_what_to_try_instead():
    candidates = row_of_grasps([0.0, 0.1, 0.2, 0.3, 0.4], cluster=[0, 1, 2, 3, 4])
    worth = np.array([1.0, -np.inf, 5.0, 2.0, 3.0])
    choice = choose(2, View.empty(), candidates, "", worth=worth)
    assert choice.alternatives == (4, 3, 0)


def test_alternatives_are_few_and_differ_from_the_choice_and_from_each_other():
    candidates = row_of_grasps(np.arange(0, 0.5, 0.011))
    turned = candidates.grasps.X_WG[::2]
    turned[:, :2, :2] *= -1  # half a turn about z_G is no other grasp
    alternatives = choose(0, View.empty(), candidates, "").alternatives
    assert len(alternatives) == ALTERNATIVES
    x = candidates.grasps.X_WG[[0, *alternatives], 0, 3]
    np.testing.assert_allclose(x, 0.022 * np.arange(6), atol=1e-9)


def test_a_choice_without_another_of_its_kind_has_no_alternative():
    candidates = row_of_grasps([0.0, 0.1], cluster=[0, 1])
    assert choose(1, View.empty(), candidates, "").alternatives == ()
