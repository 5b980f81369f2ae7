"""Collision-free joint paths: RRT-Connect and shortcuts, over any check of configurations.

A path is a row of joint positions, (P, 7) [rad], so dense that no joint moves more than ``step``
between two of them; every one has been checked. The robot and the world enter only through a
callback ``count_free(q (N, 7)) -> int``: how many configurations, from the first on, are free.
Asking for many at once is far cheaper than one by one, and behind the first hit nobody looks.

Source of the algorithm: Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query
path planning", ICRA 2000.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from tog_drake.errors import NoPlan
from tog_drake.values import Array

CountFree: TypeAlias = Callable[[Array], int]

_BATCH = 10  # configurations asked at once while a tree grows; those behind an obstacle are wasted


def straight_line(q_from: Array, q_to: Array, step: float) -> Array:
    """Returns evenly spaced points from ``q_from`` to ``q_to``, both included, (P, 7), P >= 2.

    Args:
        q_from, q_to: (7,) [rad].
        step: largest change of any joint between two points [rad].
    """
    count = max(1, int(np.ceil(np.abs(q_to - q_from).max() / step)))
    s = np.linspace(0, 1, count + 1)[:, None]
    return np.asarray((1 - s) * q_from + s * q_to)


def find_path(
    q_start: Array,
    q_goal: Array,
    count_free: CountFree,
    lower: Array,
    upper: Array,
    rng: np.random.Generator,
    *,
    step: float = 0.05,
    max_iterations: int = 1000,
) -> Array:
    """Returns a collision-free path: the straight line if it is free, else by RRT-Connect.

    Args:
        q_start, q_goal: (7,) [rad].
        count_free: see the module's docstring.
        lower, upper: (7,) [rad] where random configurations are drawn.
        rng: decides everything that is random.
        step: between two checked configurations [rad].
        max_iterations: random configurations tried.

    Returns:
        (P, 7) [rad], the path from ``q_start`` to ``q_goal``.

    Raises:
        NoPlan: an end is in collision, or no path was found within ``max_iterations``.
    """
    for name, q in (("start", q_start), ("goal", q_goal)):
        if count_free(q[None]) == 0:
            raise NoPlan(
                f"no path: its {name} is in collision or too near to something; choose another "
                "grasp or clear the scene"
            )
    straight = straight_line(q_start, q_goal, step)
    if count_free(straight) == len(straight):
        return straight
    tree, other = _Tree(q_start), _Tree(q_goal)
    for iteration in range(max_iterations):
        q_random = rng.uniform(lower, upper)
        if tree.extend(q_random, count_free, step) and other.connect(tree.newest, count_free, step):
            from_start, from_goal = (tree, other) if iteration % 2 == 0 else (other, tree)
            return np.concatenate([from_start.branch(), from_goal.branch()[::-1][1:]])
        tree, other = other, tree
    raise NoPlan(
        f"no path between two free configurations was found in {max_iterations} iterations of "
        "RRT-Connect: the arm is hemmed in; choose another grasp or clear the scene"
    )


def shortcut(
    path: Array,
    count_free: CountFree,
    rng: np.random.Generator,
    *,
    step: float = 0.05,
    attempts: int = 60,
) -> Array:
    """Returns a path with the same ends that is never longer, by trying random straight cuts.

    Args:
        path: (P, 7) [rad].
        count_free: see the module's docstring.
        rng: draws where to cut.
        step: between two checked configurations [rad].
        attempts: cuts tried.
    """
    for _ in range(attempts):
        i, j = np.sort(rng.integers(0, len(path), 2))
        along = np.linalg.norm(np.diff(path[i : j + 1], axis=0), axis=1).sum()
        if along < np.linalg.norm(path[j] - path[i]) + 1e-6:
            continue  # straight already
        cut = straight_line(path[i], path[j], step)
        if count_free(cut) == len(cut):
            path = np.concatenate([path[:i], cut, path[j + 1 :]])
    return path


def corners(path: Array) -> Array:
    """Returns the path without the points that lie on the line between their neighbours."""
    steps = np.diff(path, axis=0)
    directions = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    turns = np.abs(np.diff(directions, axis=0)).max(axis=1) > 1e-6
    return np.asarray(path[np.concatenate([[True], turns, [True]])])


class _Tree:
    """A tree of free configurations; every edge is at most ``step`` long."""

    def __init__(self, root: Array):
        self._nodes: Array = np.empty((256, root.size))
        self._nodes[0] = root
        self._parents = [-1]

    @property
    def newest(self) -> Array:
        return np.asarray(self._nodes[len(self._parents) - 1])

    def extend(self, q_target: Array, count_free: CountFree, step: float) -> bool:
        """Grows by one batch towards ``q_target``; returns whether it grew at all."""
        nearest, line = self._line_to(q_target, step)
        return self._append(nearest, line[:_BATCH], count_free) > 0

    def connect(self, q_target: Array, count_free: CountFree, step: float) -> bool:
        """Grows towards ``q_target`` until blocked; returns whether it arrived."""
        parent, line = self._line_to(q_target, step)
        for first in range(0, len(line), _BATCH):
            batch = line[first : first + _BATCH]
            if self._append(parent, batch, count_free) < len(batch):
                return False
            parent = len(self._parents) - 1
        return True

    def branch(self) -> Array:
        """Returns the path from the root to the newest node, (P, 7)."""
        rows = []
        node = len(self._parents) - 1
        while node >= 0:
            rows.append(node)
            node = self._parents[node]
        return np.asarray(self._nodes[rows[::-1]])

    def _line_to(self, q_target: Array, step: float) -> tuple[int, Array]:
        """Returns the nearest node, and the points from it (not included) to ``q_target``."""
        nodes = self._nodes[: len(self._parents)]
        nearest = int(np.argmin(((nodes - q_target) ** 2).sum(axis=1)))
        return nearest, straight_line(nodes[nearest], q_target, step)[1:]

    def _append(self, parent: int, batch: Array, count_free: CountFree) -> int:
        """Adds the free points at the head of ``batch`` as a chain; returns how many."""
        count = count_free(batch)
        size = len(self._parents)
        if size + count > len(self._nodes):
            self._nodes = np.concatenate([self._nodes, np.empty_like(self._nodes)])
        self._nodes[size : size + count] = batch[:count]
        self._parents += [parent, *range(size, size + count - 1)][:count]
        return count
