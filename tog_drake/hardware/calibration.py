"""Where the camera sits on the hand, found from views of a board that stands still.

The arm shows the camera a ChArUco board from many postures. With H the hand, C the camera, L0 the
arm's base and T the board ("target"), every view says X_L0T = X_L0H · X_HC · X_CT, where X_L0H is
the measured posture's and X_CT what the image shows. What is sought is X_HC.

A closed form (Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group",
1994) is the start; then the mount and the board's place are adjusted together until the corners are
where the images have them, as far as errors of corners and joint angles allow. (OpenCV 5 no longer
offers ``calibrateHandEye`` in Python, which solves the first half.)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tog_drake.errors import InputError
from tog_drake.panda import forward_kinematics
from tog_drake.values import Array, Intrinsics

MIN_VIEWS = 6
MIN_CORNERS = 8  # of the board, in a view that counts
MIN_TURN = np.radians(15)  # rms turn between two views about the axis that they turn most about
MIN_SECOND_TURN = np.radians(6)  # and about the one at right angles to it that comes next
MAX_ERROR = 3.0  # [pixel] rms; more means that something is not as it was said to be

# What a view is believed to: an arm that is off by a millimetre at the hand shifts all its corners
# together by far more than a corner is off on its own.
_SIGMA_CORNER = 0.2  # [pixel]
_SIGMA_JOINT = 5e-4  # [rad]


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with a marker in every white square."""

    columns: int = 7  # squares
    rows: int = 5
    square: float = 0.04  # [m] side of a square, as measured on the print
    marker: float = 0.03  # [m] side of a marker
    dictionary: str = "5X5_100"  # of OpenCV's markers

    def made(self) -> Any:
        """Returns it as OpenCV knows it. Raises InputError: there is no such board."""
        import cv2

        known = [name[5:] for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if self.dictionary not in known:
            raise InputError(
                f"unknown dictionary {self.dictionary!r}; valid: {', '.join(sorted(known))}"
            )
        if not (3 <= self.columns <= 40 and 3 <= self.rows <= 40):
            raise InputError(
                f"a board has 3 to 40 squares each way, not {self.columns}x{self.rows}"
            )
        if not 0 < self.marker < self.square < 1:
            raise InputError(
                f"a marker of {self.marker:g} m does not fit a square of {self.square:g} m; both "
                "are sides in metres, the marker's the smaller"
            )
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        try:
            size = (self.columns, self.rows)
            return cv2.aruco.CharucoBoard(size, self.square, self.marker, markers)
        except cv2.error as error:
            raise InputError(f"OpenCV cannot make this board: {error}") from error


@dataclass(frozen=True)
class Sight:
    """What one image shows of the board."""

    name: str  # of the image
    q: Array  # (7,) [rad] the arm's posture
    p_T: Array  # (N, 3) [m] the corners that are seen, on the board
    pixel: Array  # (N, 2) where they are in the image
    X_CT: Array  # (4, 4) the board's pose by this image alone


@dataclass(frozen=True)
class Calibration:
    """The mount, and how well the views agree on it."""

    X_HC: Array  # (4, 4) the camera at the hand's body
    X_L0T: Array  # (4, 4) where the board stood, in the arm's base frame
    error: dict[
        str, float
    ]  # image -> rms distance of its corners from where they should be [pixel]
    left_out: dict[str, tuple[float, float]]
    """image -> how far the mount moves [m] and turns [rad] if that image is left out."""

    @property
    def rms(self) -> float:
        """Of the images' errors [pixel]."""
        return float(np.sqrt(np.mean(np.square(list(self.error.values())))))

    @property
    def uncertainty(self) -> tuple[float, float]:
        """The jackknife's standard error of the mount: [m] and [rad]."""
        n = len(self.left_out)
        moved, turned = np.sqrt(np.square(list(self.left_out.values())).sum(axis=0) * (n - 1) / n)
        return float(moved), float(turned)


def see_board(
    name: str, rgb: np.ndarray, q: Array, board: Board, camera: Intrinsics
) -> Sight | None:
    """Returns what an image (H, W, 3) shows of the board; None where it is too little.

    Raises:
        InputError: the image's size is not that of the intrinsics.
    """
    import cv2

    if rgb.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{name} is {rgb.shape[1]}x{rgb.shape[0]} pixels, but the camera's intrinsics are for "
            f"{camera.width}x{camera.height}"
        )
    made = board.made()
    corners, ids, _, _ = cv2.aruco.CharucoDetector(made).detectBoard(
        cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    )
    if ids is None or len(ids) < MIN_CORNERS:
        return None
    p_T = np.asarray(made.getChessboardCorners(), float)[np.ravel(ids)]
    if np.linalg.matrix_rank(p_T[:, :2] - p_T[0, :2], tol=board.square / 2) < 2:
        return None  # all in one row
    pixel = np.asarray(corners, float).reshape(-1, 2)
    found, turn, place = cv2.solvePnP(p_T, pixel, _matrix(camera), None)
    return (
        Sight(name, np.asarray(q, float), p_T, pixel, _pose(np.ravel(turn), np.ravel(place)))
        if found
        else None
    )


def calibrate(sights: Sequence[Sight], camera: Intrinsics) -> Calibration:
    """Returns the mount that the views agree on.

    Raises:
        InputError: they are too few or too much alike to tell, or contradict one another.
    """
    check_sights(sights)
    X_L0H = np.stack([forward_kinematics(sight.q) for sight in sights])
    X_HC = hand_eye(X_L0H, np.stack([sight.X_CT for sight in sights]))
    X_L0T = X_L0H[0] @ X_HC @ sights[0].X_CT
    X_HC, X_L0T, left_out = _adjust(X_HC, X_L0T, sights, camera)
    errors = [_error(X_HC, X_L0T, X, s, camera) for X, s in zip(X_L0H, sights, strict=True)]
    names = [sight.name for sight in sights]
    rms = [float(np.sqrt((e**2).sum(-1).mean())) for e in errors]
    error = dict(zip(names, rms, strict=True))
    _check_agreement(error)
    return Calibration(X_HC, X_L0T, error, dict(zip(names, left_out, strict=True)))


def hand_eye(X_L0H: Array, X_CT: Array) -> Array:
    """Returns X_HC (4, 4) in closed form, from n postures (n, 4, 4) and boards seen (n, 4, 4).

    A turn of the hand between two views is the turn of the camera, seen from elsewhere: their axes
    give the rotation, after which the translation is linear.
    """
    A, B = _motions(X_L0H, X_CT)
    alpha, beta = (Rotation.from_matrix(X[:, :3, :3]).as_rotvec() for X in (A, B))
    X_HC = np.eye(4)
    X_HC[:3, :3] = Rotation.align_vectors(alpha, beta)[0].as_matrix()
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ X_HC[:3, :3].T - A[:, :3, 3]).ravel()
    X_HC[:3, 3] = np.linalg.lstsq(left, right, rcond=None)[0]
    return X_HC


def check_sights(sights: Sequence[Sight]) -> None:
    """Raises InputError where the views cannot tell the mount, saying what to do."""
    if len(sights) < MIN_VIEWS:
        raise InputError(
            f"{len(sights)} views show the board; at least {MIN_VIEWS} are needed, 12 to 15 are "
            "better: take more, with all of the board in the image"
        )
    X_L0H = np.stack([forward_kinematics(sight.q) for sight in sights])
    turns = Rotation.from_matrix(_motions(X_L0H, X_L0H)[0][:, :3, :3]).as_rotvec()
    # How much the views turn about each of three axes: rms [rad], the most first.
    _, second, first = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns)))
    if first < MIN_TURN:
        raise InputError(
            f"the views are turned against one another by {np.degrees(first):.0f} deg (rms); at "
            f"least {np.degrees(MIN_TURN):.0f} is needed: look at the board from all sides, the "
            "camera tilted 30 to 45 deg"
        )
    if second < MIN_SECOND_TURN:
        raise InputError(
            "the views are turned about one axis alone, along which the mount cannot be told "
            f"({np.degrees(second):.1f} deg about others, at least "
            f"{np.degrees(MIN_SECOND_TURN):.0f} is needed): tilt the camera to the front and to "
            "the side, and turn it about its own axis"
        )


def apart(X: Array, Y: Array) -> tuple[float, float]:
    """Returns how far two poses are apart: [m] and [rad]."""
    turn = Rotation.from_matrix(X[:3, :3].T @ Y[:3, :3]).magnitude()
    return float(np.linalg.norm(X[:3, 3] - Y[:3, 3])), float(turn)


def _motions(X_L0H: Array, X_CT: Array) -> tuple[Array, Array]:
    """Between every two views: of the hand, A, and of the camera, B, with A · X_HC = X_HC · B."""
    i, j = np.triu_indices(len(X_L0H), 1)
    return np.linalg.inv(X_L0H[j]) @ X_L0H[i], X_CT[j] @ np.linalg.inv(X_CT[i])


def _adjust(
    X_HC: Array, X_L0T: Array, sights: Sequence[Sight], camera: Intrinsics
) -> tuple[Array, Array, list[tuple[float, float]]]:
    """The mount and the board's place under which what the views show is most likely.

    And for each view how far the mount would be from there without it, [m] and [rad].
    """
    X_L0H = [forward_kinematics(sight.q) for sight in sights]
    whiten = [_whitening(X_HC, X_L0T, sight, camera) for sight in sights]

    def mount(x: Array) -> Array:
        return X_HC @ _pose(x[:3], x[3:6])

    def residuals(x: Array) -> Array:
        X, X_T = mount(x), X_L0T @ _pose(x[6:9], x[9:])
        views = zip(whiten, X_L0H, sights, strict=True)
        return np.concatenate([w @ _error(X, X_T, at, s, camera).ravel() for w, at, s in views])

    best = least_squares(residuals, np.zeros(12), x_scale="jac", method="lm")
    view = np.repeat(np.arange(len(sights)), [2 * len(sight.pixel) for sight in sights])
    left_out = []
    for i in range(len(sights)):  # so near the best, the residuals are linear
        rest = view != i
        step = np.linalg.lstsq(best.jac[rest], -best.fun[rest], rcond=None)[0]
        left_out.append(apart(mount(best.x + step), mount(best.x)))
    return mount(best.x), X_L0T @ _pose(best.x[6:9], best.x[9:]), left_out


def _whitening(X_HC: Array, X_L0T: Array, sight: Sight, camera: Intrinsics) -> Array:
    """The matrix (2N, 2N) that makes a view's errors independent, each of variance 1."""
    step = 1e-4  # [rad]
    ahead, behind = (
        np.stack([_error(X_HC, X_L0T, X_L0H, sight, camera).ravel() for X_L0H in moved])
        for moved in forward_kinematics(sight.q + step * np.stack([np.eye(7), -np.eye(7)]))
    )
    by_joint = (ahead - behind).T * _SIGMA_JOINT / (2 * step)  # (2N, 7)
    covariance = by_joint @ by_joint.T + _SIGMA_CORNER**2 * np.eye(len(by_joint))
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _error(X_HC: Array, X_L0T: Array, X_L0H: Array, sight: Sight, camera: Intrinsics) -> Array:
    """From the corners that a view shows to where they should be: (N, 2) [pixel]."""
    X_CT = np.linalg.inv(X_L0H @ X_HC) @ X_L0T
    x, y, z = (sight.p_T @ X_CT[:3, :3].T + X_CT[:3, 3]).T
    z = np.maximum(z, 1e-3)  # a step of the search may put a corner behind the camera
    pixel = np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return np.asarray(pixel - sight.pixel)


def _check_agreement(error: dict[str, float]) -> None:
    rms = float(np.sqrt(np.mean(np.square(list(error.values())))))
    if rms <= MAX_ERROR:
        return
    worst = max(error, key=lambda name: error[name])
    raise InputError(
        f"the views contradict one another by {rms:.1f} pixels (rms; at most {MAX_ERROR:g}), most "
        f"{worst} ({error[worst]:.1f}): did the board or the camera move, is a square as large as "
        "was said, do postures and images belong together? Correct that, or leave out that view"
    )


def _matrix(camera: Intrinsics) -> Array:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def _pose(turn: Array, place: Array) -> Array:
    """The pose (4, 4) of a rotation vector and a place, each of three numbers."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    X[:3, 3] = place
    return X
