"""The network says what the published one says, and looks at the points that it looks at."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from time import sleep
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_weights import synthetic_network, write_checkpoint

from tog_drake.proposers.contact_graspnet import ContactGraspNet, sampling
from tog_drake.proposers.contact_graspnet.decoding import BIN_WIDTHS, hand_poses, widths
from tog_drake.proposers.contact_graspnet.network import LEVEL_1, LEVEL_2, LEVEL_3
from tog_drake.proposers.contact_graspnet.sampling import (
    ball_query,
    farthest_points,
    three_nearest,
)
from tog_drake.proposers.contact_graspnet.workers import Workers

GRID = 2.0**-11  # [m] on it every squared distance is exact, so that there is one right answer
ON_GRID = ("small4k", "dup4k", "tabletop20k")
STAGES = ("sa1", "sa2", "sa3", "sa4", "fp3", "fp2", "fp1")
STRIDE = {"sa1": 16, "sa2": 8, "sa3": 2, "fp2": 4, "fp1": 8}  # of the recorded features


@pytest.fixture(scope="module")
def network():
    return synthetic_network()


@pytest.fixture(scope="module")
def predict(network, parity):
    """What the network says on a recorded cloud, in numpy, without the batch's axis."""
    known = {}

    def says(name):
        if name not in known:
            cloud = torch.from_numpy(np.load(parity / f"input_{name}.npz")["points"])
            known[name] = {k: v[0].numpy() for k, v in network(cloud[None]).items()}
        return known[name]

    return says


def random_cloud(rng, count, grid=GRID, size=0.25):
    """Points (count, 3) on a grid, or not; the coarser the grid, the more are equal."""
    points = rng.uniform(-size, size, (count, 3))
    return (np.round(points / grid) * grid if grid else points).astype(np.float32)


# -- parity with the published network -----------------------------------------------------------


@pytest.mark.parametrize("name", ON_GRID)
def test_on_the_grid_it_says_what_the_published_network_says(predict, parity, name):
    _same(predict(name), np.load(parity / f"output_{name}.npz"))


def test_with_the_statistics_of_the_cloud_too(parity):
    cloud = torch.from_numpy(np.load(parity / "input_tabletop20k.npz")["points"])
    network = synthetic_network(batch_norm="batch")
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    said = {k: v[0].numpy() for k, v in network(cloud[None]).items()}
    _same(said, np.load(parity / "output_tabletop20k_bnbatch.npz"))
    assert all(torch.equal(before[name], now) for name, now in network.state_dict().items())


def _same(said, recorded):
    np.testing.assert_array_equal(said["pred_points"], recorded["pred_points"])
    assert np.abs(said["pred_scores"] - recorded["pred_scores"]).max() <= 2e-5
    assert np.abs(said["grasp_offset_head"] - recorded["grasp_offset_head"]).max() <= 1e-4
    np.testing.assert_allclose(said["offset_pred"], recorded["offset_pred"], rtol=1e-6)
    wrong = np.abs(said["pred_grasps_cam"] - recorded["pred_grasps_cam"])
    assert np.quantile(wrong, 0.999) <= 1e-4 and wrong.max() <= 2e-3


def test_off_the_grid_rounding_may_move_a_few_neighbours_and_no_more(predict, parity):
    said = predict("tabletop20k_cont")
    recorded = np.load(parity / "output_tabletop20k_cont.npz")
    np.testing.assert_array_equal(said["pred_points"], recorded["pred_points"])
    wrong = np.abs(said["pred_scores"] - recorded["pred_scores"])
    assert wrong.max() <= 2e-2 and np.median(wrong) <= 1e-3
    assert (np.abs(said["offset_pred"] - recorded["offset_pred"]) > 1e-6).sum() <= 5


@pytest.mark.parametrize("name", [*ON_GRID, "tabletop20k_cont"])
def test_the_published_farthest_points_are_picked(parity, name):
    xyz = np.load(parity / f"input_{name}.npz")["points"]
    recorded = np.load(parity / f"output_{name}.npz")
    for level, count in enumerate((2048, 512, 128), start=1):
        rows = farthest_points(xyz, count)
        np.testing.assert_array_equal(rows, recorded[f"fps{level}"])
        xyz = xyz[rows]


def test_the_published_neighbours_are_found(parity):
    xyz = np.load(parity / "input_small4k.npz")["points"]
    recorded = np.load(parity / "intermediate_small4k.npz")
    for name, scales, count, stride in (
        ("ball1", LEVEL_1, 2048, 8),
        ("ball2", LEVEL_2, 512, 4),
        ("ball3", LEVEL_3, 128, 1),
    ):
        centres = xyz[farthest_points(xyz, count)]
        found = ball_query(xyz, centres, [s.radius for s in scales], [s.most for s in scales])
        for i, near in enumerate(found):
            np.testing.assert_array_equal(near.index[::stride], recorded[f"{name}_{i}"])
        xyz = centres


def test_every_stage_has_the_published_features(network, parity):
    features = {}
    hooks = [
        getattr(network, name).register_forward_hook(
            lambda _, __, out, name=name: features.update({name: out.numpy()})
        )
        for name in STAGES
    ]
    network(torch.from_numpy(np.load(parity / "input_small4k.npz")["points"])[None])
    for hook in hooks:
        hook.remove()
    features["sa4"] = features["sa4"].max(axis=0, keepdims=True)  # its group is pooled afterwards
    recorded = np.load(parity / "intermediate_small4k.npz")
    for name in STAGES:
        np.testing.assert_allclose(
            features[name][:: STRIDE.get(name, 1)].T, recorded[name], rtol=0, atol=2e-4
        )


@pytest.mark.parametrize("name", ON_GRID)
def test_the_published_heads_decode_to_the_published_grasps(parity, name):
    recorded = np.load(parity / f"output_{name}.npz")
    tensor = {key: torch.from_numpy(recorded[key]) for key in recorded}
    width = widths(tensor["grasp_offset_head"].T)
    np.testing.assert_allclose(width, recorded["offset_pred"][0], rtol=1e-6)
    poses = hand_poses(tensor["pred_points"], tensor["raw_dir"].T, tensor["raw_approach"].T, width)
    np.testing.assert_allclose(poses, recorded["pred_grasps_cam"], rtol=0, atol=1e-5)


# -- the module ----------------------------------------------------------------------------------


def test_the_parameters_are_as_many_as_those_of_the_published_weights():
    network = ContactGraspNet()
    assert len(network.state_dict()) == 295
    assert sum(p.numel() for p in network.parameters()) == 2194097
    assert sum(b.numel() for b in network.buffers()) == 13673


def test_clouds_of_one_batch_do_not_see_each_other(network):
    rng = np.random.default_rng(0)
    clouds = torch.from_numpy(np.stack([random_cloud(rng, 300) for _ in range(3)]))
    together = network(clouds)
    for i in range(3):
        for name, alone in network(clouds[i : i + 1]).items():
            torch.testing.assert_close(together[name][i], alone[0], rtol=0, atol=2e-3)


def test_the_answer_depends_neither_on_the_mode_nor_on_what_was_asked_before(network):
    rng = np.random.default_rng(1)
    cloud = torch.from_numpy(random_cloud(rng, 400))[None]
    first = network(cloud)
    state = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    network.train()
    again = network(cloud)
    network.eval()
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert all(torch.equal(state[name], now) for name, now in network.state_dict().items())
    assert not first["pred_scores"].requires_grad


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_on_any_number_of_threads_the_answer_is_the_same(network, threads):
    cloud = torch.from_numpy(random_cloud(np.random.default_rng(5), 3000))[None]
    before = torch.get_num_threads()
    one = network(cloud)
    assert torch.get_num_threads() == before
    try:
        torch.set_num_threads(threads)
        said, again = network(cloud), network(cloud)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(said[name], again[name]) for name in said)
    _same(*({name: tensor[0].numpy() for name, tensor in x.items()} for x in (said, one)))


def test_a_second_context_waits_for_the_first_and_torch_keeps_its_threads():
    before = torch.get_num_threads()
    entered, events = Event(), []

    def second():
        entered.set()
        with Workers() as workers:
            events.append("second")
            return workers.count

    try:
        torch.set_num_threads(3)
        with ThreadPoolExecutor(1) as pool:
            with Workers() as workers:
                assert (workers.count, torch.get_num_threads()) == (3, 1)
                waiting = pool.submit(second)
                entered.wait()
                sleep(0.05)  # were there no lock, it would have entered by now
                events.append("first")
            assert waiting.result() == 3
            assert events == ["first", "second"]
            assert pool.submit(torch.get_num_threads).result() == 3
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)


def test_asked_from_two_threads_at_once_it_answers_the_same(network):
    cloud = torch.from_numpy(random_cloud(np.random.default_rng(6), 300))[None]
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        alone = network(cloud)
        with ThreadPoolExecutor(2) as pool:
            answers = list(pool.map(network, [cloud] * 4))
            assert pool.submit(torch.get_num_threads).result() == 2
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(said[name], alone[name]) for said in answers for name in alone)


def test_after_an_error_torch_has_its_threads_again():
    before = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError), Workers(before + 1) as workers:
        assert torch.get_num_threads() == 1
        workers.map(lambda one: 1 // one, [1, 0])
    assert torch.get_num_threads() == before


def test_weights_that_are_loaded_later_count(network):
    cloud = torch.from_numpy(random_cloud(np.random.default_rng(2), 200))[None]
    other = ContactGraspNet()
    before = other(cloud)["pred_scores"]
    other.load_state_dict(network.state_dict())
    after = other(cloud)["pred_scores"]
    assert not torch.equal(before, after)
    assert torch.equal(after, network(cloud)["pred_scores"])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_cloud_of_a_few_points_has_an_answer(network, count):
    cloud = torch.from_numpy(random_cloud(np.random.default_rng(count), count))[None]
    said = network(cloud)
    shapes = {name: tuple(tensor.shape) for name, tensor in said.items()}
    assert shapes == {
        "pred_grasps_cam": (1, 2048, 4, 4),
        "pred_scores": (1, 2048, 1),
        "pred_points": (1, 2048, 3),
        "offset_pred": (1, 1, 2048),
        "grasp_offset_head": (1, 10, 2048),
    }
    assert all(torch.isfinite(tensor).all() for tensor in said.values())
    assert (said["pred_points"][0, count:] == cloud[0, 0]).all()


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (torch.zeros(5, 3), r"\(5, 3\)"),
        (torch.zeros(1, 0, 3), r"\(1, 0, 3\)"),
        (torch.zeros(1, 3, 4), r"\(1, 3, 4\)"),
        (torch.zeros(1, 4, 3, dtype=torch.float64), "float64"),
        (torch.full((1, 4, 3), torch.nan), "finite"),
    ],
)
def test_points_that_it_cannot_use_are_refused(network, points, message):
    with pytest.raises(ValueError, match=message):
        network(points)


def test_an_unknown_normalisation_is_refused():
    with pytest.raises(ValueError, match="'running' or 'batch', got 'eval'"):
        ContactGraspNet(batch_norm="eval")


def test_without_torch_one_is_told_how_to_install_it():
    program = """
import sys
sys.modules["torch"] = None
from tog_drake.errors import InputError
try:
    from tog_drake.proposers.contact_graspnet import ContactGraspNet, sampling
except InputError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True
    )
    assert "pip install 'tog_drake[cgn]'" in done.stdout


def test_the_synthetic_checkpoint_loads_without_running_code_from_it(network, tmp_path):
    write_checkpoint(tmp_path / "synthetic.pt")
    content = torch.load(tmp_path / "synthetic.pt", weights_only=True)
    ContactGraspNet().load_state_dict(content["model"])


# -- which points --------------------------------------------------------------------------------

CLOUDS = {
    "count": st.integers(1, 700),
    "grid": st.sampled_from([0.0, GRID, 0.02, 0.1]),
    "seed": st.integers(0, 2**32 - 1),
}


@settings(max_examples=40)
@given(**CLOUDS, picks=st.integers(1, 400))
def test_farthest_points_are_those_of_a_walk_over_all_points(count, grid, seed, picks):
    points = random_cloud(np.random.default_rng(seed), count, grid)
    np.testing.assert_array_equal(farthest_points(points, picks), _walk(points, picks))


@settings(max_examples=60)
@given(**CLOUDS, picks=st.integers(1, 400), active=st.integers(1, 60))
def test_also_where_the_walk_skips_most_points(count, grid, seed, picks, active):
    points = random_cloud(np.random.default_rng(seed), count, grid)
    with patch.multiple(sampling, MANY=64, FIRST=5, ACTIVE=active):
        np.testing.assert_array_equal(farthest_points(points, picks), _walk(points, picks))


@pytest.mark.parametrize("grid", [0.0, GRID, 0.1])
def test_also_in_a_large_cloud(grid):
    points = random_cloud(np.random.default_rng(4), 9000, grid)
    np.testing.assert_array_equal(farthest_points(points, 1000), _walk(points, 1000))


def _walk(points, count):
    rows, distance = [0], np.full(len(points), np.inf, np.float32)
    while len(rows) < count:
        d = points - points[rows[-1]]
        d = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
        distance = np.minimum(distance, d)
        rows.append(int(distance.argmax()))
    return rows


@settings(max_examples=40)
@given(**CLOUDS, picks=st.integers(1, 400), again=st.integers(1, 400))
def test_of_farthest_points_the_farthest_are_the_first(count, grid, seed, picks, again):
    points = random_cloud(np.random.default_rng(seed), count, grid)
    farthest = points[farthest_points(points, picks)]
    few = farthest[farthest_points(farthest, min(again, picks))]
    np.testing.assert_array_equal(few, farthest[:again])


def test_of_equally_far_points_the_first_is_picked():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]], np.float32)
    np.testing.assert_array_equal(farthest_points(square, 4), [0, 1, 2, 4])


def test_when_there_is_no_further_point_the_first_is_picked_again():
    points = np.repeat(random_cloud(np.random.default_rng(3), 7), 5, axis=0)
    rows = farthest_points(points, 30)
    assert sorted(rows[:7]) == list(range(0, 35, 5))
    assert (rows[7:] == 0).all()


@settings(max_examples=60)
@given(
    **CLOUDS,
    radius=st.floats(0.001, 0.3),
    most=st.integers(1, 64),
    dense=st.sampled_from([1, 10, 100, 4096]),
)
def test_a_ball_holds_the_first_points_that_are_near_enough(count, grid, seed, radius, most, dense):
    rng = np.random.default_rng(seed)
    points = random_cloud(rng, count, grid)
    centres = points[rng.integers(0, count, 60)]
    with patch.object(sampling, "DENSE", dense):
        found = ball_query(points, centres, (radius, 2 * radius), (most, 2 * most))
    for r, near in zip((radius, 2 * radius), found, strict=True):
        k = most if r == radius else 2 * most
        for i, centre in enumerate(centres):
            d = points - centre
            d = d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]
            rows = np.flatnonzero(d <= np.float32(r * r))[:k]
            assert near.count[i] == len(rows)
            np.testing.assert_array_equal(near.index[i, : len(rows)], rows)
            assert (near.index[i, len(rows) :] == rows[0]).all()


def test_a_point_on_the_sphere_belongs_to_the_ball():
    points = np.array([[0, 0, 0], [0.5, 0, 0], [0.5 + GRID, 0, 0]], np.float32)
    (near,) = ball_query(points, points[:1], (0.5,), (4,))
    assert near.index.tolist() == [[0, 1, 0, 0]] and near.count.tolist() == [2]


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), grid=st.sampled_from([0.0, GRID, 0.1]))
def test_the_nearest_three_weigh_by_their_squared_distance(seed, grid):
    rng = np.random.default_rng(seed)
    points, sources = random_cloud(rng, 60, grid), random_cloud(rng, 20, grid)
    index, weight = three_nearest(points, sources)
    d = np.square(points[:, None] - sources).sum(axis=2)
    order = np.argsort(d, axis=1, kind="stable")[:, :3]
    if grid:
        np.testing.assert_array_equal(index, order)
    expected = 1 / (np.take_along_axis(d, order, axis=1).astype(np.float64) + 1e-8)
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(weight, expected, rtol=0, atol=1e-4)


# -- decoding ------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1))
def test_a_hand_closes_from_the_contact_towards_the_other_finger(seed):
    rng = np.random.default_rng(seed)
    contact, closing, approach = torch.from_numpy(rng.standard_normal((3, 2, 3, 3)))
    width = torch.from_numpy(rng.uniform(0, 0.08, (2, 3)))
    pose = hand_poses(contact, closing, approach, width)
    x, _, z, origin = pose[..., :3, :].unbind(dim=-1)
    rotation = pose[..., :3, :3]
    torch.testing.assert_close(rotation.mT @ rotation, torch.eye(3).double().expand(2, 3, 3, 3))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(2, 3).double())
    torch.testing.assert_close(x, torch.nn.functional.normalize(closing, dim=-1))
    assert ((z * approach).sum(-1) >= 0).all()
    middle = origin + 0.1034 * z
    torch.testing.assert_close(middle - width[..., None] / 2 * x, contact)
    assert (pose[..., 3, :] == torch.tensor([0, 0, 0, 1])).all()


def test_the_width_is_that_of_the_first_of_the_most_likely_bins():
    logits = torch.zeros(3, 10)
    logits[1, 4] = logits[1, 7] = 1
    logits[2, 9] = 1
    expected = torch.tensor([BIN_WIDTHS[0], BIN_WIDTHS[4], 0.075])
    torch.testing.assert_close(widths(logits), expected)
