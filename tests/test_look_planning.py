"""Whether and from where the camera at the hand looks again, on views made by hand."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from tabletop import TABLE, look

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import InputError, NoFeasibleGrasp, NoPlan, NoProposal
from tog_drake.look_planning import Active, LookPlanner, LookWays, plan_look
from tog_drake.panda import A_MAX, MAX_OPENING, Q_LOWER, Q_UPPER, V_MAX
from tog_drake.planning_model import MakePlanningModel
from tog_drake.transfer import TransferConfig
from tog_drake.values import CameraView, Candidates, Workspace

Q_NOW = np.array([0.0, -0.9564, 0.0, -2.7824, 0.0, 2.2558, 0.7853])
EYE = (0.35, 0.0, 0.52)  # of a camera at the hand of an arm that is there
POST = ((0.50, -0.02, 0.0), (0.54, 0.02, 0.18), (200, 0, 0))
PLATE = ((0.46, -0.05, 0.0), (0.58, 0.05, 0.012), (200, 0, 0))


@cache
def ways():
    return LookWays(MakePlanningModel(), 0.6, 0.02, TransferConfig(), seed=0)


class NoWay:
    """An arm that gets nowhere, and counts how often it was asked."""

    def __init__(self):
        self.planning_model = ways().planning_model
        self.seed = 0
        self.asked = []

    def posture(self, X_WC, X_HC, q_now, obstacles):
        return q_now

    def plan(self, q_look, q_now, obstacles):
        self.asked.append(q_look)
        raise NoPlan("hemmed in")


@cache
def seen(box, eye=EYE):
    """The view of a box by the camera at the hand, and its cloud."""
    view = look([TABLE, box], eye=eye, target=(0.52, 0.0, 0.05))
    return CameraView("wrist", view), scene_cloud([view], Workspace(), CloudConfig())


def plan(box, *, with_ways=None, earlier=(), **config):
    own, cloud = seen(box)
    active = Active(**config)
    return plan_look(
        (own, *earlier), cloud, "", Q_NOW, with_ways or ways(), active, 0.0,
        least_gain=active.least_gain,
    )  # fmt: skip


@pytest.fixture(scope="module")
def next_look():
    return plan(POST)


def test_a_look_at_the_far_side_of_a_post_is_planned_and_leads_to_where_it_says(next_look):
    assert next_look.expected > next_look.shown + 0.15
    motion, model = next_look.motion, ways().planning_model
    np.testing.assert_allclose(motion.arm.value(0.0).ravel(), Q_NOW, atol=1e-9)
    own, _ = seen(POST)
    X_HC = np.linalg.inv(model.X_WH(Q_NOW)) @ own.view.X_WC
    X_WC = model.X_WH(motion.arm.value(motion.duration).ravel()) @ X_HC
    np.testing.assert_allclose(X_WC[:3, 2:], next_look.X_WC[:3, 2:], atol=1e-6)  # but for its roll
    shows = (POST[0][0] + 0.02 - X_WC[0, 3], -X_WC[1, 3], 0.09 - X_WC[2, 3])
    np.testing.assert_allclose(shows / np.linalg.norm(shows), X_WC[:3, 2], atol=0.1)


def test_the_way_obeys_the_limits_is_free_and_keeps_the_hand_open(next_look):
    arm, duration = next_look.motion.arm, next_look.motion.duration
    times = np.linspace(0, duration, 200)
    q = arm.vector_values(times).T
    assert ((q > Q_LOWER) & (q < Q_UPPER)).all()
    assert (np.abs(arm.MakeDerivative(1).vector_values(times).T) <= 0.6 * V_MAX * 1.001).all()
    assert (np.abs(arm.MakeDerivative(2).vector_values(times).T) <= 0.36 * A_MAX * 1.001).all()
    assert ways().planning_model.check_configs(q[::10], MAX_OPENING).all()
    np.testing.assert_allclose(next_look.motion.hand.vector_values(times), MAX_OPENING)


def test_the_present_view_is_remembered_with_the_arms_posture_under_a_name_of_its_own(next_look):
    own, _ = seen(POST)
    assert next_look.left.camera == "wrist#1"
    assert next_look.left.view is own.view
    np.testing.assert_array_equal(next_look.left.q, Q_NOW)
    earlier = replace(next_look.left, view=replace(own.view, depth=0 * own.view.depth))
    assert plan(POST, earlier=[earlier]).left.camera == "wrist#2"


def test_what_earlier_views_show_is_no_gain():
    once = plan(POST, with_ways=NoWay())
    behind, _ = seen(POST, eye=(0.9, 0.0, 0.3))
    twice = plan(POST, with_ways=NoWay(), earlier=[behind])
    assert twice.shown > once.shown + 0.1


def test_of_a_plate_that_was_seen_nothing_is_left_to_look_at():
    found = plan(PLATE)
    assert found.motion is None
    assert "no further look would add more than 15%" in found.reason


def test_where_no_better_place_is_reached_it_says_so_and_gives_up_in_time():
    no_way = NoWay()
    found = plan(POST, with_ways=no_way)
    assert found.motion is None
    assert "better places is reached" in found.reason
    assert 1 < len(no_way.asked) <= 4


def test_a_camera_that_is_not_on_the_hand_cannot_be_moved():
    far, cloud = seen(POST, eye=(0.9, 0.0, 0.3))
    with pytest.raises(InputError, match=r"wrist is 0\.\d+ m away"):
        plan_look((far,), cloud, "", Q_NOW, ways(), Active(), 0.0, least_gain=0.1)


class Scripted(LeafSystem):
    """A stage that gives candidates or raises."""

    def __init__(self, said):
        super().__init__()
        self._said = said
        self.DeclareAbstractOutputPort("out", lambda: Value(Candidates.empty()), self._Calc)

    def _Calc(self, context, output):
        if isinstance(self._said, Exception):
            raise self._said
        output.set_value(self._said)


def stage(box, candidates, with_ways):
    builder = DiagramBuilder()
    said = builder.AddSystem(Scripted(candidates))
    planner = builder.AddSystem(LookPlanner(Active(least_gain=0.9), Workspace(), with_ways))
    builder.Connect(said.get_output_port(), planner.GetInputPort("candidates"))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = planner.GetMyContextFromRoot(root)
    own, cloud = seen(box)
    for name, value in {"views": (own,), "cloud": cloud, "task": "take it"}.items():
        planner.GetInputPort(name).FixValue(context, Value(value))
    planner.GetInputPort("panda.position_measured").FixValue(context, Q_NOW)
    return planner.GetOutputPort("next_look").Eval(context)


def test_where_no_grasp_is_found_any_look_that_shows_something_new_is_worth_it():
    no_way = NoWay()
    stage(POST, NoFeasibleGrasp("none", {}), no_way)
    assert len(no_way.asked) > 0


def test_where_there_are_candidates_the_gain_decides():
    no_way = NoWay()
    found = stage(POST, Candidates.empty(), no_way)
    assert found.motion is None
    assert no_way.asked == []


def test_an_error_that_no_look_could_mend_is_not_hidden():
    with pytest.raises(NoProposal, match="server down"):
        stage(POST, NoProposal("server down", "unreachable"), NoWay())


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"max_looks": 0}, "max_looks is 0; valid: 1 to 5"),
        ({"max_looks": 6}, "max_looks is 6"),
        ({"least_gain": 1.0}, r"least_gain \(1.0\) must be"),
        ({"distance": float("nan")}, r"distance \(nan\) above 0"),
    ],
)
def test_settings_out_of_bounds_are_refused(config, says):
    with pytest.raises(InputError, match=says):
        LookPlanner(Active(**config), Workspace(), ways())
