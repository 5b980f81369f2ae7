"""Contact-GraspNet as a ``Proposer``: from the view's depth to grasps on the things of the cloud.

The network's hand N closes along x and has its origin at the base; it becomes G here.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.errors import InputError, NoGrasp
from tog_drake.panda import MAX_OPENING
from tog_drake.points import Rows
from tog_drake.proposers.contact_graspnet import require_torch
from tog_drake.proposers.contact_graspnet.prediction import Network, Predictions, predict
from tog_drake.proposers.contact_graspnet.regions import (
    ON_THING,
    POINTS,
    local_region,
    scene_points,
    things_of,
    with_count,
)
from tog_drake.proposers.contact_graspnet.selection import select
from tog_drake.proposers.grasp_document import GRIPPERS
from tog_drake.values import Array, Grasps, View
from tog_drake.weights import CONTACT_GRASPNET, stored_file

if TYPE_CHECKING:
    from tog_drake.proposers.contact_graspnet.checkpoint import Checkpoint

X_NG = GRIPPERS["contact_graspnet"]

NOT_RELEASED = (
    "not the released checkpoint of Contact-GraspNet: what it proposes tells nothing of the method"
)


@dataclass
class ContactGraspNet:
    """How the network is asked, and which of its grasps are kept: ``!ContactGraspNet`` in a
    scenario. The network itself, of torch, is ``network.ContactGraspNet``."""

    checkpoint: str | None = None  # file of weights; None: what `tog weights` has stored
    device: str = "auto"  # auto (cuda where there is one), cpu or cuda
    batch_norm: str = "running"  # running, or batch: by the statistics of the present cloud
    regions: str = "scene"
    """What the network is shown at a time: the whole "scene", without segmentation, as in the
    paper; or "local": a cube about each thing, so that every thing gets as many contacts."""
    z_range: list[float] = field(default_factory=lambda: [0.2, 1.8])
    """[m] along z of C: what is nearer or farther is not shown."""
    forward_passes: int = 1  # each begins with another point, and so has other contacts
    first_threshold: float = 0.15  # a score above it: kept, if it is one of those far apart
    second_threshold: float = 0.15  # a score above it: kept, if it is one of the best others
    max_farthest_points: int = 150  # grasps of a region that are kept because they are far apart
    num_samples: int = 200  # grasps of a region that are kept in all


VALID = {
    "device": ("auto", "cpu", "cuda"),
    "batch_norm": ("running", "batch"),
    "regions": ("scene", "local"),
}
MAX_PASSES = 20  # each takes as long as the first


class ContactGraspNetProposer:
    """Proposes what the network says of the view, on the things of the cloud (a ``Proposer``).

    The network is shown table and all, as it was trained. Its contacts are points of the depth
    image; those that are not on a thing of the cloud fall away, before the best are picked: so
    neither the table is grasped nor the robot, nor what is outside the workspace. The other finger
    may be anywhere.

    Args:
        config: thresholds and the like; its ``checkpoint`` is not read here.
        network: a ``ContactGraspNet`` of torch, or what answers like one.
        seed: of which pixels are shown, where there are more than ``POINTS``, and of the points
            that further passes begin with.
        weights: what a record says of the network's weights.

    Raises:
        InputError: a setting is out of its bounds.
    """

    def __init__(
        self,
        config: ContactGraspNet,
        network: Network,
        seed: int,
        weights: Mapping[str, Any] | None = None,
    ):
        _check(config)
        self.weights = weights
        self._config = config
        self._network = network
        self._seed = seed

    def propose(self, cloud: PointCloud, view: View) -> Grasps:
        """Returns grasps, best first.

        Raises:
            NoGrasp: there is none; says how many contacts there were, and how good the best was.
        """
        scene = scene_points(view, self._config.z_range)
        if len(scene) == 0 or cloud.size() == 0:
            near, far = self._config.z_range
            raise NoGrasp(
                f"Contact-GraspNet has nothing to look at: {cloud.size()} points of things, "
                f"{len(scene)} pixels from {near} to {far} m away (z_range)"
            )
        p_WThings = cloud.xyzs().T.astype(np.float64)
        p_CThings = (p_WThings - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
        rng = np.random.default_rng(self._seed)
        on_things, kept = [], []
        for region, things in self._regions(scene, p_CThings):
            shown = with_count(region, POINTS, rng)
            said = predict(self._network, shown, self._config.forward_passes, rng)
            apart = cKDTree(things).query(said.p_CContact, distance_upper_bound=ON_THING)[0]
            on_things.append(said.take(np.flatnonzero(np.isfinite(apart))))
            kept.append(on_things[-1].take(selected(on_things[-1], self._config)))
        if not any(len(said.score) for said in kept):
            raise NoGrasp(_why_none(on_things, self._config))
        return _in_world(kept, view.X_WC)

    def _regions(self, scene: Array, things: Array) -> Iterator[tuple[Array, Array]]:
        """The points to show at a time, and those on which contacts count, (M, 3) in C."""
        if self._config.regions == "scene":
            yield scene, things
            return
        thing = things_of(things)
        for number in range(thing.max() + 1):
            mine = things[thing == number]
            region = local_region(scene, mine)
            if len(region) > 0:
                yield region, mine


def selected(said: Predictions, config: ContactGraspNet) -> Rows:
    """Returns the rows of the grasps of a region that are kept, ascending."""
    return select(
        said.score,
        said.p_CContact,
        first=config.first_threshold,
        second=config.second_threshold,
        spread=config.max_farthest_points,
        most=config.num_samples,
    )


def _in_world(kept: Sequence[Predictions], X_WC: Array) -> Grasps:
    """All grasps that are kept, in the frames of this project, best first."""
    columns = zip(*([getattr(k, f.name) for f in fields(k)] for k in kept), strict=True)
    X_CN, width, score, p_CContact = map(np.concatenate, columns)
    grasps = Grasps(
        X_WG=X_WC @ X_CN @ X_NG,
        width=np.minimum(width, MAX_OPENING),
        score=score,
        p_WContact=p_CContact @ X_WC[:3, :3].T + X_WC[:3, 3],
    )
    return grasps.take(np.argsort(-score, kind="stable"))


def _why_none(on_things: Sequence[Predictions], config: ContactGraspNet) -> str:
    score = np.concatenate([np.zeros(0), *(said.score for said in on_things)])
    if len(score) == 0:
        return (
            "none of the contacts of Contact-GraspNet is on a thing: things may lie beyond z_range "
            f"({config.z_range[0]} to {config.z_range[1]} m away), or be too small in the picture "
            "(`regions: local` looks at each by itself)"
        )
    return (
        f"Contact-GraspNet believes in none of its {len(score)} contacts on things: the best score "
        f"is {score.max():.3f}, and above {config.first_threshold} or {config.second_threshold} "
        "counts (first_threshold, second_threshold)"
    )


def make_contact_graspnet(config: ContactGraspNet, seed: int) -> ContactGraspNetProposer:
    """Returns the proposer with the weights that the config names, loaded once per process.

    Raises:
        InputError: a setting is out of its bounds, torch is missing, or there are no such weights.
    """
    _check(config)
    require_torch()
    from tog_drake.proposers.contact_graspnet.checkpoint import load_network

    network, checkpoint = load_network(
        checkpoint_file(config), device=config.device, batch_norm=config.batch_norm
    )
    return ContactGraspNetProposer(config, network, seed, _weights_record(checkpoint))


def _weights_record(checkpoint: "Checkpoint") -> dict[str, Any]:
    """What a record says of the weights that were loaded: which they are, what that means."""
    return {
        "file": str(checkpoint.file),
        "sha256": checkpoint.sha256,
        "git_sha1": checkpoint.git_sha1,
        "released": checkpoint.released,
        "note": "the released checkpoint" if checkpoint.released else NOT_RELEASED,
    }


def checkpoint_file(config: ContactGraspNet) -> Path:
    """Returns the file of weights that a config names, or that is stored; raises as the latter."""
    if config.checkpoint is not None:
        return Path(config.checkpoint).expanduser()
    return stored_file(CONTACT_GRASPNET)


def _check(config: ContactGraspNet) -> None:
    for name, valid in VALID.items():
        if getattr(config, name) not in valid:
            raise InputError(
                f"proposer: unknown {name} {getattr(config, name)!r}; valid: {', '.join(valid)}"
            )
    if len(config.z_range) != 2 or not 0 <= config.z_range[0] < config.z_range[1]:
        raise InputError(
            f"proposer: z_range must be two distances [m], the nearer first, not {config.z_range}"
        )
    if not 1 <= config.forward_passes <= MAX_PASSES:
        raise InputError(
            f"proposer: forward_passes must be 1 to {MAX_PASSES}, not {config.forward_passes}"
        )
    if not 1 <= config.max_farthest_points <= config.num_samples:
        raise InputError(
            "proposer: max_farthest_points must be at least 1 and at most num_samples; given: "
            f"{config.max_farthest_points} and {config.num_samples}"
        )
    for name in ("first_threshold", "second_threshold"):
        if not 0 <= getattr(config, name) <= 1:
            raise InputError(f"proposer: {name} must be 0 to 1, not {getattr(config, name)}")
