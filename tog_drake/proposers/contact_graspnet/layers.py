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
PART = 8  # chunks that a thread takes at a time

Chunks = list[tuple[int, int, int]]  # start, end and width of stretches of centres


@dataclass(frozen=True)
class Layer:
    """A 1×1 convolution, batch normalisation and ReLU."""

    weight: Tensor  # (in, out), contiguous: the product with it is a tenth faster
    bias: Tensor  # (out,)
    norm: Any = None  # the normalisation by the statistics of what passes through, if so

    def __call__(self, x: Tensor) -> Tensor:
        """From (rows, in) to (rows, out)."""
        return self.activate(torch.mm(x, self.weight).add_(self.bias))

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
    return Layer((weight * scale).contiguous(), (bias - norm.running_mean) * scale + norm.bias)


def matrix(conv: Any) -> tuple[Tensor, Tensor]:
    """Weight (in, out) and bias (out,) of a 1×1 convolution."""
    return conv.weight.detach().flatten(1).t(), conv.bias.detach()


@dataclass(frozen=True)
class Groups:
    """The neighbours of M centres, and the layers that they pass through."""

    layers: Sequence[Layer]
    rows: Tensor  # (M, K) of the points, with repeats from ``count`` on
    count: Tensor  # (M,) of the neighbours that are not repeats


def pooled(
    scales: Sequence[Groups], features: Tensor, xyz: Tensor, centres: Tensor, workers: Workers
) -> Tensor:
    """The layers on every neighbour of every centre, and of each channel the largest.

    A neighbour enters as its features, then its place relative to the centre [m].

    Args:
        features: (N, C).
        xyz: (N, 3) [m].
        centres: (M, 3) [m].

    Returns:
        (M, channels of the last layers of all scales).
    """
    points = torch.cat([features, xyz], dim=1)
    if scales[0].layers[0].norm is not None:
        return torch.cat([_normalised(scale, points, centres) for scale in scales], dim=1)
    pools = workers.map(lambda scale: _Pool(scale, points, centres), scales)

    def work(parts: Iterator[tuple[_Pool, Chunks]]) -> None:
        memory = [
            points.new_empty(max(sizes))
            for sizes in zip(*(pool.sizes for pool in pools), strict=True)
        ]
        for pool, chunks in parts:
            pool.fill(chunks, memory)

    workers.share(work, [(pool, chunks) for pool in pools for chunks in pool.parts])
    return torch.cat([pool.result() for pool in pools], dim=1)


def _normalised(groups: Groups, points: Tensor, centres: Tensor) -> Tensor:
    """As ``pooled``, by the statistics of all rows: repeats count in them."""
    first, *others = groups.layers
    x = torch.addmm(first.bias, points, first.weight).index_select(0, groups.rows.flatten())
    x.view(*groups.rows.shape, -1).sub_((centres @ first.weight[-3:])[:, None])
    x = reduce(lambda x, each: each(x), others, first.activate(x))
    return x.view(*groups.rows.shape, -1).amax(dim=1)


class _Pool:
    """One scale of ``pooled``, made chunk by chunk, with one operation between two convolutions.

    The first convolution is linear in point and centre, so it is done once for each: p - t. And as
    relu(p - t) = max(p, t) - t, no layer has to subtract: of x - t, where x = max(p, t), the next
    one, of weight W and bias b, makes p' - t' with p' = x W for each neighbour and t' = t W - b
    once a centre. Subtracting does not change which is the largest; nor do repeats.
    """

    def __init__(self, groups: Groups, points: Tensor, centres: Tensor):
        first, *others = groups.layers
        self._order = torch.argsort(groups.count, descending=True, stable=True)
        self._rows = groups.rows[self._order]
        self._at_point = torch.addmm(first.bias, points, first.weight)
        self._floors = [centres[self._order] @ first.weight[-3:]]
        for each in others:
            self._floors.append(torch.addmm(each.bias, self._floors[-1], each.weight, beta=-1))
        self._weights = [each.weight for each in others]
        self._largest = torch.empty_like(self._floors[-1])
        self._scripted = centres.device.type == "cpu"
        rows = CHUNK if self._scripted else CHUNK_ELSEWHERE
        chunks = list(_chunks(groups.count[self._order].tolist(), rows))
        self.parts = [chunks[i : i + PART] for i in range(0, len(chunks), PART)]
        most = max((end - start) * width for start, end, width in chunks)
        self.sizes = [most * floor.shape[1] for floor in self._floors]  # of the memory for ``fill``

    def fill(self, chunks: Chunks, memory: list[Tensor]) -> None:
        """Finds the largest of these stretches of centres."""
        (_scripted if self._scripted else _fill)(
            *(self._at_point, self._rows, self._floors, self._weights, chunks),
            *(memory, self._largest),
        )

    def result(self) -> Tensor:
        """(M, channels), once all parts are filled."""
        floor = self._floors[-1]
        largest = torch.maximum(self._largest, floor).sub_(floor)
        return torch.empty_like(largest).index_copy_(0, self._order, largest)


def _fill(
    at_point: Tensor,
    rows: Tensor,
    floors: list[Tensor],
    weights: list[Tensor],
    chunks: list[tuple[int, int, int]],
    memory: list[Tensor],
    largest: Tensor,
) -> None:
    """What ``_Pool.fill`` does; ``memory`` is used again for every chunk."""
    for start, end, width in chunks:
        shape = [end - start, width, -1]
        count = (end - start) * width
        x = memory[0][: count * at_point.size(1)].view([count, -1])
        torch.index_select(at_point, 0, rows[start:end, :width].flatten(), out=x)
        for i, weight in enumerate(weights):
            group = x.view(shape)
            torch.maximum(group, floors[i][start:end].unsqueeze(1), out=group)
            y = memory[i + 1][: count * weight.size(1)].view([count, -1])
            x = torch.mm(x, weight, out=y)
        torch.amax(x.view(shape), [1], out=largest[start:end])


def _without_python(function: Callable[..., None]) -> Callable[..., None]:
    """The function as TorchScript, in which threads do not wait for each other; else as it is."""
    if sys.version_info >= (3, 14):  # there torch has none
        return function
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return cast(Callable[..., None], torch.jit.script(function))


_scripted = _without_python(_fill)


def _chunks(widths: Sequence[int], rows: int) -> Iterator[tuple[int, int, int]]:
    """Start, end and width of stretches of the descending widths that fit into so many rows."""
    start = 0
    while start < len(widths):
        end = min(len(widths), start + max(1, rows // widths[start]))
        yield start, end, widths[start]
        start = end
