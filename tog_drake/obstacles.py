"""What a motion must not touch - the robot itself, the known world, what the camera saw - and how
far it stays from it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from tog_drake.distance_field import DistanceField
from tog_drake.errors import NoPlan
from tog_drake.panda import MAX_OPENING, link_frames
from tog_drake.planning_model import BASE_LINK, PlanningModel, is_arm
from tog_drake.values import Array

CHECK_STEP = 0.01
"""[rad] between the configurations at which a trajectory is checked: turning the first joint so far
moves the outstretched hand by 9 mm, and what lies between two checks by less than the 5 mm of
``planning_model.MARGIN``."""
_NEAR = 0.05  # [m] bodies farther apart than this do not explain a collision


@dataclass(frozen=True)
class Obstacles:
    """What the arm must not touch: itself, the known world, and what the camera saw."""

    planning_model: PlanningModel
    field: DistanceField
    opening: float  # [m] of the hand, to be exact about the table; near the cloud it counts as open

    def cloud_clearance(self, q: Array, with_hand: bool = True) -> Array:
        """Returns the least distance between the moving robot and the cloud at q (N, 7), (N,)."""
        clearance, _ = self._spheres_clearance(q, with_hand)
        return np.asarray(clearance.min(axis=1))

    def cloud_clearance_and_gradient(self, q: Array) -> tuple[Array, Array]:
        """Returns ``cloud_clearance`` (N,) [m] and its gradient (N, 7) [m/rad]."""
        clearance, p_W = self._spheres_clearance(q, with_hand=True)
        nearest = clearance.argmin(axis=1)
        rows = np.arange(len(q))
        p = p_W[rows, nearest, None, :]  # (N, 1, 3)
        h = self.field.voxel / 2 * np.eye(3)
        slope = (self.field.distance(p + h) - self.field.distance(p - h)) / self.field.voxel
        # A joint turns a sphere about its z axis, if the sphere is on a link beyond it.
        X_WL = self.planning_model.X_WL0 @ link_frames(q)[:, 1:8]
        dp_dq = np.cross(X_WL[..., :3, 2], p - X_WL[..., :3, 3])  # (N, 7, 3)
        beyond = np.arange(7) < self.planning_model.cover.link[nearest, None]
        gradient = np.einsum("nij,nj->ni", dp_dq, slope) * beyond
        return clearance[rows, nearest], gradient

    def count_free(self, q: Array, clearance: float, *, hand_margin: bool = False) -> int:
        """Returns how many of q (N, 7), from the first on, touch nothing.

        ``clearance`` [m] is kept from the cloud, which is asked first: it answers faster. For
        ``hand_margin`` see ``PlanningModel.check_configs``.
        """
        count = _leading(self.cloud_clearance(q) >= clearance)
        check = self.planning_model.check_configs
        return _leading(check(q[:count], self.opening, hand_margin=hand_margin))

    def require_free(self, q: Array, what: str, remedy: str) -> None:
        """Raises NoPlan if q (7,) touches anything."""
        reason = self._touches(q[None])
        if reason is not None:
            raise NoPlan(f"{what} is not free: {reason[1]}; {remedy}")

    def check(
        self,
        segment: Trajectory,
        what: str,
        *,
        with_hand: bool = True,
        hand_margin: bool = False,
    ) -> None:
        """Raises NoPlan if the segment touches anything.

        Args:
            segment: of the arm.
            what: the segment is, for a person.
            with_hand: whether the hand, too, must not touch the cloud.
            hand_margin: see ``PlanningModel.check_configs``.
        """
        times, q = _dense(segment, CHECK_STEP)
        reason = self._touches(q, with_hand, hand_margin)
        if reason is not None:
            raise NoPlan(
                f"{what} is not free {times[reason[0]] - times[0]:.2f} s after its start: "
                f"{reason[1]}; choose another grasp or clear the scene"
            )

    def _touches(
        self, q: Array, with_hand: bool = True, hand_margin: bool = False
    ) -> tuple[int, str] | None:
        """Returns the first of q (N, 7) that touches anything, and what; None if there is none."""
        clearance, _ = self._spheres_clearance(q, with_hand)
        if clearance.min() < 0:
            i = int(np.argmax(clearance.min(axis=1) < 0))
            body = self.planning_model.cover.body[int(clearance[i].argmin())]
            depth = -1e3 * clearance[i].min()
            return i, f"{body} comes nearer than is safe to what the camera saw, by {depth:.0f} mm"
        free = self.planning_model.check_configs(q, self.opening, hand_margin=hand_margin)
        if not free.all():
            i = int(np.argmin(free))
            return i, self._known_contact(q[i], hand_margin)
        return None

    def _known_contact(self, q: Array, hand_margin: bool) -> str:
        """Says which known bodies are too near to each other at q (7,)."""
        model = self.planning_model
        positions = model.full_positions(q, self.opening)
        try:
            checker = model.wary_checker if hand_margin else model.checker
            found = checker.CalcRobotClearance(positions, influence_distance=_NEAR)
        except RuntimeError as error:  # FCL gives up on a few degenerate contacts
            return f"a distance between known bodies cannot be computed ({error})"
        nearest = int(np.argmin(found.distances()))
        pair = found.robot_indices()[nearest], found.other_indices()[nearest]
        names = " and ".join(model.plant.get_body(index).name() for index in pair)
        depth = -1e3 * found.distances()[nearest]
        return f"{names} come nearer to each other than is safe, by {depth:.0f} mm"

    def _spheres_clearance(self, q: Array, with_hand: bool) -> tuple[Array, Array]:
        """Returns the clearance (N, S) of each sphere and its centre (N, S, 3) in W."""
        p_W, radius, body = self.planning_model.spheres(q, MAX_OPENING)
        clearance = self.field.distance(p_W) - radius
        for sphere, name in enumerate(body):
            if name == BASE_LINK or not (with_hand or is_arm(name)):
                clearance[:, sphere] = np.inf
        return clearance, p_W


def _leading(free: NDArray[np.bool_]) -> int:
    """How many are true before the first that is not."""
    return len(free) if free.all() else int(np.argmin(free))


def _dense(segment: Trajectory, step: float) -> tuple[Array, Array]:
    """Returns times (N,) and configurations (N, 7) so close that no joint moves by ``step``."""
    times = np.linspace(segment.start_time(), segment.end_time(), 1001)
    moved = np.abs(np.diff(segment.vector_values(times), axis=1)).max(axis=0)
    way = np.concatenate([[0.0], np.cumsum(moved)])
    count = int(np.ceil(way[-1] / (0.9 * step))) + 1
    times = np.interp(np.linspace(0, way[-1], count + 1), way, times)
    return times, segment.vector_values(times).T
