"""Whether the camera at the hand should look again before anything is decided, and from where.

What a further look would show is guessed from what has been seen, without ground truth: see
``guessed_surface.py``. Of the guessed surface, a view shows the points that face it, lie in its
image and not behind what its depth shows there. A place to look from would show those that face it
and to which nothing that was seen bars the sight. What counts is what the views show together:

    gain of a look = share shown by (views so far + it) - share shown by the views so far

The look with the greatest gain is taken, of those that the arm can reach without touching anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from pydrake.common.value import Value
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.distance_field import DistanceField
from tog_drake.errors import InputError, NoGrasp, NoImage, NoPlan
from tog_drake.guessed_surface import camera_poses, guessed_shell, standing, unbarred
from tog_drake.obstacles import Obstacles
from tog_drake.panda import MAX_OPENING, Q_LOWER, Q_UPPER
from tog_drake.panda_ik import inverse_kinematics, within_limits
from tog_drake.planning_model import PlanningModel
from tog_drake.selectors.targets import target_or_all
from tog_drake.task import target_words
from tog_drake.transfer import TransferConfig, check_limits, limits_at, plan_transfer
from tog_drake.values import (
    Array,
    CameraView,
    Candidates,
    GraspMotion,
    NextLook,
    Workspace,
)

MOST_LOOKS = 5
_ROLLS = np.radians([0, 30, -30, 60, -60, 90, -90])  # of the image, the upright one first
_Q7 = np.linspace(Q_LOWER[6], Q_UPPER[6], 18)[1:-1]  # [rad]
_POSTURES, _APART = 3, 3  # tried for each roll, every third of the nearest: neighbours are alike
_WAYS = 4  # planned in vain before it is given up
_ON_HAND = 0.3  # [m] a camera farther away from the hand is not mounted on it


@dataclass
class Once:
    """One look, from where the arm is: `!Once {}`."""


@dataclass
class Active:
    """Further looks with the camera at the hand, all of whose views make the cloud: `!Active {}`.

    One is taken where it shows enough more of the target, or where no grasp is found without it.
    """

    max_looks: int = 2  # further ones, at most
    least_gain: float = 0.15  # of the target's surface, as far as it is guessed
    distance: float = 0.30  # [m] between camera and target, at least: nearer, depth cameras are
    # blind (0.25 m of an L515, 0.28 m of a D435)


LookConfig: TypeAlias = Once | Active


@dataclass(frozen=True)
class LookWays:
    """How the arm gets to where the camera looks from."""

    planning_model: PlanningModel
    speed: float  # of the fastest, see ``TrajectoryConfig``
    position_margin: float  # [rad] kept from the joints' position limits
    transfer: TransferConfig
    seed: int

    def posture(self, X_WC: Array, X_HC: Array, q_now: Array, obstacles: Obstacles) -> Array | None:
        """Returns a free posture (7,) [rad] that brings the camera to X_WC (4, 4), if any.

        The image may come out turned; the most upright one is preferred, then the nearest posture.

        Args:
            X_HC: (4, 4) of the camera at the hand.
            q_now: (7,) [rad] where the arm is.
        """
        model = self.planning_model
        X_CH, X_L0W = np.linalg.inv(X_HC), np.linalg.inv(model.X_WL0)
        for roll in _ROLLS:
            X_CR = np.eye(4)
            X_CR[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
            q = inverse_kinematics((X_L0W @ X_WC @ X_CR @ X_CH)[None], _Q7).reshape(-1, 7)
            q = q[within_limits(q, self.position_margin)]
            if len(q) == 0:
                continue
            q = q[obstacles.cloud_clearance(q) >= self.transfer.clearance]
            q = q[np.argsort(np.abs(q - q_now).max(axis=1), kind="stable")]
            near = q[::_APART][:_POSTURES]
            free = model.check_configs(near, MAX_OPENING, hand_margin=True)
            if free.any():
                return np.asarray(near[free.argmax()])
        return None

    def plan(self, q_look: Array, q_now: Array, obstacles: Obstacles) -> GraspMotion:
        """Returns the motion from q_now to q_look (7,) [rad], with the hand open.

        Raises:
            NoPlan: no way was found.
        """
        limits = limits_at(self.speed, self.position_margin, q_now, q_look[None])
        way = "the way to the next look"
        arm, note = plan_transfer(q_now, q_look, way, obstacles, limits, self.transfer, self.seed)
        check_limits(arm, q_now, limits)
        end = arm.end_time()
        hand = PiecewisePolynomial.FirstOrderHold([0.0, end], np.full((1, 2), MAX_OPENING))
        return GraspMotion(arm, hand, end, {"look": 0.0}, note)


def plan_look(
    views: Sequence[CameraView],
    cloud: PointCloud,
    words: str,
    q_now: Array,
    ways: LookWays,
    config: Active,
    table_height: float,
    *,
    least_gain: float,
) -> NextLook:
    """Returns the further look that shows the most, or why there is none.

    Args:
        views: that were taken so far, the present one of the camera at the hand first.
        cloud: of all of them, in W.
        words: of the target, such as "red mug"; "" where nobody says which it is.
        q_now: (7,) [rad] where the arm is, at rest.
        ways: how it gets elsewhere.
        config: see ``Active``.
        table_height: [m] z of the table top in W.
        least_gain: a look that shows no more than this in addition is not taken.

    Raises:
        InputError: the camera is not mounted on the hand.
    """
    own = views[0]
    X_HC = np.linalg.inv(ways.planning_model.X_WH(q_now)) @ own.view.X_WC
    if not np.linalg.norm(X_HC[:3, 3]) < _ON_HAND:
        raise InputError(
            f"look: !Active moves the camera at the hand, but {own.camera} is "
            f"{np.linalg.norm(X_HC[:3, 3]):.2f} m away from it; valid: pipeline.camera that is "
            "mounted on the hand, or look: !Once {}"
        )
    points = np.asarray(cloud.xyzs().T, np.float64)
    meant = target_or_all(cloud, words, own.view.rgb, table_height)
    try:
        shell = guessed_shell(points[meant.mask], table_height, ways.seed)
    except NoGrasp as error:
        return NextLook(None, f"No further look: {error}.")
    shown = np.any([shell.shown(each.view) for each in views], axis=0)
    X_WC = camera_poses(shell, own.view.intrinsics, config.distance)
    others = DistanceField(standing(points[~meant.mask], table_height))
    new = [shell.facing(X[:3, 3]) & unbarred(shell, X[:3, 3], others) & ~shown for X in X_WC]
    gain = np.mean(new, axis=1)
    obstacles = Obstacles(
        ways.planning_model, DistanceField(standing(points, table_height)), MAX_OPENING
    )
    share = float(shown.mean())
    best = f"{meant.how}; about {share:.0%} of its surface is shown"
    worth = [i for i in np.argsort(-gain, kind="stable") if gain[i] > least_gain]
    if not worth:
        reason = f"{best}; no further look would add more than {least_gain:.0%}."
        return NextLook(None, reason, shown=share, expected=share)
    i, motion = _first_reached(ways, X_WC[worth], X_HC, q_now, obstacles)
    if motion is None:
        reason = f"{best}; none of {len(worth)} better places is reached."
        return NextLook(None, reason, shown=share, expected=share)
    n = 1 + sum(each.camera.startswith(f"{own.camera}#") for each in views)
    expected = float(share + gain[worth[i]])
    return NextLook(
        motion,
        f"{best}, with another look {expected:.0%}.",
        X_WC[worth[i]],
        share,
        expected,
        CameraView(f"{own.camera}#{n}", own.view, q_now.copy()),
    )


def _first_reached(
    ways: LookWays, X_WC: Array, X_HC: Array, q_now: Array, obstacles: Obstacles
) -> tuple[int, GraspMotion | None]:
    """Returns the first of the places (D, 4, 4) to which there is a way, and that way, if any."""
    planned = 0
    for i, place in enumerate(X_WC):
        q_look = ways.posture(place, X_HC, q_now, obstacles)
        if q_look is None:
            continue
        try:
            return i, ways.plan(q_look, q_now, obstacles)
        except NoPlan:
            planned += 1
        if planned == _WAYS:
            break
    return -1, None


class LookPlanner(LeafSystem):
    """Plans a further look with the camera at the hand, if one is worth it.

    .. pydrake_system::

        name: LookPlanner
        input_ports:
        - views
        - cloud
        - candidates
        - task
        - panda.position_measured
        output_ports:
        - next_look

    ``next_look`` is computed once per change of an input. ``candidates`` are asked for only where
    no look is worth it: if there are none, any that shows something new is.

    Args:
        config: see ``Active``.
        workspace: tells how high the table is.
        ways: how the arm gets to where it looks from.
        target: the object's words; None: they are found in the task.
    """

    def __init__(
        self, config: Active, workspace: Workspace, ways: LookWays, target: str | None = None
    ):
        super().__init__()
        if not 1 <= config.max_looks <= MOST_LOOKS:
            raise InputError(
                f"look: max_looks is {config.max_looks}; valid: 1 to {MOST_LOOKS} further looks"
            )
        if not (0 <= config.least_gain < 1 and config.distance > 0):
            raise InputError(
                f"look: least_gain ({config.least_gain}) must be at least 0 and below 1, distance "
                f"({config.distance}) above 0 [m]"
            )
        self._config, self._workspace, self._ways = config, workspace, ways
        self._target = target
        self._views = self.DeclareAbstractInputPort("views", Value(()))
        self._cloud = self.DeclareAbstractInputPort("cloud", Value(PointCloud(0)))
        self._candidates = self.DeclareAbstractInputPort("candidates", Value(Candidates.empty()))
        self._task = self.DeclareAbstractInputPort("task", Value(""))
        self._position = self.DeclareVectorInputPort("panda.position_measured", 7)
        ports = (self._views, self._cloud, self._candidates, self._task, self._position)
        self.DeclareAbstractOutputPort(
            "next_look",
            alloc=lambda: Value(NextLook.none()),
            calc=self._CalcNextLook,
            prerequisites_of_calc={port.ticket() for port in ports},
        )

    def _CalcNextLook(self, context: Context, output: Value) -> None:
        try:
            look = self._plan(context, self._config.least_gain)
            if look.motion is None and not self._is_graspable(context):
                look = self._plan(context, 0.0)
        except (NoGrasp, NoImage) as error:  # the stages that follow will say so
            look = NextLook(None, f"No further look: {error}.")
        output.set_value(look)

    def _plan(self, context: Context, least_gain: float) -> NextLook:
        return plan_look(
            self._views.Eval(context),
            self._cloud.Eval(context),
            target_words(self._task.Eval(context), self._target),
            self._position.Eval(context),
            self._ways,
            self._config,
            self._workspace.table_height,
            least_gain=least_gain,
        )

    def _is_graspable(self, context: Context) -> bool:
        """Whether there is a grasp that the arm can carry out, as far as was seen."""
        try:
            self._candidates.Eval(context)
        except NoGrasp:
            return False
        return True
