"""How long the grasp network takes, as a whole and by parts: ``make bench``. No time is asserted.

The cloud is made up: 20 000 points, three quarters on a table, the rest on boxes that stand on it.
``python tests/benchmarks/bench_contact_graspnet.py`` runs the network once, by itself, so that
``/usr/bin/time -v`` before it tells the memory.
"""

import numpy as np
import torch

from tog_drake.proposers.contact_graspnet import ContactGraspNet
from tog_drake.proposers.contact_graspnet.network import LEVEL_1
from tog_drake.proposers.contact_graspnet.sampling import ball_query, farthest_points


def table_cloud(count=20000, boxes=12):
    """Points (count, 3) float32 [m] of a scene of 0.8 m × 0.6 m in random order, centred."""
    rng = np.random.default_rng(0)
    size = rng.uniform([0.03, 0.03, 0.05], [0.12, 0.12, 0.20], (boxes, 3))
    corner = np.column_stack([rng.uniform([-0.4, -0.3], [0.3, 0.2], (boxes, 2)), np.zeros(boxes)])
    box = rng.integers(0, boxes, count // 4)
    on_box = rng.random((count // 4, 3))
    side = rng.integers(0, 3, count // 4)  # of the three that a camera sees
    on_box[np.arange(count // 4), side] = side == 2
    table = rng.uniform([-0.4, -0.3], [0.4, 0.3], (count - len(box), 2))
    table = np.column_stack([table, np.zeros(len(table))])
    points = rng.permutation(np.vstack([table, corner[box] + on_box * size[box]]))
    return (points - points.mean(axis=0)).astype(np.float32)


def test_farthest_points(benchmark):
    benchmark(farthest_points, table_cloud(), 2048)


def test_neighbours(benchmark):
    points = table_cloud()
    centres = points[farthest_points(points, 2048)]
    radii, most = [s.radius for s in LEVEL_1], [s.most for s in LEVEL_1]
    benchmark(ball_query, points, centres, radii, most)


def test_forward(benchmark):
    network, cloud = ContactGraspNet(), torch.from_numpy(table_cloud())[None]
    benchmark.extra_info["threads"] = torch.get_num_threads()
    benchmark(network, cloud)


if __name__ == "__main__":
    said = ContactGraspNet()(torch.from_numpy(table_cloud())[None])
    print({name: tuple(tensor.shape) for name, tensor in said.items()})
