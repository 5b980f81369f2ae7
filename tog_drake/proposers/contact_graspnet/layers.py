"""The network's layers as matrices: point by point, and pooled over each group of neighbours.

Features are (rows, channels), a row a point. With the running statistics of training a batch
normalisation is a scale and a shift, and is folded into the convolution before it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

CHUNK = {"cpu": 4096}  # rows of a group tensor at a time, so that they stay in the cache
CHUNK_ELSEWHERE = 1 << 20


@dataclass(frozen=True)
class Layer:
    """A 1×1 convolution, batch normalisation and ReLU."""

    weight: Tensor  # (out, in)
    bias: Tensor  # (out,)
    norm: Any = None  # the normalisation by the statistics of what passes through, if so

    def __call__(self, x: Tensor) -> Tensor:
        """From (rows, in) to (rows, out)."""
        return self.activate(torch.addmm(self.bias, x, self.weight.t()))

    def activate(self, y: Tensor) -> Tensor:
        """What follows the convolution, in place where it can be; y is (rows, out)."""
        if self.norm is not None:
            mean = y.mean(dim=0)
            y = y.sub_(mean)
            variance = y.square().mean(dim=0)
            y = y.mul_(self.norm.weight / torch.sqrt(variance + self.norm.eps)).add_(self.norm.bias)
        return y.relu_()


def layer(conv: Any, norm: Any, running: bool) -> Layer:
    """The layer of a convolution and its normalisation, by running or by present statistics."""
    weight, bias = matrix(conv)
    if not running:
        return Layer(weight, bias, norm)
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return Layer(weight * scale[:, None], (bias - norm.running_mean) * scale + norm.bias)


def matrix(conv: Any) -> tuple[Tensor, Tensor]:
    """Weight (out, in) and bias (out,) of a 1×1 convolution."""
    return conv.weight.flatten(1), conv.bias


def pooled(
    layers: Sequence[Layer],
    features: Tensor,
    xyz: Tensor,
    centres: Tensor,
    neighbours: Tensor,
    count: Tensor,
) -> Tensor:
    """The layers on every neighbour of every centre, and of each channel the largest.

    A neighbour enters as its features, then its place relative to the centre [m]. The first
    layer's convolution is linear in both, so it is done once a point and once a centre.

    Args:
        features: (N, C).
        xyz: (N, 3) [m].
        centres: (M, 3) [m].
        neighbours: (M, K) rows of the N points, with repeats from ``count`` on.
        count: (M,) of the neighbours that are not repeats.

    Returns:
        (M, channels of the last layer).
    """
    first, *middle, last = layers
    at_point = torch.addmm(first.bias, torch.cat([features, xyz], dim=1), first.weight.t())
    at_centre = centres @ first.weight[:, -3:].t()
    result = features.new_empty(len(centres), len(last.bias))
    for rows, width in _chunks(count, neighbours.shape[1], whole=first.norm is not None):
        x = at_point[neighbours[rows, :width]]
        x -= at_centre[rows, None]
        x = first.activate(x.flatten(0, 1))
        for each in middle:
            x = each(x)
        if last.norm is not None:
            result[rows] = last(x).view(-1, width, len(last.bias)).amax(dim=1)
        else:  # neither the bias nor ReLU changes which neighbour is the largest
            y = (x @ last.weight.t()).view(-1, width, len(last.bias))
            result[rows] = y.amax(dim=1).add_(last.bias).relu_()
    return result


def _chunks(count: Tensor, most: int, *, whole: bool) -> Iterator[tuple[Tensor, int]]:
    """Centres that are worked on together, and how many neighbours of each; the fullest first.

    Centres with similarly many neighbours go together: repeats cannot change a maximum, so they
    are left out as far as possible. ``whole``: they count in statistics, so nothing is left out.
    """
    if whole:
        yield torch.arange(len(count), device=count.device), most
        return
    chunk = CHUNK.get(count.device.type, CHUNK_ELSEWHERE)
    order = torch.argsort(count, descending=True)
    width = count[order].tolist()
    start = 0
    while start < len(width):
        end = start + max(1, chunk // width[start])
        yield order[start:end], width[start]
        start = end
