"""Contact-GraspNet: an asymmetric PointNet++ with four heads, for inference.

Four levels of set abstraction (20 000 → 2048 → 512 → 128 → 1 points), three of feature propagation
back to the 2048 points of level 1, and at each of these, a *contact*, what grasp there is: whether
it succeeds, the direction in which the hand closes, the one in which it approaches, the width.

Names and shapes of the parameters are those of the published PyTorch weights, which therefore load
unchanged.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tog_drake.proposers.contact_graspnet.decoding import hand_poses, widths
from tog_drake.proposers.contact_graspnet.layers import Groups, Layer, layer, matrix, pooled
from tog_drake.proposers.contact_graspnet.sampling import (
    Each,
    ball_query,
    farthest_points,
    three_nearest,
)
from tog_drake.proposers.contact_graspnet.workers import Workers

BatchNorm = Literal["running", "batch"]


@dataclass(frozen=True)
class Scale:
    """One of the neighbourhoods of a level."""

    radius: float  # [m]
    most: int  # neighbours
    channels: tuple[int, ...]  # of the layers


LEVEL_1 = (
    Scale(0.02, 32, (32, 32, 64)),
    Scale(0.04, 64, (64, 64, 128)),
    Scale(0.08, 128, (64, 96, 128)),
)
LEVEL_2 = (
    Scale(0.04, 64, (64, 64, 128)),
    Scale(0.08, 64, (128, 128, 256)),
    Scale(0.16, 128, (128, 128, 256)),
)
LEVEL_3 = (
    Scale(0.08, 64, (64, 64, 128)),
    Scale(0.16, 64, (128, 128, 256)),
    Scale(0.32, 128, (128, 128, 256)),
)


class ContactGraspNet(nn.Module):
    """The network, and the decoding of what it says; for inference, without gradients (no_grad).

    Not to be confused with the config of the proposer, which has the same name for the scenario's
    tag: ``proposer.ContactGraspNet``.

    The result is the same every time: farthest points start from row 0, dropout is off and nothing
    is updated, whether or not the module is in training mode. Which points are looked at is worked
    out on the CPU; the rest runs where the parameters are.

    Args:
        batch_norm: ``running``: normalise by the statistics of the training, stored with the
            weights. ``batch``: by those of the clouds given, together, as the published code does
            in effect; slower, and needs 0.7 GB instead of 0.3.

    Raises:
        ValueError: another ``batch_norm``.
    """

    def __init__(self, batch_norm: BatchNorm = "running"):
        super().__init__()
        if batch_norm not in ("running", "batch"):
            raise ValueError(f"batch_norm must be 'running' or 'batch', got {batch_norm!r}")
        self.batch_norm = batch_norm
        self.sa1 = _Abstraction(LEVEL_1, channels=3)
        self.sa2 = _Abstraction(LEVEL_2, channels=320)
        self.sa3 = _Abstraction(LEVEL_3, channels=640)
        self.sa4 = _Pointwise((3 + 640, 256, 512, 1024), flat=False)
        self.fp3 = _Pointwise((640 + 1024, 128, 128, 128))
        self.fp2 = _Pointwise((640 + 128, 256, 128))
        self.fp1 = _Pointwise((320 + 128, 256, 256))
        self.grasp_dir_head = _head(3, dropout=0.3)
        self.grasp_approach_head = _head(3, dropout=0.3)
        self.grasp_offset_head = _head(10)
        self.binary_seg_head = _head(1, dropout=0.5)

    @torch.no_grad()
    def forward(self, points: Tensor) -> dict[str, Tensor]:
        """Predicts a grasp at each of 2048 contacts.

        Args:
            points: (B, N, 3) float32 [m], N ≥ 1, in the camera's frame, centred on their mean.
                Their order matters: of crowded neighbourhoods the first rows are looked at.

        Returns:
            ``pred_grasps_cam`` (B, 2048, 4, 4): poses of the hand's base (see ``hand_poses``);
            ``pred_scores`` (B, 2048, 1) in [0, 1]; ``pred_points`` (B, 2048, 3) [m]: the contacts,
            which are points of the cloud; ``offset_pred`` (B, 1, 2048) [m]: the widths;
            ``grasp_offset_head`` (B, 10, 2048): the logits of the widths' bins.

        Raises:
            ValueError: points that are not (B, N, 3), float32 and finite.
        """
        device = self._device()
        running = self.batch_norm == "running"
        alone = device.type != "cpu" or not running  # statistics are those of all rows together
        with Workers(1 if alone else None) as workers:
            _check(points)
            points = points.detach().to(device)
            contact, features = self._backbone(points, running, workers)

            def head(layers: nn.Sequential) -> Tensor:
                """What a head says (B, 2048, channels); dropout is left out."""
                hidden = layer(layers[0], layers[1], running)
                weight, bias = matrix(layers[-1])
                y = workers.by_rows(lambda x: torch.addmm(bias, hidden(x), weight), features)
                return y.view(len(points), -1, len(bias))

            logits, score = head(self.grasp_offset_head), head(self.binary_seg_head)
            closing, approach = head(self.grasp_dir_head), head(self.grasp_approach_head)
        width = widths(logits)
        return {
            "pred_grasps_cam": hand_poses(contact, closing, approach, width),
            "pred_scores": torch.sigmoid(score),
            "pred_points": contact,
            "offset_pred": width[:, None],
            "grasp_offset_head": logits.transpose(1, 2),
        }

    def _backbone(self, points: Tensor, running: bool, workers: Workers) -> tuple[Tensor, Tensor]:
        """The contacts (B, 2048, 3) [m] and their features (B·2048, 256)."""
        batch, how = len(points), (running, workers)
        cloud = points.cpu().numpy()
        # Of farthest points the farthest are the first, so these are the points of all levels.
        xyz = np.stack([each[farthest_points(each, 2048)] for each in cloud])
        at1 = _level(cloud, xyz, LEVEL_1, workers.map)

        def coarser() -> tuple[_Level, _Level]:
            at2 = _level(xyz, xyz[:, :512], LEVEL_2)
            return at2, _level(at2.xyz, xyz[:, :128], LEVEL_3)

        started = workers.start(coarser)
        contact = torch.from_numpy(at1.xyz).to(points.device)
        xyz0, xyz1 = points.flatten(0, 1), contact.flatten(0, 1)
        sa1 = self.sa1(xyz0, xyz0, xyz1, at1.neighbours, *how)
        at2, at3 = started()
        xyz2, xyz3 = (torch.from_numpy(at.xyz).to(points.device).flatten(0, 1) for at in (at2, at3))
        sa2 = self.sa2(sa1, xyz1, xyz2, at2.neighbours, *how)
        sa3 = self.sa3(sa2, xyz2, xyz3, at3.neighbours, *how)
        # All points of level 3 are one group; here the place comes first, then the features.
        group = self.sa4(torch.cat([xyz3, sa3], dim=1), *how)
        sa4 = group.view(batch, -1, group.shape[1]).amax(dim=1)
        fp3 = self.fp3(torch.cat([sa3, sa4.repeat_interleave(128, dim=0)], dim=1), *how)
        fp2 = self.fp2(torch.cat([sa2, _interpolated(fp3, at3.xyz, at2.xyz)], dim=1), *how)
        fp1 = self.fp1(torch.cat([sa1, _interpolated(fp2, at2.xyz, at1.xyz)], dim=1), *how)
        return contact, fp1

    def _device(self) -> torch.device:
        return self.get_parameter("sa1.conv_blocks.0.0.weight").device


class _Abstraction(nn.Module):
    """A level of set abstraction: around each of its points, neighbourhoods of several scales."""

    def __init__(self, scales: Sequence[Scale], channels: int):
        super().__init__()
        layers = [(channels + 3, *scale.channels) for scale in scales]
        self.conv_blocks = nn.ModuleList(_convolutions(nn.Conv2d, widths) for widths in layers)
        self.bn_blocks = nn.ModuleList(_norms(nn.BatchNorm2d, widths) for widths in layers)

    def forward(
        self,
        features: Tensor,
        xyz: Tensor,
        centres: Tensor,
        neighbours: Sequence[tuple[Tensor, Tensor]],
        running: bool,
        workers: Workers,
    ) -> Tensor:
        """Features (M, channels of all scales) of the centres; see ``pooled``."""
        scales = [
            Groups(_layers(convs, norms, running), rows.to(xyz.device), count.to(xyz.device))
            for convs, norms, (rows, count) in zip(
                self.conv_blocks, self.bn_blocks, neighbours, strict=True
            )
        ]
        return pooled(scales, features, xyz, centres, workers)


class _Pointwise(nn.Module):
    """Layers on every point by itself."""

    def __init__(self, widths: Sequence[int], flat: bool = True):
        super().__init__()
        self.mlp_convs = _convolutions(nn.Conv1d if flat else nn.Conv2d, widths)
        self.mlp_bns = _norms(nn.BatchNorm1d if flat else nn.BatchNorm2d, widths)

    def forward(self, x: Tensor, running: bool, workers: Workers) -> Tensor:
        """From (rows, channels) to (rows, channels of the last layer)."""
        layers = _layers(self.mlp_convs, self.mlp_bns, running)
        return workers.by_rows(lambda rows: reduce(lambda x, each: each(x), layers, rows), x)


def _convolutions(
    kind: Callable[[int, int, int], nn.Module], widths: Sequence[int]
) -> nn.ModuleList:
    return nn.ModuleList(kind(i, o, 1) for i, o in pairwise(widths))


def _norms(kind: Callable[[int], nn.Module], widths: Sequence[int]) -> nn.ModuleList:
    return nn.ModuleList(kind(o) for o in widths[1:])


def _layers(convs: Any, norms: Any, running: bool) -> list[Layer]:
    return [layer(conv, norm, running) for conv, norm in zip(convs, norms, strict=True)]


def _head(channels: int, dropout: float | None = None) -> nn.Sequential:
    """A head of 256 → 128 → ``channels``; dropout only counts in the names of the parameters."""
    between = [] if dropout is None else [nn.Dropout(dropout)]
    return nn.Sequential(
        nn.Conv1d(256, 128, 1),
        nn.BatchNorm1d(128),
        nn.ReLU(),
        *between,
        nn.Conv1d(128, channels, 1),
    )


@dataclass(frozen=True)
class _Level:
    """The points of a level and what they are made from, of B clouds."""

    xyz: NDArray[np.float32]  # (B, M, 3) [m]
    neighbours: list[tuple[Tensor, Tensor]]
    """For each scale (B·M, K) rows of the B·N points before and how many are not repeats (B·M,)."""


def _level(
    xyz: NDArray[np.float32],
    centres: NDArray[np.float32],
    scales: Sequence[Scale],
    each: Each = map,
) -> _Level:
    """The level of these centres (B, M, 3), which are among the points (B, N, 3) before."""
    radii, most = [s.radius for s in scales], [s.most for s in scales]
    found = [ball_query(cloud, c, radii, most, each) for cloud, c in zip(xyz, centres, strict=True)]
    neighbours = []
    for scale in zip(*found, strict=True):
        rows = [near.index + i * xyz.shape[1] for i, near in enumerate(scale)]
        counts = [near.count for near in scale]
        neighbours.append(
            (torch.from_numpy(np.concatenate(rows)), torch.from_numpy(np.concatenate(counts)))
        )
    return _Level(centres, neighbours)


def _interpolated(
    features: Tensor, sources: NDArray[np.float32], points: NDArray[np.float32]
) -> Tensor:
    """Features (B·M, C) at the points (B, M, 3) from those (B·S, C) at the sources (B, S, 3)."""
    rows, weights = [], []
    for i, (p, s) in enumerate(zip(points, sources, strict=True)):
        row, weight = three_nearest(p, s)
        rows.append(row + i * len(s))
        weights.append(weight)
    near = features[torch.from_numpy(np.concatenate(rows)).to(features.device)]  # (B·M, 3, C)
    weight_of = torch.from_numpy(np.concatenate(weights)).to(features.device)
    return (near * weight_of[..., None]).sum(dim=1)


def _check(points: Tensor) -> None:
    if points.ndim != 3 or points.shape[2] != 3 or 0 in points.shape:
        raise ValueError(f"points must be (B, N, 3) with B, N ≥ 1, got {tuple(points.shape)}")
    if points.dtype != torch.float32 or not torch.isfinite(points).all():
        raise ValueError(f"points must be finite and float32, got {points.dtype}")
