"""Plain geometry of sets of points: thinning, neighbours, normals, clusters."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tog_drake.values import Array

Rows = NDArray[np.int64]


def voxel_numbers(points: Array, voxel: float) -> Rows:
    """Returns which cube of edge ``voxel`` each point lies in.

    Args:
        points: (N, 3) [m].
        voxel: [m].

    Returns:
        (N,) 0 .. M−1 for the M cubes that hold a point, numbered by their place (z, then y, then
        x), so that the order of the points does not matter.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    # Integer keys sort about thirty times faster than rows of coordinates do.
    cell = np.floor(points / voxel).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    key = (cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0]
    number: Rows = np.unique(key, return_inverse=True)[1].astype(np.int64)
    return number


def facing_numbers(points: Array, normals: Array, voxel: float) -> Rows:
    """Returns which cube each point lies in, and there on which side of a surface.

    As ``voxel_numbers``, but points whose normal is turned by more than 120° from that of the
    first point of their cube have a number of their own, the next one.

    Args:
        points: (N, 3) [m].
        normals: (N, 3) unit.
        voxel: [m].
    """
    number = voxel_numbers(points, voxel)
    first = np.unique(number, return_index=True)[1]
    turned = np.einsum("ni,ni->n", normals, normals[first][number]) < np.cos(np.radians(120))
    if not turned.any():
        return number
    sides: Rows = np.unique(2 * number + turned, return_inverse=True)[1].astype(np.int64)
    return sides


def group_means(number: Rows, values: Array, weight: Array | None = None) -> Array:
    """Returns the mean of the rows of ``values`` (N, C) in each group 0 .. M−1, as (M, C).

    Args:
        weight: (N,) of each row, above 0; without it all count alike.
    """
    total = np.bincount(number, weight)
    rows = values if weight is None else values * weight[:, None]
    sums = [np.bincount(number, weights=column) for column in rows.T]
    return np.asarray(np.column_stack(sums) / total[:, None])


def neighbors(points: Array, k: int) -> tuple[Array, Rows]:
    """Returns the ``k`` nearest points of each point, itself first.

    Returns:
        (N, k) [m] distances, inf where there are fewer than k points; (N, k) their rows, 0 there.
    """
    distance, row = cKDTree(points).query(points, k=np.arange(1, k + 1), workers=-1)
    return distance, np.where(np.isfinite(distance), row, 0)


def clusters(neighborhood: tuple[Array, Rows], max_gap: float) -> Rows:
    """Returns the cluster of each point: points nearer than ``max_gap`` [m] belong together.

    Args:
        neighborhood: what ``neighbors`` returned.

    Returns:
        (N,) 0 .. number of clusters − 1.
    """
    distance, row = neighborhood
    near = distance < max_gap
    count = len(row)
    end = np.concatenate([[0], np.cumsum(near.sum(axis=1))])
    graph = csr_array((np.ones(end[-1], dtype=np.int8), row[near], end), shape=(count, count))
    label: Rows = connected_components(graph, directed=False)[1].astype(np.int64)
    return label


def surface_normals(
    points: Array, neighborhood: tuple[Array, Rows], max_distance: float, eye: Array
) -> Array:
    """Returns the unit normal of the surface at each point, turned towards ``eye``.

    It is the direction in which the point's neighbours spread least (principal component analysis).

    Args:
        points: (N, 3) [m].
        neighborhood: what ``neighbors`` returned.
        max_distance: [m] neighbours farther away do not count.
        eye: (3,) [m] where the camera is.

    Returns:
        (N, 3).
    """
    distance, row = neighborhood
    near = distance < max_distance
    spread = (points[row] - points[:, None]) * near[..., None]
    mean = spread.sum(axis=1)
    moments = np.matmul(spread.transpose(0, 2, 1), spread)
    moments -= mean[:, :, None] * mean[:, None, :] / near.sum(axis=1)[:, None, None]
    normal = np.linalg.eigh(moments)[1][:, :, 0]
    away = np.einsum("ni,ni->n", normal, eye - points) < 0
    return np.where(away[:, None], -normal, normal)
