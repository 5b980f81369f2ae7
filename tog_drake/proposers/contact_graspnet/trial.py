"""What a network says of a cloud that is built in, and whether its weights have ever been trained.

A network whose weights were never loaded answers too, as confidently as any: what it says has to be
looked at. The cloud shows a box and a cylinder on a table, as a camera one metre away sees them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from tog_drake.errors import NoGrasp
from tog_drake.proposers.contact_graspnet.network import ContactGraspNet
from tog_drake.proposers.contact_graspnet.prediction import Network, predict
from tog_drake.values import Array

CONFIDENT = 0.23  # the published threshold of the score
SAME = 0.01  # scores that differ by less than this say the same of everything

WIDTH, HEIGHT, FOCAL = 200, 100, 400.0  # [pixels] of the camera: 20 000 points, one a pixel
DISTANCE, ELEVATION = 1.0, np.deg2rad(50.0)  # [m], of the camera from the table's middle
BOX = np.array([[0.02, -0.03, 0.0], [0.07, 0.05, 0.08]])  # [m] in W: lower and upper corner
CYLINDER = np.array([-0.08, 0.0, 0.03, 0.12])  # [m] in W: x, y, radius, height
_STRIDE = 7919  # has no divisor in common with the number of pixels


@dataclass(frozen=True)
class Trial:
    """What a network said of the cloud."""

    contacts: int  # with a grasp that is a rigid transform
    confident: int  # of them with a score above CONFIDENT
    lowest: float  # score
    highest: float  # score
    on_things: int  # of the confident ones on the box or the cylinder
    things: float  # share of all contacts that are there

    def __str__(self) -> str:
        text = f"{self.contacts} contacts, {self.confident} above {CONFIDENT}"
        if self.contacts > 0:
            text += f" (lowest {self.lowest:.2f}, highest {self.highest:.2f})"
        if self.confident > 0:
            text += (
                f"; {self.on_things / self.confident:.0%} of these are on the box or the cylinder, "
                f"of all contacts {self.things:.0%}"
            )
        return text


def try_out(network: Network) -> Trial:
    """Asks the network once about the cloud of ``built_in_cloud``."""
    points, thing = built_in_cloud()
    try:
        said = predict(network, points, 1, np.random.default_rng(0))
    except NoGrasp:
        return Trial(0, 0, 0.0, 0.0, 0, 0.0)
    row = cKDTree(points).query(said.p_CContact)[1]  # a contact is a point, but for rounding
    on_thing = thing[row]
    good = said.score > CONFIDENT
    return Trial(
        contacts=len(said.score),
        confident=int(good.sum()),
        lowest=float(said.score.min()),
        highest=float(said.score.max()),
        on_things=int((good & on_thing).sum()),
        things=float(on_thing.mean()),
    )


def untrained_network() -> ContactGraspNet:
    """Returns the network with weights that a training begins with, the same every time."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return ContactGraspNet().eval()


def signs_of_no_training(state: Mapping[str, Tensor], trial: Trial) -> list[str]:
    """Returns what tells that weights were never trained; nothing where nothing does.

    Args:
        state: the network's state dict.
        trial: what it said.
    """

    def all_are(value: float, *ends: str) -> bool:
        """Whether all tensors whose names end so hold this number alone."""
        return all(bool((state[key] == value).all()) for key in state if key.endswith(ends))

    signs = []
    if trial.contacts == 0:
        signs.append("it has no grasp at all: no answer is finite numbers with a rigid pose")
    if all_are(0, ".num_batches_tracked"):
        signs.append("no step of training was ever counted (num_batches_tracked is 0 throughout)")
    if all_are(0, ".running_mean") and all_are(1, ".running_var"):
        signs.append("its statistics are those before training (means 0 and variances 1)")
    if trial.contacts > 0 and trial.highest - trial.lowest < SAME:
        signs.append(f"its scores are the same everywhere, within {SAME}")
    return signs


def built_in_cloud() -> tuple[Array, NDArray[np.bool_]]:
    """Returns the cloud (20000, 3) [m] in C, and which points are on a thing, not on the table."""
    u, v = np.meshgrid(np.arange(WIDTH) - WIDTH / 2 + 0.5, np.arange(HEIGHT) - HEIGHT / 2 + 0.5)
    ray_C = np.stack([u.ravel(), v.ravel(), np.full(u.size, FOCAL)], axis=1) / FOCAL
    # The camera looks along y of W and down; W has its origin in the table's middle.
    down, along = np.sin(ELEVATION), np.cos(ELEVATION)
    R_WC = np.array([[1.0, 0.0, 0.0], [0.0, -down, along], [0.0, -along, -down]])
    eye = -DISTANCE * R_WC[:, 2]
    ray = ray_C @ R_WC.T
    on_table = -eye[2] / ray[:, 2]
    on_thing = np.minimum(_depth_of_box(eye, ray), _depth_of_cylinder(eye, ray))
    points = ray_C * np.minimum(on_table, on_thing)[:, None]
    # Row by row the neighbours of a point that the network looks at would all lie above it.
    order = np.arange(len(points)) * _STRIDE % len(points)
    return points[order], (on_thing < on_table)[order]


def _depth_of_box(eye: Array, ray: Array) -> Array:
    """How far along each ray (N, 3) the box is met, (N,); inf where it is not."""
    with np.errstate(divide="ignore"):
        ends = (BOX[:, None] - eye) / ray
    enter, leave = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where(enter < leave, enter, np.inf)


def _depth_of_cylinder(eye: Array, ray: Array) -> Array:
    """The same for the upright cylinder."""
    x, y, radius, height = CYLINDER
    at = eye[:2] - [x, y]
    # |at + s · ray| = radius seen from above, a s² + 2 b s + c = 0
    a, b, c = (ray[:, :2] ** 2).sum(axis=1), ray[:, :2] @ at, at @ at - radius**2
    inside = b**2 - a * c
    with np.errstate(invalid="ignore"):
        side = (-b - np.sqrt(inside)) / a
    side = np.where((inside > 0) & (eye[2] + side * ray[:, 2] < height), side, np.inf)
    top = (height - eye[2]) / ray[:, 2]
    on_top = ((at + top[:, None] * ray[:, :2]) ** 2).sum(axis=1) < radius**2
    return np.minimum(side, np.where(on_top, top, np.inf))
