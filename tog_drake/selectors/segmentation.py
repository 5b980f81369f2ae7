"""Cuts the observed cloud into the things that stand on the table.

Things apart are told by the gap between them. Out of a heap of things that touch, those of a named
colour are cut by a minimum cut.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree

from tog_drake.points import clusters, group_means, neighbors, voxel_numbers
from tog_drake.values import Array

Labels = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_GAP = 0.008  # [m] between points of one thing; the cloud is thinned to 3 mm
MIN_POINTS = 60  # a smaller cluster is a speck
MIN_HEIGHT = 0.008  # [m] a cluster that rises no higher is table
MAX_LENGTH, MAX_WIDTH = 0.38, 0.26  # [m] what is longer or wider than this is a heap of things
PATCH = 0.008  # [m] a heap is cut along patches of this size
DRAIN = 0.1  # a patch alone is of the colour where the colour fits better than this
CREASE = 0.5  # [rad] a concave crease this sharp weakens the hold between patches to 1 / e
CHANGE = 0.15  # of chromaticity, likewise, but for 40 % that print and paint cannot loosen
MIN_PIECE_POINTS = 150
FLOATING = 0.010  # [m] above the table: what starts higher hangs on something hidden:
NEAR_GAP = 0.015  # [m] on whatever is this near,
HIDDEN_GAP = 0.06  # [m] or on something of like colour at most this far away
UNDER = 0.008  # [m] what is this near to a thing as seen from above is under it
MIN_UNDER = 0.8  # share of a leg that is under its body
ALIKE = 0.15  # sum of differences in chromaticity
MIN_FLOATING_POINTS = 12


def segment(points: Array, chroma: Array) -> Labels:
    """Returns which thing each point belongs to: 0..T−1 by falling number of points, −1 for specks.

    Args:
        points: (N, 3) [m], z up, the table at z = 0.
        chroma: (N, 3) colours without brightness, see ``colour.chromaticity``.
    """
    label = clusters(neighbors(points, min(24, len(points))), MAX_GAP)
    label = _join_floating(points, chroma, label)
    return _ranked(points, _join_legs(points, label))


def _ranked(points: Array, label: Labels) -> Labels:
    count = np.bincount(label)
    top = np.full(len(count), -np.inf)
    np.maximum.at(top, label, points[:, 2])
    keep = (count >= MIN_POINTS) & (top > MIN_HEIGHT)
    rank = np.full(len(count), -1, dtype=np.int64)
    order = np.argsort(-count, kind="stable")
    rank[order[keep[order]]] = np.arange(keep.sum())
    return rank[label]


def is_heap(points: Array) -> bool:
    """Longer or wider, from above, than one thing that a hand could hold."""
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    size = np.ptp(xy @ np.linalg.eigh(xy.T @ xy)[1], axis=0)
    return bool(size.max() > MAX_LENGTH or size.min() > MAX_WIDTH)


def _join_floating(points: Array, chroma: Array, label: Labels) -> Labels:
    """Joins what floats to the nearest thing: what holds it up is hidden.

    So the far wall of a mug joins the near one, and a loop seen over the rim joins its mug.
    """
    label = label.copy()
    count = np.bincount(label)
    for floating in np.flatnonzero(count >= MIN_FLOATING_POINTS):
        mine = label == floating
        if points[mine, 2].min() < FLOATING:
            continue
        others = np.flatnonzero(~mine & (count[label] >= MIN_POINTS))
        if len(others) == 0:
            continue
        distance, nearest = cKDTree(points[others]).query(points[mine])
        holder = label[others[nearest[distance.argmin()]]]
        alike = np.abs(
            np.median(chroma[mine], axis=0) - np.median(chroma[label == holder], axis=0)
        ).sum()
        if distance.min() < (HIDDEN_GAP if alike < ALIKE else NEAR_GAP):
            label[mine] = holder
    return label


def _join_legs(points: Array, label: Labels) -> Labels:
    """Joins what stands under a thing to it: a leg whose upper end the body hides."""
    label = label.copy()
    for leg in np.unique(label):
        mine = label == leg
        others = np.flatnonzero(~mine & (points[:, 2] > np.percentile(points[mine, 2], 90)))
        if mine.sum() < MIN_FLOATING_POINTS or len(others) == 0:
            continue
        distance, nearest = cKDTree(points[others, :2]).query(points[mine, :2])
        under = distance < UNDER
        body = np.bincount(label[others[nearest[under]]], minlength=1)
        gap = points[others[nearest[under]], 2].min(initial=np.inf) - points[mine, 2].max()
        if body.max() > MIN_UNDER * mine.sum() and gap < HIDDEN_GAP:
            label[mine] = body.argmax()
    return label


def cut_out(points: Array, normals: Array, chroma: Array, fits: Array) -> Labels:
    """Cuts the things of a named colour out of a heap of things that touch.

    A minimum cut between source and sink through patches of the surface: the source feeds a patch
    by how well the colour fits it, the sink drains all alike, and neighbouring patches hold
    together unless a concave crease (two convex things that touch make one) or a change of colour
    lies between them. So the black grip between the orange ends of a drill stays with the drill,
    and the can that touches it in a few points does not.

    Args:
        points: (N, 3) [m] of the heap.
        normals: (N, 3).
        chroma: (N, 3).
        fits: (N,) how well the colour fits, 0..1.

    Returns:
        (N,) 0..T−1 for the connected pieces on the side of the source, −1 for the rest.
    """
    number = voxel_numbers(points, PATCH)
    p, n, c = (group_means(number, values) for values in (points, normals, chroma))
    feed = group_means(number, fits[:, None])[:, 0]
    distance, row = neighbors(p, min(14, len(p)))
    near = distance < 2 * PATCH
    a, b = np.repeat(np.arange(len(p)), near.sum(axis=1)), row[near]
    a, b = a[a < b], b[a < b]
    hold = _hold(p, n, c, a, b)
    kept = _source_side(a, b, hold, feed, np.full(len(p), DRAIN))
    both = kept[a] & kept[b]
    graph = coo_array((np.ones(both.sum()), (a[both], b[both])), shape=(len(p), len(p)))
    piece = connected_components(graph, directed=False)[1]
    label = np.where(kept, piece, -1)[number]
    big = np.flatnonzero(np.bincount(label[label >= 0], minlength=1) >= MIN_PIECE_POINTS)
    return np.asarray(np.where(np.isin(label, big), np.searchsorted(big, label), -1))


def _hold(p: Array, n: Array, c: Array, a: Labels, b: Labels) -> Array:
    """How much neighbouring patches a and b hold together, 0..1."""
    n = n / (np.linalg.norm(n, axis=1, keepdims=True) + 1e-9)
    across = (p[a] - p[b]) / np.linalg.norm(p[a] - p[b], axis=1, keepdims=True)
    angle = np.arccos(np.clip(np.sum(n[a] * n[b], axis=1), -1, 1))
    # A crease is concave where the normals lean towards each other.
    concave = np.where(np.sum((n[a] - n[b]) * across, axis=1) < 0, angle, 0.0)
    change = np.linalg.norm(c[a] - c[b], axis=1)
    return np.asarray(
        np.maximum(np.exp(-concave / CREASE) * (0.4 + 0.6 * np.exp(-change / CHANGE)), 0.03)
    )


def _source_side(a: Labels, b: Labels, hold: Array, feed: Array, drain: Array) -> Mask:
    """Which nodes stay with the source when the minimum cut separates it from the sink."""
    count = len(feed)
    nodes, source, sink = np.arange(count), count, count + 1
    begin = np.concatenate([a, b, np.full(count, source), nodes])
    end = np.concatenate([b, a, nodes, np.full(count, sink)])
    capacity = (1000 * np.concatenate([hold, hold, feed, drain])).astype(np.int32)
    graph = csr_array(coo_array((capacity, (begin, end)), shape=(count + 2, count + 2)))
    left = graph - maximum_flow(graph, source, sink).flow
    left.eliminate_zeros()
    reached = np.zeros(count + 2, dtype=bool)
    reached[breadth_first_order(csr_array(left), source, return_predecessors=False)] = True
    return reached[:count]
