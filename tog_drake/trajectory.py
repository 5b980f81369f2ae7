"""From a choice to a motion: look posture → pregrasp → grasp → close → lift → hold."""

from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem
from pydrake.trajectories import CompositeTrajectory, PiecewisePolynomial, Trajectory

from tog_drake.distance_field import DistanceField
from tog_drake.errors import InputError, NoPlan
from tog_drake.obstacles import Obstacles
from tog_drake.panda import MAX_OPENING, Q_LOWER, Q_UPPER, arrival_opening
from tog_drake.planning_model import PlanningModel
from tog_drake.time_parameterization import PEAK_SPEED, JointLimits, rest_to_rest
from tog_drake.transfer import TransferConfig, check_limits, limits_at, plan_transfer
from tog_drake.values import Array, Candidates, Choice, FeasibleGrasps, GraspMotion

_POSTURE_TOLERANCE = 0.01  # [rad] by which a measured posture may pass a position limit


@dataclass
class TrajectoryConfig:
    """How fast the arm moves, and how the hand closes."""

    speed: float = 0.6  # of the fastest; 0.5 takes twice as long (acceleration ¼, jerk ⅛)
    approach_speed: float = 0.15  # [m/s] of the hand, at most, on the straight way to the grasp
    lift_speed: float = 0.25  # [m/s] of the hand, at most, on the straight way up
    position_margin: float = 0.02  # [rad] kept from the joints' position limits
    transfer: TransferConfig = field(default_factory=TransferConfig)
    closed: float = -0.02  # [m] commanded opening: beyond contact, so that the hand presses
    closing_speed: float = 0.1  # [m/s] of the commanded opening
    settle_time: float = 0.2  # [s] of standing still with the hand closed, before the lift
    hold_time: float = 2.5  # [s] of standing still after the lift


def plan_motion(
    choice: Choice,
    candidates: Candidates,
    q_now: Array,
    cloud: PointCloud,
    planning_model: PlanningModel,
    config: TrajectoryConfig,
    seed: int,
    *,
    with_retreat: bool = False,
    opens_fully: bool = False,
) -> GraspMotion:
    """Returns a motion that carries out the choice, or its first alternative that has one.

    The hand opens while the arm goes to the pregrasp by the fastest clear spline that is found;
    then come the straight approach, closing, the straight lift and a hold. The segments meet at
    rest. Every segment is checked densely against itself, the known world and the cloud, and
    against all limits, before it is returned. On the approach and the lift the hand is not checked
    against the cloud: it is there to touch it, and what it may touch was decided with the grasp.

    Args:
        choice: which of the grasps, and which others instead.
        candidates: their grasps are FeasibleGrasps, with the joint paths of approach and lift.
        q_now: (7,) [rad] where the motion starts, at rest.
        cloud: what the camera saw, in W.
        planning_model: what the robot knows.
        config: see ``TrajectoryConfig``.
        seed: decides everything that is random.
        with_retreat: whether the way back is planned too, with its hand empty. Where there is
            none the motion says so in its note: better no other try than no try.
        opens_fully: whether the hand arrives as wide as it can, whatever the grasp's width.

    Raises:
        NoPlan: saying of each grasp which check failed, where and by how much.
        InputError: a speed that is none.
    """
    grasps = candidates.grasps
    if choice.index < 0 or not isinstance(grasps, FeasibleGrasps):
        raise NoPlan(
            f"the choice is row {choice.index} of {len(grasps)} grasps of type "
            f"{type(grasps).__name__}: a row of FeasibleGrasps is needed, which carries the joint "
            "paths of approach and lift"
        )
    _require_plausible(q_now)
    points = np.asarray(cloud.xyzs().T, dtype=float)
    points = points[np.isfinite(points).all(axis=1)]
    field = DistanceField(points)
    failures: list[str] = []
    for row in (choice.index, *choice.alternatives):
        opening = float(arrival_opening(grasps.width[row], fully=opens_fully))
        obstacles = Obstacles(planning_model, field, opening)
        obstacles.require_free(q_now, "the arm's present posture", "move the arm away by hand")
        grasp = grasps.take(np.array([row]))
        try:
            obstacles.require_free(
                grasp.q_pregrasp[0], "the pregrasp posture", "choose another grasp"
            )
            motion = _plan_grasp(
                grasp.q_approach[0], grasp.q_lift[0], q_now, obstacles, config, seed
            )
        except NoPlan as error:
            failures.append(f"grasp {row}: {error}")
            continue
        note = motion.note + (", in place of " if failures else "") + "; ".join(failures)
        motion = replace(motion, grasp_index=row, grasp=grasp, note=note)
        return _with_retreat(motion, obstacles, config, seed) if with_retreat else motion
    raise NoPlan("; ".join(failures))


def _plan_grasp(
    q_approach: Array,
    q_lift: Array,
    q_now: Array,
    obstacles: Obstacles,
    config: TrajectoryConfig,
    seed: int,
) -> GraspMotion:
    """Returns the motion of one grasp, whose approach is (A, 7) and whose lift is (L, 7)."""
    limits = _limits(config, q_now, np.vstack([q_approach, q_lift]))
    planning_model, opening = obstacles.planning_model, obstacles.opening

    way = "the way to the pregrasp"
    transfer, note = plan_transfer(
        q_now, q_approach[0], way, obstacles, limits, config.transfer, seed
    )
    t = transfer.end_time()
    approach = _straight(q_approach, config.approach_speed, planning_model, limits, t)
    obstacles.check(approach, "the approach", with_hand=False)
    t_close = approach.end_time()
    t_lift = t_close + (opening - config.closed) / config.closing_speed + config.settle_time
    lift = _straight(q_lift, config.lift_speed, planning_model, limits, t_lift)
    obstacles.check(lift, "the lift", with_hand=False)
    t_hold = lift.end_time()
    end = t_hold + config.hold_time

    closing = _still(q_approach[-1], t_close, t_lift)
    arm = CompositeTrajectory([transfer, approach, closing, lift, _still(q_lift[-1], t_hold, end)])
    check_limits(arm, q_now, limits)
    return GraspMotion(
        arm=arm,
        hand=PiecewisePolynomial.FirstOrderHold(
            [0.0, t_close, t_lift - config.settle_time, end],
            np.array([[opening, opening, config.closed, config.closed]]),
        ),
        duration=end,
        phase_times={"approach": t, "close": t_close, "lift": t_lift, "hold": t_hold},
        note=note,
    )


def _with_retreat(
    motion: GraspMotion, obstacles: Obstacles, config: TrajectoryConfig, seed: int
) -> GraspMotion:
    """Adds the way back: the hand opens where it is, and the arm goes to where it began.

    The cloud is that of the look before the motion: where the grasp has moved things, the next look
    will tell.
    """
    q_from, q_to = (motion.arm.value(t).ravel() for t in (motion.duration, 0.0))
    limits = _limits(config, q_to, q_from[None])
    obstacles = replace(obstacles, opening=MAX_OPENING)
    try:
        obstacles.require_free(q_from, "the posture after the lift", "choose another grasp")
        way, note = plan_transfer(
            q_from, q_to, "the way back", obstacles, limits, config.transfer, seed
        )
    except NoPlan as error:
        return replace(motion, note=f"{motion.note}; no way back: {error}")
    t = (MAX_OPENING - config.closed) / config.closing_speed
    end = t + way.end_time()
    arm = CompositeTrajectory.AlignAndConcatenate([_still(q_from, 0.0, t), way])
    check_limits(arm, q_from, limits)
    hand = PiecewisePolynomial.FirstOrderHold(
        [0.0, t, end], np.array([[config.closed, MAX_OPENING, MAX_OPENING]])
    )
    return replace(motion, retreat=GraspMotion(arm, hand, end, {"back": t}, note))


def _require_plausible(q_now: Array) -> None:
    """Raises NoPlan for a posture that the arm cannot have; a silent driver reports zeros."""
    outside = np.maximum(Q_LOWER - q_now, q_now - Q_UPPER)
    if not outside.max() <= _POSTURE_TOLERANCE:  # NaN is not, either
        joint = int(np.argmax(np.where(np.isnan(outside), np.inf, outside)))
        raise NoPlan(
            f"the arm's present posture is not possible: joint {joint + 1} at {q_now[joint]:.3f} "
            f"rad, valid are {Q_LOWER[joint]:.3f} to {Q_UPPER[joint]:.3f}; is its driver running?"
        )


def _limits(config: TrajectoryConfig, q_now: Array, q_path: Array) -> JointLimits:
    """The robot's limits at the configured speed; see ``limits_at``."""
    if min(config.approach_speed, config.lift_speed, config.closing_speed) <= 0:
        raise InputError(
            "trajectory: approach_speed, lift_speed and closing_speed must be above 0 [m/s]"
        )
    if min(config.settle_time, config.hold_time) < 0:
        raise InputError("trajectory: settle_time and hold_time must not be below 0 [s]")
    return limits_at(config.speed, config.position_margin, q_now, q_path)


def _straight(
    path: Array, hand_speed: float, planning_model: PlanningModel, limits: JointLimits, start: float
) -> Trajectory:
    """Times a Cartesian line of the hand, given at equal steps in joint angles (P, 7)."""
    length = float(np.linalg.norm(np.diff(planning_model.X_WG(path[[0, -1]])[:, :3, 3], axis=0)))
    return rest_to_rest(path, limits, start, PEAK_SPEED * length / hand_speed)


def _still(q: Array, start: float, end: float) -> Trajectory:
    return PiecewisePolynomial.FirstOrderHold([start, end], np.stack([q, q], axis=1))


class TrajectoryOptimizer(LeafSystem):
    """Plans the motion that carries out the choice.

    .. pydrake_system::

        name: TrajectoryOptimizer
        input_ports:
        - choice
        - candidates
        - cloud
        - panda.position_measured
        output_ports:
        - motion

    ``motion`` is computed once per change of an input.
    """

    def __init__(
        self,
        config: TrajectoryConfig,
        planning_model: PlanningModel,
        *,
        seed: int,
        with_retreat: bool = False,
        opens_fully: bool = False,
    ):
        super().__init__()
        self._with_retreat = with_retreat
        self._opens_fully = opens_fully
        self._config = config
        self._planning_model = planning_model
        self._seed = seed
        self._choice = self.DeclareAbstractInputPort("choice", Value(Choice.none()))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._position = self.DeclareVectorInputPort("panda.position_measured", 7)
        self.DeclareAbstractOutputPort(
            "motion",
            alloc=lambda: Value(GraspMotion.still()),
            calc=self._CalcMotion,
            prerequisites_of_calc={
                self._choice.ticket(),
                self._candidates.ticket(),
                self._cloud.ticket(),
                self._position.ticket(),
            },
        )

    def _CalcMotion(self, context: Context, output: Value) -> None:
        output.set_value(
            plan_motion(
                self._choice.Eval(context),
                self._candidates.Eval(context),
                self._position.Eval(context),
                self._cloud.Eval(context),
                self._planning_model,
                self._config,
                self._seed,
                with_retreat=self._with_retreat,
                opens_fully=self._opens_fully,
            )
        )
