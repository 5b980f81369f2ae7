"""Picks K diverse candidates out of all feasible grasps.

k-means on the contact points gathers the grasps that hold the same place; the most confident of
each cluster stands for it. So a few candidates cover the whole object, which is what a model that
chooses among marks in an image, or a person, needs to see.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.errors import InputError, NoGrasp
from tog_drake.values import Array, Candidates, FeasibleGrasps, Grasps

RESTARTS = 5  # of k-means++; the one of least inertia wins
ITERATIONS = 25  # of Lloyd's algorithm at most; 300 grasps settle in about ten

Labels = NDArray[np.int64]


@dataclass
class CandidatesConfig:
    """How many candidates."""

    k: int | str = 6
    """At least 1, or "auto": the K of highest mean silhouette. On long things that is 2, and both
    candidates may hold the same part; of six, one holds what the task asks for on 68 of 72 tasks
    with the objects that come with the package (of "auto" on 50, of four on 63)."""
    k_max: int = 8
    """The largest K that "auto" tries; more marks than this crowd an image."""


def pick_candidates(grasps: Grasps, config: CandidatesConfig, seed: int) -> Candidates:
    """Clusters the grasps by contact point and picks the most confident of each cluster.

    With no more distinct contact points than K, each is a cluster of its own. The same grasps in
    another order give the same candidates.

    Raises InputError where the config asks for no candidate, NoGrasp where there is no grasp.
    """
    k, k_max = candidate_counts(config)
    if len(grasps) == 0:
        raise NoGrasp("There is no feasible grasp to pick candidates from; move the object nearer.")
    rows = _canonical_order(grasps)
    points = grasps.p_WContact[rows]
    points = points - points.mean(axis=0)  # so that squared distances keep their digits
    rng = np.random.default_rng(seed)
    labels = _best_silhouette(points, k_max, rng) if k is None else _k_means(points, k, rng)
    # ``rows`` begins with the most confident, so the first of each cluster is its best.
    _, first = np.unique(labels, return_index=True)
    first = np.sort(first)
    rank = np.empty(labels.max() + 1, dtype=np.int64)
    rank[labels[first]] = np.arange(len(first))
    cluster = np.empty(len(grasps), dtype=np.int64)
    cluster[rows] = rank[labels]
    return Candidates(grasps, rows[first], cluster)


def candidate_counts(config: CandidatesConfig) -> tuple[int | None, int]:
    """Returns the K asked for (None: auto) and the largest K to try. The command gives K as text.

    Raises:
        InputError: K is neither a whole number of at least 1 nor "auto".
    """
    text = str(config.k).strip().lower()
    if config.k_max < 1:
        raise InputError(f"k_max is {config.k_max}; at least 1 candidate is needed.")
    if text == "auto":
        return None, config.k_max
    if not text.isdecimal() or int(text) < 1:
        raise InputError(f"K is {config.k!r}; give a whole number of at least 1, or 'auto'.")
    return int(text), config.k_max


def _canonical_order(grasps: Grasps) -> Labels:
    """Rows by falling score; equal scores by contact point and pose, never by input order."""
    poses = grasps.X_WG[:, :3].reshape(len(grasps), 12)
    keys = np.column_stack([poses, grasps.width, grasps.p_WContact, -grasps.score])
    return np.lexsort(keys.T).astype(np.int64)


def _k_means(points: Array, k: int, rng: np.random.Generator) -> Labels:
    """Returns labels (N,) in 0..K−1, none empty; fewer than K where points coincide.

    Lloyd's iterations from RESTARTS seedings side by side (first axis R); the least inertia wins.
    """
    distinct = np.unique(points, axis=0)
    if len(distinct) <= k:
        return np.asarray(_squared_distances(points, distinct).argmin(axis=1), dtype=np.int64)
    centres = _seed_centres(points, k, rng)
    squared = _squared_distances(points, centres)
    labels = squared.argmin(axis=2)
    for _ in range(ITERATIONS):
        member = (labels[:, :, None] == np.arange(k)).astype(float)  # (R, N, K)
        count = member.sum(axis=1)[:, :, None]
        mean = member.transpose(0, 2, 1) @ points / np.maximum(count, 1)
        centres = np.where(count > 0, mean, centres)  # an emptied cluster stays where it is
        squared = _squared_distances(points, centres)
        before, labels = labels, squared.argmin(axis=2)
        if np.array_equal(labels, before):
            break
    best = int(squared.min(axis=2).sum(axis=1).argmin())
    return np.unique(labels[best], return_inverse=True)[1].astype(np.int64)


def _seed_centres(points: Array, k: int, rng: np.random.Generator) -> Array:
    """Draws (R, K, 3) of the points, each with probability ∝ squared distance to those before.

    This is the seeding of k-means++ (Arthur and Vassilvitskii 2007).
    """
    centres = points[rng.integers(len(points), size=(RESTARTS, 1))]
    for _ in range(k - 1):
        weight = _squared_distances(points, centres).min(axis=2).cumsum(axis=1)
        draw = rng.random((RESTARTS, 1)) * weight[:, -1:]
        row = np.minimum((weight <= draw).sum(axis=1), len(points) - 1)
        centres = np.concatenate([centres, points[row][:, None]], axis=1)
    return centres


def _squared_distances(a: Array, b: Array) -> Array:
    """(..., N, M) squared distances of (N, 3) to (..., M, 3), by |a|² − 2 a·b + |b|²."""
    cross = a @ b.swapaxes(-1, -2)
    squared = (a**2).sum(axis=-1)[:, None] - 2 * cross + (b**2).sum(axis=-1)[..., None, :]
    return np.asarray(np.maximum(squared, 0.0))


def _best_silhouette(points: Array, k_max: int, rng: np.random.Generator) -> Labels:
    """The clustering with the highest mean silhouette among K = 2..k_max.

    A single cluster has no silhouette: it is taken only where no K ≥ 2 can be had.
    """
    distance = np.sqrt(_squared_distances(points, points))
    best, highest = np.zeros(len(points), dtype=np.int64), -np.inf
    for k in range(2, min(k_max, len(np.unique(points, axis=0))) + 1):
        labels = _k_means(points, k, rng)
        silhouette = _mean_silhouette(distance, labels)
        if silhouette > highest:
            best, highest = labels, silhouette
    return best


def _mean_silhouette(distance: Array, labels: Labels) -> float:
    """Mean of (b − a) / max(a, b) (Rousseeuw 1987); 0 for a point alone in its cluster.

    a is the mean distance to the others of the same cluster, b to those of the nearest other one.
    """
    count = np.bincount(labels)
    member = np.equal.outer(labels, np.arange(len(count))).astype(float)
    total = distance @ member  # (N, K) summed distance of each point to each cluster
    own = np.arange(len(labels)), labels
    a = total[own] / np.maximum(count[labels] - 1, 1)
    mean = total / count
    mean[own] = np.inf
    b = mean.min(axis=1)
    scale = np.maximum(np.maximum(a, b), 1e-12)
    return float(np.where(count[labels] > 1, (b - a) / scale, 0.0).mean())


class CandidatePicker(LeafSystem):
    """Picks diverse candidates out of the feasible grasps.

    .. pydrake_system::

        name: CandidatePicker
        input_ports:
        - feasible_grasps
        output_ports:
        - candidates

    ``candidates`` is computed once per ``feasible_grasps``.
    """

    def __init__(self, config: CandidatesConfig, *, seed: int):
        super().__init__()
        candidate_counts(config)  # a wrong K is said now, not after the first image
        self._config = config
        self._seed = seed
        none = FeasibleGrasps(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0), np.zeros((0, 3)))
        self._feasible_grasps = self.DeclareAbstractInputPort("feasible_grasps", Value(none))
        self.DeclareAbstractOutputPort(
            "candidates",
            alloc=lambda: Value(Candidates.empty()),
            calc=self._CalcCandidates,
            prerequisites_of_calc={self._feasible_grasps.ticket()},
        )

    def _CalcCandidates(self, context: Context, output: Value) -> None:
        grasps = self._feasible_grasps.Eval(context)
        output.set_value(pick_candidates(grasps, self._config, self._seed))
