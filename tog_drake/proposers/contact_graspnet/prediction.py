"""What the network says of a cloud, in the frame of the camera.

The network is shown points in a frame of its own: C turned by half a turn about z (x left, y up, z
forward), with its origin in the points' mean. Here, and nowhere else, they get there and its
answers back. N is the hand as the network has it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tog_drake.errors import NoGrasp
from tog_drake.points import Rows
from tog_drake.values import Array

if TYPE_CHECKING:
    from torch import Tensor

Network = Callable[["Tensor"], dict[str, "Tensor"]]
"""From points (1, N, 3) in its frame to what ``ContactGraspNet.forward`` returns."""

HALF_TURN = np.array([-1.0, -1.0, 1.0])  # from C to its frame and back: x and y change sign
_SKEW = 1e-3  # a matrix whose columns are this far from orthonormal is no rotation


@dataclass(frozen=True)
class Predictions:
    """M grasps as the network sees them, in C. Every array has M rows."""

    X_CN: Array  # (M, 4, 4) N: x closing, z approach, origin at the hand's base
    width: Array  # (M,) [m] between the contacts
    score: Array  # (M,) in [0, 1]
    p_CContact: Array  # (M, 3) [m] points that the network was shown

    def take(self, rows: Rows) -> "Predictions":
        """Returns the grasps of ``rows``, in that order."""
        return Predictions(
            self.X_CN[rows], self.width[rows], self.score[rows], self.p_CContact[rows]
        )


def predict(network: Network, points: Array, passes: int, rng: np.random.Generator) -> Predictions:
    """Asks the network about a cloud, once or several times.

    Each pass after the first puts another point in the place of the first, with which the network
    begins to spread its contacts; so they become others.

    Args:
        network: see ``Network``.
        points: (N, 3) [m] in C, N ≥ 1.
        passes: 1 or more.
        rng: picks the points to begin with.

    Returns:
        2048 grasps a pass in the network's order, less those whose pose is no rigid transform or
        whose other numbers are not finite.

    Raises:
        NoGrasp: these are all.
    """
    import torch

    p = points * HALF_TURN
    mean = p.mean(axis=0)
    shown = (p - mean).astype(np.float32)
    answers = []
    for number in range(passes):
        order = np.arange(len(shown))
        if number > 0:
            start = int(rng.integers(len(shown)))
            order[[0, start]] = order[[start, 0]]
        answers.append(network(torch.from_numpy(shown[order])[None]))

    def rows(key: str, *shape: int) -> Array:
        said = torch.cat([answer[key].reshape(-1, *shape) for answer in answers])
        return np.asarray(said.cpu().numpy(), dtype=np.float64)

    X_CN, rigid = _rigid(rows("pred_grasps_cam", 4, 4))
    X_CN[:, :3, 3] += mean
    X_CN[:, :3] *= HALF_TURN[:, None]
    contact = (rows("pred_points", 3) + mean) * HALF_TURN
    said = Predictions(X_CN, rows("offset_pred"), rows("pred_scores"), contact).take(rigid)
    finite = np.isfinite(said.width) & np.isfinite(said.score)
    if not finite.any():
        raise NoGrasp(
            f"Contact-GraspNet gives no grasp: of its {len(X_CN)} answers none is finite numbers "
            "with a rigid pose; its weights make no sense, see `tog weights check`"
        )
    return said.take(np.flatnonzero(finite))


def _rigid(X: Array) -> tuple[Array, Rows]:
    """The poses (M, 4, 4) with rotations that are exact in double precision, and the rows of
    those that were rigid transforms: weights that make no sense lead to others, too."""
    X = np.where(np.isfinite(X).all(axis=(1, 2), keepdims=True), X, 0.0)
    x, z = X[:, :3, 0], X[:, :3, 2]
    R = X[:, :3, :3]
    skew = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    rigid = np.flatnonzero((skew < _SKEW) & (np.linalg.det(R) > 0))
    with np.errstate(invalid="ignore"):  # of those that are not
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
        z = z - np.einsum("mi,mi->m", z, x)[:, None] * x
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
    X[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    return X, rigid
