"""Cuts the observed cloud into the things that stand on the table.

Things apart are told by the gap between them. A heap of things that touch is cut where its surface
turns inwards (a concave crease: two convex things that touch make one) and its colour changes.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tog_drake.points import clusters, group_means, neighbors, voxel_numbers
from tog_drake.values import Array

Labels = NDArray[np.int64]

MAX_GAP = 0.008  # [m] between points of one thing; the cloud is thinned to 3 mm
MIN_POINTS = 60  # a smaller cluster is a speck
MIN_HEIGHT = 0.008  # [m] a cluster that rises no higher is table
MAX_LENGTH, MAX_WIDTH = 0.38, 0.26  # [m] what is longer or wider than this is a heap of things
PATCH = 0.008  # [m] a heap is cut along patches of this size
FLOATING = 0.015  # [m] above the table: what starts higher hangs on something hidden ...
HIDDEN_GAP = 0.06  # [m] ... at most this far away
MIN_FLOATING_POINTS = 12


def segment(points: Array, normals: Array, chroma: Array) -> Labels:
    """Returns which thing each point belongs to: 0..T−1 by falling number of points, −1 for specks.

    Args:
        points: (N, 3) [m], z up, the table at z = 0.
        normals: (N, 3).
        chroma: (N, 3) colours without brightness, see ``colour.chromaticity``.
    """
    label = clusters(neighbors(points, min(24, len(points))), MAX_GAP)
    label = _join_floating(points, chroma, label)
    for heap in range(int(label.max()) + 1):
        rows = np.flatnonzero(label == heap)
        if len(rows) >= MIN_POINTS and _is_heap(points[rows]):
            piece = _cut(points[rows], normals[rows], chroma[rows])
            label[rows] = np.where(piece == 0, heap, label.max() + piece)
    return _ranked(points, label)


def _ranked(points: Array, label: Labels) -> Labels:
    count = np.bincount(label)
    top = np.full(len(count), -np.inf)
    np.maximum.at(top, label, points[:, 2])
    keep = (count >= MIN_POINTS) & (top > MIN_HEIGHT)
    rank = np.full(len(count), -1, dtype=np.int64)
    order = np.argsort(-count, kind="stable")
    rank[order[keep[order]]] = np.arange(keep.sum())
    return rank[label]


def _is_heap(points: Array) -> bool:
    """Longer or wider, from above, than one thing that a hand could hold."""
    xy = points[:, :2] - points[:, :2].mean(axis=0)
    size = np.ptp(xy @ np.linalg.eigh(xy.T @ xy)[1], axis=0)
    return bool(size.max() > MAX_LENGTH or size.min() > MAX_WIDTH)


def _join_floating(points: Array, chroma: Array, label: Labels) -> Labels:
    """Joins what floats to the nearest thing of like colour: what holds it up is hidden."""
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
        if distance.min() < HIDDEN_GAP and alike < 0.15:
            label[mine] = holder
    return label


def _cut(points: Array, normals: Array, chroma: Array) -> Labels:
    """Returns the piece of each point of a heap, 0..P−1."""
    number = voxel_numbers(points, PATCH)
    p, n, c = (group_means(number, values) for values in (points, normals, chroma))
    n /= np.linalg.norm(n, axis=1, keepdims=True) + 1e-9
    distance, row = neighbors(p, min(14, len(p)))
    near = distance < 2 * PATCH
    a, b = np.repeat(np.arange(len(p)), near.sum(axis=1)), row[near]
    a, b = a[a < b], b[a < b]
    # A crease is concave where the normals lean towards each other.
    across = (p[a] - p[b]) / np.linalg.norm(p[a] - p[b], axis=1, keepdims=True)
    angle = np.arccos(np.clip(np.sum(n[a] * n[b], axis=1), -1, 1))
    concave = np.where(np.sum((n[a] - n[b]) * across, axis=1) < 0, angle, 0.0)
    change = np.linalg.norm(c[a] - c[b], axis=1)
    return _merge(len(p), a, b, concave * (CREASE + 4 * change) + CHANGE * change)[number]


CREASE, CHANGE, SCALE = 0.5, 1.0, 1.0  # weights, and how large a piece must be to stand alone


def _merge(count: int, a: Labels, b: Labels, weight: Array) -> Labels:
    """Joins nodes along edges, the lightest first (Felzenszwalb and Huttenlocher 2004).

    Two pieces join over an edge no heavier than the heaviest inside either, plus SCALE / size.
    """
    parent = list(range(count))
    size = [1] * count
    limit = [SCALE] * count

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    order = np.lexsort((b, a, weight))
    for i, j, w in zip(a[order].tolist(), b[order].tolist(), weight[order].tolist(), strict=True):
        r, s = root(i), root(j)
        if r != s and w <= limit[r] and w <= limit[s]:
            parent[s] = r
            size[r] += size[s]
            limit[r] = w + SCALE / size[r]
    return np.unique([root(i) for i in range(count)], return_inverse=True)[1].astype(np.int64)
