"""Which of the proposed grasps the robot can carry out, and why not the others.

Decided before any model is asked. A grasp is a straight approach along z_G, closing, and a straight
lift along z_W; it passes, in this order, the questions of ``REASONS``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem

from tog_drake.distance_field import DistanceField
from tog_drake.errors import InputError, NoFeasibleGrasp, NoGrasp
from tog_drake.hand_boxes import disturbs_others, hand_boxes, lowest_corner, points_inside
from tog_drake.panda import (
    FINGER_BODIES,
    MAX_OPENING,
    Q_LOWER,
    Q_UPPER,
    X_HG,
    arrival_opening,
    grasps_apart,
)
from tog_drake.panda_ik import BRANCHES, follow_path, inverse_kinematics, within_limits
from tog_drake.planning_model import BASE_LINK, PlanningModel
from tog_drake.values import Array, FeasibleGrasps, Grasps, View, Workspace
from tog_drake.visibility import hidden_share

Bools = NDArray[np.bool_]
Fates = NDArray[np.int64]  # what became of each grasp: the number of a reason, or _FEASIBLE

REASONS = {
    "failed_before": "hardly differ from a grasp that failed before",
    "table_collision": "would push the hand into the table",
    "hand_collision": "would push the hand into something that the camera sees",
    "disturbs_others": "would close on or rise into another thing than what is held",
    "hidden": "would push a finger to where the camera could not see",
    "no_ik": "are out of the arm's reach",
    "no_approach": "cannot be approached in a straight line",
    "no_lift": "cannot be lifted in a straight line",
    "arm_collision": "would bring the arm into collision with something that the camera sees",
    "self_collision": "would bring the arm into collision with itself or the table",
}
"""What a grasp can fail on, in the order of the tests, and how to say it."""

_FAILED, _TABLE, _HAND, _OTHERS, _HIDDEN, _NO_IK, _NO_APPROACH, _NO_LIFT, _ARM, _SELF, _FEASIBLE = (
    range(len(REASONS) + 1)
)
_HAND_BODIES = ("panda_hand", *FINGER_BODIES)
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z_G: the other finger takes the other side
_CHECKED = 8  # about every eighth point of an approach or a lift is tested against the cloud
_APART = 3  # neighbours in the ranking of configurations are alike: every third is tried


@dataclass
class FeasibilityConfig:
    """How much room the robot demands."""

    pregrasp_distance: float = 0.10  # [m] from which the hand approaches, along z_G
    lift_height: float = 0.20  # [m] along z_W: clear of the table even for what hangs from the hand
    approach_points: int = 9  # of the straight approach, both ends included
    lift_points: int = 17
    max_joint_step: float = 0.10  # [rad] between neighbouring points
    limit_margin: float = 0.05  # [rad] kept from every joint limit
    q7_samples: int = 24  # around the circle
    attempts: int = 6  # configurations tried per grasp, the most convenient first
    hand_tolerance: float = 0.002  # [m] by which points may enter the hand's boxes: depth noise
    stray_points: int = 2  # that may be inside nevertheless: flying pixels
    lift_clearance: float = 0.004  # [m] of the hand from other things while it lifts
    max_hidden: float = 0.4  # share of a finger's end that may be hidden by what the camera saw
    table_clearance: float = 0.001  # [m] of the hand above the table
    cloud_clearance: float = 0.01  # [m] of the arm from the cloud
    failed_distance: float = 0.03  # [m] nearer than this in place and ...
    failed_turn: float = 0.5  # [rad] ... in turn to a grasp that failed: it would fail again


def feasible_grasps(
    grasps: Grasps,
    cloud: PointCloud,
    q_now: Array,
    planning_model: PlanningModel,
    config: FeasibilityConfig,
    *,
    table_height: float = 0.0,
    failed: Grasps | None = None,
    views: Sequence[View] = (),
    opens_fully: bool = False,
) -> FeasibleGrasps:
    """Returns the grasps that can be carried out, in their order, with the paths that do it.

    What happens to one grasp depends on no other grasp. Where it is more convenient, a grasp comes
    back turned by half a turn about z_G: for a hand with two fingers it is the same.

    Args:
        grasps: N proposals.
        cloud: what the camera saw, in W, without table and robot.
        q_now: (7,) [rad]; configurations near to it are preferred.
        planning_model: arm, hand and known world.
        config: the room demanded.
        table_height: [m] z of the table top in W.
        failed: grasps that were tried and held nothing; what is like them is rejected.
        views: what the cloud was made from; without them nothing counts as hidden.
        opens_fully: whether the hand arrives as wide as it can, whatever the grasp's width.

    Raises:
        NoGrasp: there are no proposals.
        NoFeasibleGrasp: all were rejected; its message and ``rejected`` say why.
    """
    if len(grasps) == 0:
        raise NoGrasp("no grasp was proposed: show the object better, or use another proposer")
    points = cloud.xyzs().T[np.isfinite(cloud.xyzs()).all(axis=0)]
    opening = arrival_opening(grasps.width, fully=opens_fully)
    lower, upper = hand_boxes(opening, config.pregrasp_distance)
    low = lowest_corner(grasps.X_WG, lower, upper) < table_height + config.table_clearance
    tolerance = config.hand_tolerance
    inside = points_inside(grasps.X_WG, lower + tolerance, upper - tolerance, points)
    blocked = (inside > config.stray_points) | (grasps.width > MAX_OPENING)
    others = disturbs_others(grasps, opening, points, config.lift_height, config.lift_clearance)
    hidden = hidden_share(grasps.X_WG, opening, views) > config.max_hidden
    again = _like(grasps, Grasps.empty() if failed is None else failed, config)
    fate = np.select(
        [again, low, blocked, others, hidden],
        [_FAILED, _TABLE, _HAND, _OTHERS, _HIDDEN],
        default=_NO_IK,
    )

    rows = np.flatnonzero(fate == _NO_IK)
    world = _World(planning_model, DistanceField(points), config)
    fate[rows], q_approach, q_lift = _carry_out(world, grasps.X_WG[rows], opening[rows], q_now)

    rejected = {reason: int((fate == i).sum()) for i, reason in enumerate(REASONS)}
    if not (fate == _FEASIBLE).any():
        raise NoFeasibleGrasp(_explain(len(grasps), rejected), rejected)
    good = fate[rows] == _FEASIBLE
    kept = grasps.take(rows[good])
    return FeasibleGrasps(
        X_WG=_turned_like(kept.X_WG, planning_model.X_WG(q_lift[good, 0])),
        width=kept.width,
        score=kept.score,
        p_WContact=kept.p_WContact,
        q_approach=q_approach[good],
        q_lift=q_lift[good],
        rejected=rejected,
    )


def _like(grasps: Grasps, failed: Grasps, config: FeasibilityConfig) -> Bools:
    """Tells which grasps (N,) are hardly different from one that failed."""
    place, turn = grasps_apart(grasps.X_WG[:, None], failed.X_WG)
    near = (place < config.failed_distance) & (turn < config.failed_turn)
    return np.asarray(near.any(axis=1))


def _turned_like(X_WG: Array, X_WG_reached: Array) -> Array:
    """Returns the grasps X_WG (N, 4, 4), turned about z_G where the hand reaches them so."""
    turned = (X_WG[:, :3, 1] * X_WG_reached[:, :3, 1]).sum(axis=-1) < 0
    return np.where(turned[:, None, None], X_WG @ _HALF_TURN, X_WG)


def _explain(proposed: int, rejected: dict[str, int]) -> str:
    parts = [f"{count} {REASONS[reason]}" for reason, count in rejected.items() if count]
    return (
        f"0 of {proposed} grasps can be carried out: {', '.join(parts)}. "
        "Move the object nearer or clear what surrounds it, or propose more grasps"
    )


@dataclass(frozen=True)
class _World:
    """What the arm moves in, and how much room it keeps."""

    planning_model: PlanningModel
    field: DistanceField
    config: FeasibilityConfig


def _carry_out(
    world: _World, X_WG: Array, opening: Array, q_now: Array
) -> tuple[Fates, Array, Array]:
    """Tries several configurations for each of N grasps, the most convenient first.

    Returns:
        The best that each grasp came to (N,), the approaches (N, A, 7) and the lifts (N, L, 7);
        these mean something where the grasp is feasible.
    """
    config = world.config
    X_retreat, X_lift = _straight_lines(X_WG, world.planning_model.X_WL0, config)
    q_grasp, turned = _convenient_configurations(X_lift[:, 0], q_now, config)
    fate = np.full(len(X_WG), _NO_IK)
    q_approach = np.full((*X_retreat.shape[:2], 7), np.nan)
    q_lift = np.full((*X_lift.shape[:2], 7), np.nan)
    for attempt in range(q_grasp.shape[1]):
        row = np.flatnonzero((fate < _FEASIBLE) & np.isfinite(q_grasp[:, attempt, 0]))
        if len(row) == 0:
            break
        half_turn = np.where(turned[row, attempt, None, None, None], _HALF_TURN, np.eye(4))
        came_to, q_approach[row], q_lift[row] = _carry_out_from(
            world,
            q_grasp[row, attempt],
            X_retreat[row] @ half_turn,
            X_lift[row] @ half_turn,
            opening[row],
        )
        fate[row] = np.maximum(fate[row], came_to)
    return fate, q_approach, q_lift


def _straight_lines(X_WG: Array, X_WL0: Array, config: FeasibilityConfig) -> tuple[Array, Array]:
    """Returns the poses X_L0H of retreat (N, A, 4, 4) and lift (N, L, 4, 4), from the grasp on."""
    back = np.linspace(0, -config.pregrasp_distance, config.approach_points)
    up = np.linspace(0, config.lift_height, config.lift_points)
    retreat = np.repeat(X_WG[:, None], len(back), axis=1)
    retreat[..., :3, 3] += back[:, None] * X_WG[:, None, :3, 2]
    lift = np.repeat(X_WG[:, None], len(up), axis=1)
    lift[..., 2, 3] += up
    X_L0W, X_GH = np.linalg.inv(X_WL0), np.linalg.inv(X_HG)
    return np.asarray(X_L0W @ retreat @ X_GH), np.asarray(X_L0W @ lift @ X_GH)


def _convenient_configurations(
    X_L0H: Array, q_now: Array, config: FeasibilityConfig
) -> tuple[Array, Bools]:
    """Returns good configurations for each pose: near to ``q_now`` and far from the limits.

    Returns:
        (N, attempts, 7) [rad], nan where there are fewer, and whether the hand is turned by half a
        turn about z_G (N, attempts). That is the same grasp, and joint 7 alone does it.
    """
    # Around the circle, and at each place in the nearer of two ways that are inside the limits.
    ways = np.linspace(-np.pi, np.pi, config.q7_samples, endpoint=False)
    ways = np.stack([ways, ways - np.copysign(np.pi, ways)])
    margin = config.limit_margin
    possible = (ways >= Q_LOWER[6] + margin) & (ways <= Q_UPPER[6] - margin)
    turned = np.argmin(np.where(possible, np.abs(ways - q_now[6]), np.inf), axis=0)
    q = inverse_kinematics(X_L0H, ways[0])
    q[..., 6] = ways[turned, np.arange(len(turned))][:, None]

    q = q.reshape(len(q), len(turned) * BRANCHES, 7)
    crowding = np.abs(q - (Q_LOWER + Q_UPPER) / 2) / ((Q_UPPER - Q_LOWER) / 2)
    cost = np.linalg.norm(q - q_now, axis=-1) + crowding.max(axis=-1)
    impossible = ~within_limits(q, margin)
    cost[impossible], q[impossible] = np.inf, np.nan
    ranking = np.argsort(cost, axis=1, kind="stable")[:, ::_APART][:, : config.attempts]
    return np.take_along_axis(q, ranking[..., None], axis=1), turned[ranking // BRANCHES] == 1


def _carry_out_from(
    world: _World, q_grasp: Array, X_retreat: Array, X_lift: Array, opening: Array
) -> tuple[Fates, Array, Array]:
    """Tries one configuration for each of N grasps; returns what ``_carry_out`` does."""
    config = world.config
    room = {"max_step": config.max_joint_step, "limit_margin": config.limit_margin}
    fate = np.full(len(q_grasp), _NO_APPROACH)
    q_approach = follow_path(X_retreat, q_grasp, **room)[:, ::-1]
    q_lift = np.full((*X_lift.shape[:2], 7), np.nan)

    row = np.flatnonzero(np.isfinite(q_approach).all(axis=(1, 2)))
    fate[row] = _NO_LIFT
    q_lift[row] = follow_path(X_lift[row], q_grasp[row], **room)

    row = row[np.isfinite(q_lift[row]).all(axis=(1, 2))]
    q = np.concatenate([_checked(q_approach[row]), _checked(q_lift[row])[:, 1:]], axis=1)
    fate[row] = _ARM
    clear = _clear_of_cloud(world, q)

    row = row[clear]
    fate[row] = _SELF
    check = world.planning_model.check_configs
    # Only where approach and lift end; the planner tests all between them, for the chosen grasp.
    q = np.stack([q_approach[row, 0], q_grasp[row], q_lift[row, -1]], axis=1)
    free = [check(*pair).all() for pair in zip(q, opening[row], strict=True)]
    fate[row[np.array(free, dtype=bool)]] = _FEASIBLE
    return fate, q_approach, q_lift


def _checked(path: Array) -> Array:
    """Returns both ends of paths (N, P, 7) and about every eighth point between them."""
    steps = path.shape[1] - 1
    return path[:, np.linspace(0, steps, -(-steps // _CHECKED) + 1).round().astype(int)]


def _clear_of_cloud(world: _World, q: Array) -> Bools:
    """Tells which rows of q (N, K, 7), pregrasp first, keep clear of the cloud, (N,).

    The hand counts at the pregrasp alone: nearer to the target, its boxes have been tested. The
    base cannot move.
    """
    p_W, radius, body = world.planning_model.spheres(q.reshape(-1, 7), MAX_OPENING)
    clear = world.field.distance(p_W) >= radius + world.config.cloud_clearance
    clear = clear.reshape(*q.shape[:2], len(radius))
    clear[:, 1:, np.isin(body, _HAND_BODIES)] = True
    clear[..., np.isin(body, BASE_LINK)] = True
    return np.asarray(clear.all(axis=(1, 2)))


class FeasibilityFilter(LeafSystem):
    """Keeps the grasps that the robot can carry out.

    .. pydrake_system::

        name: FeasibilityFilter
        input_ports:
        - grasps
        - cloud
        - view
        - panda.position_measured
        - failed_grasps
        output_ports:
        - feasible_grasps

    ``feasible_grasps`` is computed once per change of an input.

    Args:
        fused: whether the cloud is of all cameras; then ``views`` takes the place of ``view``.
        opens_fully: as in ``feasible_grasps``.
    """

    def __init__(
        self,
        config: FeasibilityConfig,
        workspace: Workspace,
        planning_model: PlanningModel,
        *,
        fused: bool = False,
        opens_fully: bool = False,
    ):
        super().__init__()
        if (
            min(config.approach_points, config.lift_points) < 2
            or min(config.q7_samples, config.attempts) < 1
        ):
            raise InputError(
                "feasibility: approach_points and lift_points must be at least 2, q7_samples and "
                "attempts at least 1"
            )
        self._config = config
        self._opens_fully = opens_fully
        self._table_height = workspace.table_height
        self._planning_model = planning_model
        self._grasps = self.DeclareAbstractInputPort("grasps", Value(Grasps.empty()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._position = self.DeclareVectorInputPort("panda.position_measured", 7)
        self._failed = self.DeclareAbstractInputPort("failed_grasps", Value(Grasps.empty()))
        self._fused = fused
        if fused:
            self._images = self.DeclareAbstractInputPort("views", Value(()))
        else:
            self._images = self.DeclareAbstractInputPort("view", Value(View.empty()))
        ports = (self._grasps, self._cloud, self._images, self._position, self._failed)
        none = FeasibleGrasps(**vars(Grasps.empty()))
        self.DeclareAbstractOutputPort(
            "feasible_grasps",
            alloc=lambda: Value(none),
            calc=self._CalcFeasibleGrasps,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcFeasibleGrasps(self, context: Context, output: Value) -> None:
        images = self._images.Eval(context)
        output.set_value(
            feasible_grasps(
                self._grasps.Eval(context),
                self._cloud.Eval(context),
                self._position.Eval(context),
                self._planning_model,
                self._config,
                table_height=self._table_height,
                failed=self._failed.Eval(context),
                views=[image.view for image in images] if self._fused else [images],
                opens_fully=self._opens_fully,
            )
        )
