"""The stage around a proposer; what proposers propose is tested beside each of them."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.perception import PointCloud

from tog_drake.errors import NoGrasp
from tog_drake.proposer import GraspProposer
from tog_drake.values import Grasps, Intrinsics, View


class Scripted:
    """A proposer that returns what it was given, and keeps what it saw."""

    def __init__(self, grasps):
        self.grasps = grasps
        self.seen = []

    def propose(self, cloud, view):
        self.seen.append((cloud.size(), view.intrinsics.width))
        return self.grasps


def one_grasp():
    return Grasps(np.eye(4)[None], np.array([0.03]), np.array([0.7]), np.zeros((1, 3)))


def view_of(width):
    image = np.zeros((2, width, 3), np.uint8)
    camera = Intrinsics(width, 2, 1.0, 1.0, 0.0, 0.0)
    return View(image, np.zeros((2, width), np.float32), camera, np.eye(4))


def evaluate(stage, cloud):
    context = stage.CreateDefaultContext()
    stage.GetInputPort("cloud").FixValue(context, Value(cloud))
    stage.GetInputPort("view").FixValue(context, Value(view_of(7)))
    return context, stage.GetOutputPort("grasps").Eval(context)


def test_the_stage_passes_cloud_and_view_on_and_the_grasps_out():
    proposer = Scripted(one_grasp())
    _, grasps = evaluate(GraspProposer(proposer), PointCloud(5))
    assert proposer.seen == [(5, 7)]
    assert grasps.width.tolist() == [0.03]


def test_it_proposes_once_per_cloud_and_view():
    proposer = Scripted(one_grasp())
    stage = GraspProposer(proposer)
    context, _ = evaluate(stage, PointCloud(5))
    context.SetTime(2.0)
    stage.GetOutputPort("grasps").Eval(context)
    assert proposer.seen == [(5, 7)]
    stage.GetInputPort("cloud").FixValue(context, Value(PointCloud(6)))
    stage.GetOutputPort("grasps").Eval(context)
    assert proposer.seen == [(5, 7), (6, 7)]
    stage.GetInputPort("view").FixValue(context, Value(view_of(8)))
    stage.GetOutputPort("grasps").Eval(context)
    assert proposer.seen == [(5, 7), (6, 7), (6, 8)]


def test_no_proposal_is_no_grasp_and_says_what_may_be_the_matter():
    with pytest.raises(NoGrasp, match="no grasp proposed on the 5 points"):
        evaluate(GraspProposer(Scripted(Grasps.empty())), PointCloud(5))


def test_an_error_of_the_proposer_reaches_the_caller_as_it_is():
    class Broken:
        def propose(self, cloud, view):
            raise ValueError("weights missing")

    with pytest.raises(ValueError, match="weights missing"):
        evaluate(GraspProposer(Broken()), PointCloud(5))
