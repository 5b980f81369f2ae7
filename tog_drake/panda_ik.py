"""Inverse kinematics of the Panda: in closed form, and along a path.

Joint 7 is the free parameter, after Y. He and S. Liu, "Analytical Inverse Kinematics for Franka
Emika Panda - a Geometrical Solver for 7-DOF Manipulators with Unconventional Design" (ICCMA 2021).
With q7 given, frame 6 is known, and three points span all that is left: the shoulder S (joints
1–3 meet), the elbow E (joint 4), the wrist P (joints 5 and 6 meet)::

    S ── 0.316 ──┐ 0.0825            |SE| and |EP| are constant, |SP| is known, so q4 follows up
                 E                   to the side on which the elbow folds (2 branches);
    P ── 0.384 ──┘ 0.0825            S seen from joint 6 gives q6 (2) and then q5;
                                     what is left of the rotation is q1, q2, q3, ZYZ angles (2).
"""

import numpy as np
from numpy.typing import NDArray

from tog_drake.panda import DH_A, DH_D, FLANGE_Z, HAND_YAW, Q_LOWER, Q_UPPER, link_frames
from tog_drake.values import Array

BRANCHES = 8

_A = float(DH_A[3])  # [m] offset of the elbow from both links
_D3, _D5 = float(DH_D[2]), float(DH_D[4])  # [m] upper arm and forearm
_SHOULDER_Z = float(DH_D[0])  # [m]
_UPPER2, _FORE2 = _A**2 + _D3**2, _A**2 + _D5**2  # [m²] |SE|², |EP|²
_STRAIGHT = float(np.arctan(_D3 / _A) + np.arctan(_D5 / _A))  # [rad] angle SEP at q4 = 0
# A target is called out of reach only beyond rounding: the sine or cosine may pass 1 by this much.
_ROUNDING = 1e-12

# Damped least squares.
_DAMPING = 0.003  # [m or rad per rad] compared with the singular values of the Jacobian
_NEWTON_STEPS = 6  # for a pose 0.15 m away; three or four are usual
_TOLERANCE = 1e-6  # [rad], [m]


def inverse_kinematics(X_L0H: Array, q7: Array) -> Array:
    """Returns every configuration that puts the hand body at X_L0H with the given q7.

    Joint limits are the caller's matter: angles lie in (−π, π], but q6 in (−1.27, 5.01], around the
    middle of its range, and q4 in (−3.61, 2.67]. So no configuration inside the limits is missed.

    Singular are: q2 = 0, where q1 + q3 alone is determined (one of the many is returned); the
    shoulder on the axis of joint 6, where q6 is free (one or none is returned); q4 = 0, outside the
    limits. At q4 = −0.467 and at |q5| = π/2 two branches meet: there the angles are good to 1e-8.

    Args:
        X_L0H: (N, 4, 4) poses of the hand body in the arm's base frame.
        q7: (M,) [rad], the same for all poses, or (N, M).

    Returns:
        (N, M, 8, 7) [rad], nan where there is no real solution. Branch b = 4·elbow + 2·wrist +
        shoulder keeps its meaning along a path: elbow 0 is q4 ≤ −0.467, 1 is q4 ≥ −0.467 (the arm
        nearly straight); wrist tells the two q6; shoulder 1 is the flip q2 < 0.
    """
    p6, R06 = _frame6(X_L0H, q7)
    v = np.array([0.0, 0.0, _SHOULDER_Z]) - p6  # from the wrist to the shoulder, in L0
    v6x, v6y, v6z = (np.einsum("...i,...i->...", R06[..., i], v) for i in range(3))

    # Elbow: the law of cosines; folded to either side.
    with np.errstate(invalid="ignore"):
        cos_gamma = (_UPPER2 + _FORE2 - np.sum(v**2, -1)) / (2 * np.sqrt(_UPPER2 * _FORE2))
        gamma = np.arccos(_clip_rounding(cos_gamma))
    q4 = np.stack([_STRAIGHT - 2 * np.pi + gamma, _STRAIGHT - gamma], axis=-1)[..., None]
    c4, s4 = np.cos(q4), np.sin(q4)

    # The shoulder in frame 5: `along` its z axis, `radial` across, where q5 turns it to.
    along = _A * s4 - _D3 * c4 - _D5
    radial = _A * (1 - c4) - _D3 * s4

    # Wrist: v5z = v6x sin(q6) + v6y cos(q6) = `along` has two solutions.
    v6x, v6y, v6z = v6x[..., None, None], v6y[..., None, None], v6z[..., None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        turn = np.arcsin(_clip_rounding(along / np.hypot(v6x, v6y)))
        q6 = np.concatenate([turn, np.pi - turn], axis=-1) - np.arctan2(v6y, v6x)
        q6 = _wrap(q6, centre=1.8675)
        c6, s6 = np.cos(q6), np.sin(q6)
        c5, s5 = (c6 * v6x - s6 * v6y) / radial, v6z / radial * np.ones_like(c6)
    q5 = np.arctan2(s5, c5)

    # The axes of frame 3 in frame 6, then in L0.
    x3 = np.stack([c4 * c5 * c6 - s4 * s6, -c4 * c5 * s6 - s4 * c6, c4 * s5], axis=-1)
    z3 = np.stack([s4 * c5 * c6 + c4 * s6, -s4 * c5 * s6 + c4 * c6, s4 * s5], axis=-1)
    R60 = np.swapaxes(R06, -1, -2)[..., None, :, :]
    x3, z3 = x3 @ R60, z3 @ R60

    # Shoulder: R03 = Rz(q1) Ry(q2) Rz(q3); q3 is measured about z3 from wherever q1 is.
    q1 = np.arctan2(z3[..., 1], z3[..., 0])
    q2 = np.arctan2(np.hypot(z3[..., 0], z3[..., 1]), z3[..., 2])
    c1, s1 = np.cos(q1), np.sin(q1)
    y3x = z3[..., 1] * x3[..., 2] - z3[..., 2] * x3[..., 1]
    y3y = z3[..., 2] * x3[..., 0] - z3[..., 0] * x3[..., 2]
    q3 = np.arctan2(c1 * x3[..., 1] - s1 * x3[..., 0], c1 * y3y - s1 * y3x)

    q = np.empty((*q6.shape, 2, 7))
    q[..., 0, 0], q[..., 1, 0] = q1, _half_turn(q1)
    q[..., 0, 1], q[..., 1, 1] = q2, -q2
    q[..., 0, 2], q[..., 1, 2] = q3, _half_turn(q3)
    q[..., 3], q[..., 4], q[..., 5] = q4[..., None], q5[..., None], q6[..., None]
    q[..., 6] = q7[..., None, None, None]
    q[np.isnan(q1)] = np.nan  # whatever failed above, q1 knows
    return q.reshape(*p6.shape[:2], BRANCHES, 7)


def _frame6(X_L0H: Array, q7: Array) -> tuple[Array, Array]:
    """Returns the origin (N, M, 3) and the axes (N, M, 3, 3) of the frame of joint 6 in L0."""
    R, p = X_L0H[:, None, :3, :3], X_L0H[:, None, :3, 3]
    turn = q7 + HAND_YAW  # of the hand about z7, from where frame 7 lies with q7 = 0
    c, s = np.cos(turn)[..., None], np.sin(turn)[..., None]
    # R67 = RotX(π/2) RotZ(turn), so in L0: x6 = R (c, −s, 0), y6 = −z_H, z6 = R (s, c, 0).
    x6 = c * R[..., 0] - s * R[..., 1]
    z6 = s * R[..., 0] + c * R[..., 1]
    y6 = np.broadcast_to(-R[..., 2], x6.shape)
    p6 = p - FLANGE_Z * R[..., 2] - float(DH_A[6]) * x6
    return p6, np.stack([x6, y6, z6], axis=-1)


def _clip_rounding(x: Array) -> Array:
    """Clips a sine or cosine to [−1, 1] if it is outside by rounding; beyond, nan will follow."""
    return np.where(np.abs(x) <= 1 + _ROUNDING, np.clip(x, -1, 1), np.nan)


def _wrap(angle: Array, centre: float) -> Array:
    """Moves angles by whole turns into (centre − π, centre + π]."""
    return angle - 2 * np.pi * np.ceil((angle - centre - np.pi) / (2 * np.pi))


def _half_turn(angle: Array) -> Array:
    """Adds half a turn to angles in (−π, π]; the result is there, too."""
    return np.where(angle > 0, angle - np.pi, angle + np.pi)


def follow_path(
    X_L0H: Array, q_start: Array, *, max_step: float = 0.1, limit_margin: float = 0.0
) -> Array:
    """Returns smooth joint paths along Cartesian ones.

    With q7 fixed and in closed form, where that is smooth. It is not near q2 = 0, where q1 swings
    against q3; there damped least squares use the redundancy to go around.

    Args:
        X_L0H: (N, P, 4, 4) poses of the hand body in the arm's base frame.
        q_start: (N, 7) [rad] at the first pose of each path.
        max_step: [rad] that a joint may move between neighbouring poses.
        limit_margin: [rad] kept from all joint limits.

    Returns:
        (N, P, 7) [rad], all nan where none was found.
    """
    path = _follow_in_closed_form(X_L0H, q_start)
    rough = ~_is_smooth(path, max_step, limit_margin)
    path[rough] = _follow_by_least_squares(X_L0H[rough], q_start[rough])
    path[~_is_smooth(path, max_step, limit_margin)] = np.nan
    return path


def within_limits(q: Array, margin: float) -> NDArray[np.bool_]:
    """Tells which of q (..., 7) keep ``margin`` [rad] from all limits, (...); nan does not."""
    return np.asarray(((q >= Q_LOWER + margin) & (q <= Q_UPPER - margin)).all(axis=-1))


def _is_smooth(path: Array, max_step: float, limit_margin: float) -> NDArray[np.bool_]:
    steps = np.abs(np.diff(path, axis=1)).max(axis=(1, 2), initial=0.0)
    return np.asarray(within_limits(path, limit_margin).all(axis=1) & (steps <= max_step))


def _follow_in_closed_form(X_L0H: Array, q_start: Array) -> Array:
    """Keeps q7 and takes at each pose the branch nearest to the pose before, (N, P, 7) or nan."""
    count, length = X_L0H.shape[:2]
    q7 = np.repeat(q_start[:, 6], length)[:, None]
    solutions = inverse_kinematics(X_L0H.reshape(-1, 4, 4), q7)
    solutions = solutions.reshape(count, length, BRANCHES, 7)
    path = np.repeat(q_start[:, None], length, axis=1)
    for i in range(1, length):
        jump = np.abs(solutions[:, i] - path[:, i - 1, None]).max(axis=-1)
        nearest = np.where(np.isfinite(jump), jump, np.inf).argmin(axis=-1)
        path[:, i] = solutions[np.arange(count), i, nearest]
    return path


def _follow_by_least_squares(X_L0H: Array, q_start: Array) -> Array:
    """Solves for each pose by Newton steps of least norm, all from ``q_start``, (N, P, 7) or nan.

    Since all start alike, what is found changes as smoothly as the poses do.
    """
    X = X_L0H.reshape(-1, 4, 4)
    q = np.repeat(q_start, X_L0H.shape[1], axis=0)
    missed = np.arange(len(q))
    for newton_step in range(_NEWTON_STEPS + 1):
        error, J = _error_and_jacobian(q[missed], X[missed])
        far = np.abs(error).max(axis=-1) >= _TOLERANCE
        missed, error, J = missed[far], error[far, :, None], J[far]
        if len(missed) == 0 or newton_step == _NEWTON_STEPS:
            break
        Jt = np.swapaxes(J, -1, -2)
        damped = J @ Jt + _DAMPING**2 * np.eye(6)
        q[missed] += (Jt @ np.linalg.solve(damped, error))[..., 0]
    q[missed] = np.nan
    return q.reshape(*X_L0H.shape[:2], 7)


def _error_and_jacobian(q: Array, X_desired: Array) -> tuple[Array, Array]:
    """Returns the missing twist (N, 6) (rotation, translation; in L0) and its Jacobian."""
    X = link_frames(q)
    axis, origin = X[..., 1:8, :3, 2], X[..., 1:8, :3, 3]
    R, p = X[..., 8, :3, :3], X[..., 8, :3, 3]
    rotation = np.cross(R, X_desired[..., :3, :3], axis=-2).sum(axis=-1) / 2
    error = np.concatenate([rotation, X_desired[..., :3, 3] - p], axis=-1)
    J = np.concatenate([axis, np.cross(axis, p[..., None, :] - origin)], axis=-1)
    return error, np.swapaxes(J, -1, -2)
