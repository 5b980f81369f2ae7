"""The network as a proposer: what it is shown, what is kept of its answers, and in which frame."""

import hashlib
import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from command import refused, tog
from pydrake.perception import PointCloud
from scipy.spatial.transform import Rotation
from synthetic_weights import synthetic_network, write_checkpoint
from tabletop import HAMMER_SIZED, TABLE, look

import tog_drake.proposers.contact_graspnet.prediction as prediction
import tog_drake.proposers.contact_graspnet.proposer as proposer
from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.errors import InputError, NoGrasp
from tog_drake.grasp_check import check_grasps, turned
from tog_drake.options import ProposerOptions
from tog_drake.proposers.contact_graspnet.decoding import hand_poses
from tog_drake.proposers.contact_graspnet.prediction import predict
from tog_drake.proposers.contact_graspnet.proposer import (
    X_NG,
    ContactGraspNet,
    ContactGraspNetProposer,
    selected,
)
from tog_drake.proposers.contact_graspnet.regions import (
    local_region,
    scene_points,
    things_of,
    with_count,
)
from tog_drake.proposers.contact_graspnet.selection import select
from tog_drake.record import OUTCOMES
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import Workspace

# A bar 20 cm long, 3 cm wide and high, along x of W, seen from its end and its side.
VIEW = look([TABLE, HAMMER_SIZED], eye=(0.3, 0.25, 0.45))
CLOUD = scene_cloud([VIEW], Workspace(), CloudConfig())


def rng(seed=0):
    return np.random.default_rng(seed)


# -- parity with the published pipeline ----------------------------------------------------------


@pytest.fixture(scope="module")
def network():
    return synthetic_network()


@pytest.fixture(scope="module")
def published(network, parity):
    points = np.load(parity / "input_pipeline.npz")["points_opencv"].astype(np.float64)
    return predict(network, points, 1, rng())


@pytest.mark.parametrize(("name", "count"), [("default", 200), ("strict", 147)])
def test_the_published_grasps_are_kept_in_the_cameras_frame(published, parity, name, count):
    recorded = np.load(parity / "output_pipeline.npz")
    config = ContactGraspNet(
        first_threshold=float(recorded[f"{name}_first_thres"]),
        second_threshold=float(recorded[f"{name}_second_thres"]),
    )
    kept = published.take(selected(published, config))
    assert len(kept.score) == count
    np.testing.assert_array_equal(kept.p_CContact, recorded[f"{name}_contact_pts"])
    np.testing.assert_allclose(kept.score, recorded[f"{name}_scores"], atol=2e-5)
    np.testing.assert_allclose(kept.X_CN, recorded[f"{name}_grasps"], atol=1e-3)
    # The published opening is 5 mm more than the distance between the contacts.
    np.testing.assert_allclose(kept.width + 0.005, recorded[f"{name}_openings"], atol=1e-6)


# -- what the network is shown -------------------------------------------------------------------


def test_every_pixel_between_the_limits_of_depth_becomes_a_point():
    depth = np.array([[0.0, 0.2, 0.5], [1.8, 1.0, 3.0]], np.float32)
    camera = replace(VIEW.intrinsics, width=3, height=2, fx=2.0, fy=4.0, cx=1.0, cy=0.5)
    view = replace(VIEW, depth=depth, intrinsics=camera)
    expected = [[0.5 * 1 / 2, 0.5 * -0.5 / 4, 0.5], [0.0, 1.0 * 0.5 / 4, 1.0]]
    np.testing.assert_allclose(scene_points(view, [0.2, 1.8]), expected, atol=1e-7)
    assert len(scene_points(view, [0.0, 9.0])) == 5  # a hole is no point


def test_of_too_many_points_a_random_choice_is_shown_and_too_few_are_copied():
    points = rng().normal(size=(50, 3))
    fewer = with_count(points, 20, rng())
    assert len(np.unique(fewer, axis=0)) == 20
    assert {*map(tuple, fewer)} <= {*map(tuple, points)}
    more = with_count(points, 70, rng())
    np.testing.assert_array_equal(more[:50], points)
    assert {*map(tuple, more[50:])} <= {*map(tuple, points)}
    np.testing.assert_array_equal(with_count(points, 50, rng()), points)


@pytest.mark.parametrize(("size", "side"), [(0.02, 0.2), (0.15, 0.3), (0.5, 0.6)])
def test_a_local_region_is_a_cube_twice_as_large_as_the_thing_within_limits(size, side):
    scene = rng().uniform(-0.5, 0.5, (20000, 3))
    thing = np.array([[0.1 - size / 2, 0, 0], [0.1, 0.01, 0], [0.1 + size / 2, 0, 0]])
    near = local_region(scene, thing) - [0.1, 0.005, 0]
    assert np.abs(near).max() < side / 2
    assert len(near) == ((np.abs(scene - [0.1, 0.005, 0]) < side / 2).all(axis=1)).sum()


def test_a_stray_point_does_not_move_a_local_region():
    scene = rng().uniform(-0.5, 0.5, (2000, 3))
    thing = rng().uniform(-0.05, 0.05, (100, 3))
    stray = np.vstack([thing, [[0.3, 0.3, 0.0]]])
    np.testing.assert_array_equal(local_region(scene, thing), local_region(scene, stray))


def test_things_that_are_apart_are_told_apart():
    grid = np.stack(np.meshgrid(*[np.arange(0, 0.03, 0.003)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    thing = things_of(np.vstack([grid, np.add(grid, [0.06, 0, 0])]))
    assert thing.tolist() == [0] * 100 + [1] * 100
    assert len(things_of(np.zeros((0, 3)))) == 0


# -- which grasps are kept -----------------------------------------------------------------------

LINE = np.column_stack([np.arange(6) / 10, np.zeros(6), np.zeros(6)])  # contacts 10 cm apart


def kept(score, *, contact=LINE, first=0.5, second=0.5, spread=2, most=3):
    score = np.array(score)
    return select(score, contact, first=first, second=second, spread=spread, most=most).tolist()


def test_confident_grasps_that_are_far_apart_are_kept_and_then_the_best():
    assert kept([0.6, 0.7, 0.9, 0.8, 0.7, 0.6]) == [0, 2, 5]  # 0 and 5 are farthest apart
    assert kept([0.6, 0.7, 0.9, 0.8, 0.7, 0.6], most=2) == [0, 5]


def test_where_few_are_confident_all_of_them_are_kept():
    assert kept([0.1, 0.7, 0.1, 0.6, 0.1, 0.1]) == [1, 3]
    assert kept([0.1] * 6) == []
    assert kept([0.9] + [0.1] * 5) == [0]  # the very first row alone counts as any other


def test_the_others_need_the_second_threshold_only():
    assert kept([0.7, 0.3, 0.4, 0.1, 0.1, 0.7], second=0.35, most=6) == [0, 2, 5]


def test_a_score_that_equals_a_threshold_is_not_above_it():
    assert kept([0.5] * 6) == []


def test_equal_contacts_are_kept_once_for_their_place():
    assert kept([0.9, 0.8, 0.7], contact=np.zeros((3, 3)), spread=2, most=2) == [0, 1]


# -- asking the network --------------------------------------------------------------------------


class Scripted:
    """A network that says at every point what ``answer`` makes of it, and keeps what it saw."""

    def __init__(self, answer):
        self.answer = answer
        self.seen = []

    def __call__(self, points):
        self.seen.append(points.numpy())
        contact, closing, approach, width, score = self.answer(points[0].double())
        return {
            "pred_grasps_cam": hand_poses(contact, closing, approach, width)[None].float(),
            "pred_scores": score[None, :, None].float(),
            "pred_points": contact[None].float(),
            "offset_pred": width[None, None].float(),
        }


def anywhere(points):
    """At each of the first ten points a grasp along the network's own axes."""
    contact = points[:10]
    axes = torch.eye(3, dtype=torch.float64).expand(10, 3, 3)
    return contact, axes[:, 0], axes[:, 2], torch.full((10,), 0.03), torch.linspace(0.9, 0.5, 10)


def test_the_network_sees_points_turned_by_half_a_turn_about_their_mean():
    points = rng().normal([0.1, 0.2, 0.9], size=(30, 3))
    network = Scripted(anywhere)
    said = predict(network, points, 1, rng())
    (seen,) = network.seen
    assert seen.dtype == np.float32 and seen.shape == (1, 30, 3)
    expected = Rotation.from_euler("z", 180, degrees=True).apply(points)
    np.testing.assert_allclose(seen[0], expected - expected.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(said.p_CContact, points[:10], atol=1e-6)  # and back


def test_further_passes_begin_with_another_point_and_are_the_same_every_time():
    points = rng().normal(size=(30, 3))
    network = Scripted(anywhere)
    first = predict(network, points, 3, rng(5))
    starts = [tuple(seen[0, 0]) for seen in network.seen]
    assert len(set(starts)) == 3
    for seen in network.seen[1:]:
        assert {*map(tuple, seen[0])} == {*map(tuple, network.seen[0][0])}
    assert len(first.score) == 30
    again = predict(Scripted(anywhere), points, 3, rng(5))
    np.testing.assert_array_equal(first.p_CContact, again.p_CContact)
    other = predict(Scripted(anywhere), points, 3, rng(6))
    np.testing.assert_array_equal(first.p_CContact[:10], other.p_CContact[:10])
    assert not np.array_equal(first.p_CContact, other.p_CContact)


def test_answers_that_are_no_pose_are_left_out():
    def broken(points):
        contact, closing, approach, width, score = anywhere(points)
        closing, approach, width = closing.clone(), approach.clone(), width.clone()
        closing[0], approach[1], width[2] = 0.0, closing[1], torch.inf
        return contact, closing, approach, width, score

    points = rng().normal(size=(30, 3))
    said = predict(Scripted(broken), points, 1, rng())
    np.testing.assert_allclose(said.p_CContact, points[3:10], atol=1e-6)


# -- the frames, on a bar whose right grasps are known -------------------------------------------


def wise(points):
    """Knows how the bar lies and how to hold it, and says so in the network's axes.

    It finds the bar's edges by itself: what rises above the lowest of the points. So it is right
    only if it is shown the points as a network is used to: x left, y up, z forward.
    """
    R = torch.from_numpy((VIEW.X_WC[:3, :3] @ np.diag([-1.0, -1.0, 1.0])).copy())  # to W's axes
    p = points @ R.T
    up = p[:, 2] - p[:, 2].min()
    top = p[up > 0.028, 1]
    side = p[:, 1] - (top.min() + top.max()) / 2
    at_edge = (up > 0.012) & (side.abs() > 0.013)
    contact, side = points[at_edge], side[at_edge]
    closing = -side.sign()[:, None] * R[1]
    approach = (-R[2]).expand(len(contact), 3)
    return contact, closing, approach, 2 * side.abs(), torch.linspace(0.9, 0.5, len(contact))


def propose(answer=wise, seed=0, **config):
    return ContactGraspNetProposer(ContactGraspNet(**config), Scripted(answer), seed).propose(
        CLOUD, VIEW
    )


def share_right(grasps):
    return np.mean([problem == "" for problem in check_grasps(grasps, CLOUD)])


def test_right_answers_become_right_grasps_in_the_world():
    grasps = propose()
    assert len(grasps) > 20
    closing, approach = grasps.X_WG[:, :3, 1], grasps.X_WG[:, :3, 2]
    np.testing.assert_allclose(np.abs(closing), np.tile([0, 1, 0], (len(grasps), 1)), atol=1e-6)
    np.testing.assert_allclose(approach, np.tile([0, 0, -1], (len(grasps), 1)), atol=1e-6)
    np.testing.assert_allclose(grasps.X_WG[:, 1, 3], 0.0, atol=0.002)  # in the bar's middle
    np.testing.assert_allclose(grasps.X_WG[:, 2, 3], grasps.p_WContact[:, 2], atol=1e-6)
    np.testing.assert_allclose(grasps.width, 0.03, atol=0.004)
    rotation = grasps.X_WG[:, :3, :3]
    np.testing.assert_allclose(
        rotation.swapaxes(1, 2) @ rotation, np.tile(np.eye(3), (len(grasps), 1, 1)), atol=1e-12
    )
    assert np.all(np.diff(grasps.score) <= 0)
    assert share_right(grasps) > 0.9


def test_the_check_knows_the_twins():
    grasps = propose()
    assert share_right(turned(grasps, 180)) == share_right(grasps)
    assert share_right(turned(grasps, 90)) == 0.0


def with_entries(rotation, translation):
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rotation, translation
    return X


@pytest.mark.parametrize(
    ("module", "name", "wrong"),
    [
        (proposer, "X_NG", with_entries(np.eye(3), X_NG[:3, 3])),
        (proposer, "X_NG", with_entries(X_NG[:3, :3], 0)),
        (proposer, "X_NG", with_entries(X_NG[:3, :3], -X_NG[:3, 3])),
        (prediction, "HALF_TURN", np.ones(3)),
        (prediction, "HALF_TURN", np.array([-1.0, 1, 1])),
        (prediction, "HALF_TURN", np.array([1.0, -1, 1])),
    ],
    ids=["closes along x", "0.1034 m forgotten", "0.1034 m backwards", "no half turn",
         "x mirrored", "y mirrored"],
)  # fmt: skip
def test_mistakes_in_the_frames_are_caught_by_the_check(monkeypatch, module, name, wrong):
    monkeypatch.setattr(module, name, wrong)
    assert share_right(propose()) == 0


# -- what the proposer makes of it all ------------------------------------------------------------


def everywhere(points):
    """At each of the first 2000 points a grasp along the network's own axes."""
    axes = torch.eye(3, dtype=torch.float64).expand(2000, 3, 3)
    width, score = torch.full((2000,), 0.03), torch.linspace(0.99, 0.5, 2000)
    return points[:2000], axes[:, 0], axes[:, 2], width, score


def test_contacts_that_are_not_on_the_things_fall_away():
    grasps = propose(everywhere)
    assert 20 < len(grasps) <= 200
    x, y, z = grasps.p_WContact.T
    assert (x > 0.399).all() and (x < 0.601).all() and (np.abs(y) < 0.016).all()
    assert (z > 0).all() and (z < 0.031).all()


def test_the_whole_scene_is_shown_once_and_a_local_region_for_each_thing():
    one, other = HAMMER_SIZED, ((0.45, 0.10, 0.0), (0.50, 0.15, 0.05), HAMMER_SIZED[2])
    view = look([TABLE, one, other])
    cloud = scene_cloud([view], Workspace(), CloudConfig())
    for regions, times in (("scene", 1), ("local", 2)):
        network = Scripted(everywhere)
        config = ContactGraspNet(regions=regions)
        ContactGraspNetProposer(config, network, 0).propose(cloud, view)
        assert [seen.shape for seen in network.seen] == [(1, 20000, 3)] * times
        width = [np.ptp(seen[0], axis=0).max() for seen in network.seen]
        assert (min(width) > 0.5) == (regions == "scene")


def test_the_same_seed_proposes_the_same_and_another_seed_shows_other_pixels():
    first = propose(seed=3)
    np.testing.assert_array_equal(first.X_WG, propose(seed=3).X_WG)
    other = propose(seed=4)
    assert first.X_WG.shape != other.X_WG.shape or not np.array_equal(first.X_WG, other.X_WG)


def test_where_nothing_is_seen_the_network_is_not_asked():
    network = Scripted(wise)
    quiet = ContactGraspNetProposer(ContactGraspNet(), network, 0)
    with pytest.raises(NoGrasp, match="0 points of things"):
        quiet.propose(PointCloud(0), VIEW)
    with pytest.raises(NoGrasp, match=r"0 pixels from 0\.2 to 1\.8 m away"):
        quiet.propose(CLOUD, replace(VIEW, depth=np.zeros_like(VIEW.depth)))
    assert network.seen == []


def test_where_no_grasp_is_left_it_says_why():
    def elsewhere(points):
        contact, *others = anywhere(points)
        return contact + 1.0, *others

    def unsure(points):
        *others, score = wise(points)
        return *others, score / 10

    with pytest.raises(NoGrasp, match=r"none of the contacts .* on a thing.*z_range"):
        propose(elsewhere)
    with pytest.raises(NoGrasp, match=r"none of its \d+ contacts.*best score is 0\.0.*above 0\.15"):
        propose(unsure)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"device": "tpu"}, "unknown device 'tpu'; valid: auto, cpu, cuda"),
        ({"regions": "half"}, "unknown regions 'half'; valid: scene, local"),
        ({"batch_norm": "none"}, "unknown batch_norm 'none'"),
        ({"z_range": [1.8, 0.2]}, "z_range"),
        ({"forward_passes": 0}, "forward_passes must be 1 to 20, not 0"),
        ({"num_samples": 100}, "max_farthest_points must be .* 150 and 100"),
        ({"first_threshold": 1.5}, "first_threshold must be 0 to 1, not 1.5"),
    ],
)
def test_a_setting_out_of_its_bounds_is_refused(config, says):
    with pytest.raises(InputError, match=says):
        ContactGraspNetProposer(ContactGraspNet(**config), Scripted(wise), 0)


# -- the command ---------------------------------------------------------------------------------

RUN = ("run", "--no-meshcat", "--scenario", "Knife", "--task", "use the knife")


def test_a_run_with_other_weights_ends_in_an_outcome_and_says_whose_they_are_not(
    tmp_path, monkeypatch
):
    file = tmp_path / "synthetic.pt"
    write_checkpoint(file)
    used = hashlib.sha256(file.read_bytes()).hexdigest()

    def meanwhile(*arguments):
        file.write_bytes(b"another file")
        return predict(*arguments)

    monkeypatch.setattr(proposer, "predict", meanwhile)
    done = tog(*RUN, "--checkpoint", file, "--out", tmp_path / "out", "--json")
    assert done.status in (0, 1)
    record = json.loads(done.out)
    assert record["outcome"] in OUTCOMES
    assert record["proposer"]["kind"] == "contact-graspnet"
    weights = record["proposer"]["weights"]
    assert file.read_bytes() == b"another file"
    assert weights["sha256"] == used
    assert weights["released"] is False
    assert f"weights: {file}, not the released checkpoint of Contact-GraspNet" in done.err
    assert (tmp_path / "out" / "report.html").is_file()


def test_without_weights_it_says_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_WEIGHTS", str(tmp_path))
    refused(
        tog(*RUN, "--proposer", "contact-graspnet", "--out", tmp_path),
        str(tmp_path / "contact_graspnet" / "model.pt"),
        "`tog weights fetch contact-graspnet --accept-licence`",
        "`tog weights add FILE`",
        "--checkpoint FILE",
    )


def test_weights_are_for_this_proposer_alone(tmp_path):
    done = tog(*RUN, "--proposer", "antipodal", "--checkpoint", tmp_path / "x.pt")
    refused(done, "--checkpoint", "contact-graspnet", "not for antipodal")


def test_weights_of_the_scenario_count_unless_the_command_names_others(tmp_path):
    text = "pipeline: {proposer: !ContactGraspNet {checkpoint: a.pt, forward_passes: 3}}"
    config = parse_scenario(text, "text", Scenario()).pipeline
    assert config.proposer == ContactGraspNet(checkpoint="a.pt", forward_passes=3)
    file = tmp_path / "b.pt"
    write_checkpoint(file)
    ProposerOptions(checkpoint=file).apply(config)
    assert config.proposer == ContactGraspNet(checkpoint=str(file), forward_passes=3)


def test_without_torch_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)  # as if it were not installed
    done = tog(*RUN, "--checkpoint", tmp_path / "x.pt")
    refused(done, "torch", "pip install 'tog_drake[cgn]'")
