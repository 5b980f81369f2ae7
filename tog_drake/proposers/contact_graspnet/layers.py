"""The network's layers as matrices: point by point, and pooled over each group of neighbours.

Features are (rows, channels), a row a point. With the running statistics of training a batch
normalisation is a scale and a shift, and is folded into the convolution before it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

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
    first, *middle, last = layers
    whole = first.norm is not None
    order = torch.argsort(count, descending=True, stable=True)
    if whole:  # repeats count in statistics, and all rows are needed for them
        chunks = [(0, len(order), neighbours.shape[1])]
    else:  # repeats cannot change a maximum
        rows = CHUNK if count.device.type == "cpu" else CHUNK_ELSEWHERE
        chunks = list(_chunks(count[order].tolist(), rows))
    most = max((end - start) * width for start, end, width in chunks)

    neighbours = neighbours[order]
    at_point = torch.addmm(first.bias, torch.cat([features, xyz], dim=1), first.weight.t())
    at_centre = centres[order] @ first.weight[:, -3:].t()
    largest = features.new_empty(len(order), len(last.bias))

    def work(chunks: list[tuple[int, int, int]]) -> None:
        """Fills in the largest of these stretches of centres, in memory that is used again."""
        buffers = [features.new_empty(most, len(each.bias)) for each in layers]
        for start, end, width in chunks:
            x, *out, y = (buffer[: (end - start) * width] for buffer in buffers)
            torch.index_select(at_point, 0, neighbours[start:end, :width].flatten(), out=x)
            x.view(end - start, width, -1).sub_(at_centre[start:end, None])
            x = first.activate(x)
            for each, into in zip(middle, out, strict=True):
                x = each(x, into)
            torch.mm(x, last.weight.t(), out=y)
            if whole:
                y = last.activate(y.add_(last.bias))
            torch.amax(y.view(end - start, width, -1), dim=1, out=largest[start:end])

    workers.map(work, [chunks[i :: workers.count] for i in range(workers.count)])
    if not whole:  # neither bias nor ReLU changes which neighbour is the largest
        largest = last.activate(largest.add_(last.bias))
    return torch.empty_like(largest).index_copy_(0, order, largest)


def _chunks(widths: Sequence[int], rows: int) -> Iterator[tuple[int, int, int]]:
    """Start, end and width of stretches of the descending widths that fit into so many rows."""
    start = 0
    while start < len(widths):
        end = min(len(widths), start + max(1, rows // widths[start]))
        yield start, end, widths[start]
        start = end
