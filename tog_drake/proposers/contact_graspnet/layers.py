"""The network's layers as matrices: point by point, and pooled over each group of neighbours.

Features are (rows, channels), a row a point. With the running statistics of training a batch
normalisation is a scale and a shift, and is folded into the convolution before it.
"""

import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, cast

import torch
from torch import Tensor

from tog_drake.proposers.contact_graspnet.workers import Workers

CHUNK = 1536  # rows of a group tensor at a time on a CPU, so that they stay in the cache
CHUNK_ELSEWHERE = 1 << 20


@dataclass(frozen=True)
class Layer:
    """A 1×1 convolution, batch normalisation and ReLU."""

    weight: Tensor  # (out, in)
    bias: Tensor  # (out,)
    norm: Any = None  # the normalisation by the statistics of what passes through, if so

    def __call__(self, x: Tensor, out: Tensor | None = None) -> Tensor:
        """From (rows, in) to (rows, out), where given in the memory of ``out``."""
        return self.activate(torch.mm(x, self.weight.t(), out=out).add_(self.bias))

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
    return conv.weight.detach().flatten(1), conv.bias.detach()


def pooled(
    layers: Sequence[Layer],
    features: Tensor,
    xyz: Tensor,
    centres: Tensor,
    neighbours: Tensor,
    count: Tensor,
    workers: Workers,
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
    first, *_, last = layers
    at_point = torch.addmm(first.bias, torch.cat([features, xyz], dim=1), first.weight.t())
    if first.norm is not None:  # repeats count in statistics, and all rows are needed for them
        x = at_point.index_select(0, neighbours.flatten())
        x.view(*neighbours.shape, -1).sub_((centres @ first.weight[:, -3:].t())[:, None])
        x = reduce(lambda x, each: each(x), layers[1:], first.activate(x))
        return x.view(*neighbours.shape, -1).amax(dim=1)
    # Repeats cannot change a maximum, and neither bias nor ReLU changes which is the largest.
    order = torch.argsort(count, descending=True, stable=True)
    neighbours, at_centre = neighbours[order], centres[order] @ first.weight[:, -3:].t()
    on_cpu = count.device.type == "cpu"
    chunks = list(_chunks(count[order].tolist(), CHUNK if on_cpu else CHUNK_ELSEWHERE))
    weights, biases = [each.weight.t() for each in layers], [each.bias for each in layers]
    largest = features.new_empty(len(order), len(last.bias))

    def work(chunks: list[tuple[int, int, int]]) -> None:
        (_scripted if on_cpu else _pool)(
            at_point, at_centre, neighbours, chunks, weights, biases, largest
        )

    workers.map(work, [chunks[i :: workers.count] for i in range(workers.count)])
    largest = last.activate(largest.add_(last.bias))
    return torch.empty_like(largest).index_copy_(0, order, largest)


def _pool(
    at_point: Tensor,
    at_centre: Tensor,
    neighbours: Tensor,
    chunks: list[tuple[int, int, int]],
    weights: list[Tensor],
    biases: list[Tensor],
    largest: Tensor,
) -> None:
    """Fills in the largest of these stretches of centres, in memory that is used again."""
    most = 0
    for start, end, width in chunks:
        most = max(most, (end - start) * width)
    buffers = [at_point.new_empty([most, len(bias)]) for bias in biases]
    for start, end, width in chunks:
        rows = (end - start) * width
        x = buffers[0][:rows]
        torch.index_select(at_point, 0, neighbours[start:end, :width].flatten(), out=x)
        x.view([end - start, width, -1]).sub_(at_centre[start:end].unsqueeze(1))
        for i in range(1, len(weights)):
            x = torch.mm(x.relu_(), weights[i], out=buffers[i][:rows])
            if i + 1 < len(weights):
                x = x.add_(biases[i])
        torch.amax(x.view([end - start, width, -1]), [1], out=largest[start:end])


def _without_python(function: Callable[..., None]) -> Callable[..., None]:
    """The function as TorchScript, in which threads do not wait for each other; else as it is."""
    if sys.version_info >= (3, 14):  # there torch has none
        return function
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return cast(Callable[..., None], torch.jit.script(function))


_scripted = _without_python(_pool)


def _chunks(widths: Sequence[int], rows: int) -> Iterator[tuple[int, int, int]]:
    """Start, end and width of stretches of the descending widths that fit into so many rows."""
    start = 0
    while start < len(widths):
        end = min(len(widths), start + max(1, rows // widths[start]))
        yield start, end, widths[start]
        start = end
