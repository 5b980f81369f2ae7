"""Grasps as other tools give them: in arrays, with the frame they are in and whose poses they are.

A *document* is a JSON object, or an NPZ file with arrays of these names:

========  =========  ==========================================================================
poses     (N, 4, 4)  rigid transforms [m], at most ``MAX_GRASPS``
scores    (N,)       confidences in [0, 1], in any order
widths    (N,)       [m] between the two contacts; may be left out
contacts  (N, 3)     [m] where a pad meets the surface that was seen; may be left out
frame     text       "camera" (x right, y down, z forward, as OpenCV has it) or "world" (z up)
gripper   text       what the poses are of:
                     "G", of this project (see ``panda``): between the pads, closes along y;
                     "franka_hand": the Panda's hand body, 0.1034 m behind it, closes along y;
                     "contact_graspnet": the hand base 0.1034 m behind it, closes along x
========  =========  ==========================================================================

z is the approach in all three. A contact that is left out becomes the point of the cloud, among
those that a pad touches first along the closing axis, that is nearest to this axis; a width that
is left out, how far those points reach. A grasp with nothing that was seen between its fingers is
dropped then; one that has both is believed. Where more than ``MOST_EMPTY`` of all grasps hold
nothing that was seen, the frame or the gripper is wrong, and none is taken.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.grasp_check import holds_nothing
from tog_drake.panda import FINGERTIP_Z, MAX_OPENING, PALM_Z, X_HG
from tog_drake.points import Rows
from tog_drake.proposers.profile import SLAB
from tog_drake.values import Array, Grasps

MAX_GRASPS = 2000
# Of grasps with another frame or gripper than declared 0.89 or more hold nothing, of right ones 0;
# only what closes along the wrong axis (contact_graspnet as franka_hand) is not found so.
MOST_EMPTY = 0.8
FARTHEST = 100.0  # [m] from the frame's origin; what is farther was not given in metres
ORTHONORMAL = 1e-3  # how far R Rᵀ may be from the identity
_EXACT = 1e-6  # a rotation that is farther off, more than by float32, becomes the nearest true one
_ROUNDING = 1e-5  # by which a score or a width may be beyond its range
AT_PAD = 0.002  # [m] a pad is pressed against what is this close to the end
BESIDE = 0.005  # [m] points this far beyond a given width are still looked at
# The space between the fingers of the open hand: middle in G, half its depth, radius about it [m].
_MIDDLE = np.array([0.0, 0.0, (PALM_Z + FINGERTIP_Z) / 2])
_DEPTH = (FINGERTIP_Z - PALM_Z) / 2
_REACH = float(np.linalg.norm([SLAB, MAX_OPENING / 2, _DEPTH]))

_X_NG = X_HG.copy()  # the network's hand closes along x: its x is y of G, so its −y is x of G
_X_NG[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
# The pose of G in the frame that a tool's poses are of.
GRIPPERS: dict[str, Array] = {"G": np.eye(4), "franka_hand": X_HG, "contact_graspnet": _X_NG}
FRAMES = ("camera", "world")

_SHAPES = {"poses": (4, 4), "scores": (), "widths": (), "contacts": (3,)}  # of one grasp's entry
_CHOICES = {"frame": FRAMES, "gripper": tuple(GRIPPERS)}
NAMES = (*_SHAPES, *_CHOICES)


class BadDocument(ValueError):
    """What was given is no document; the message says what is wrong and what would be right."""


class HoldNothing(ValueError):
    """Most grasps hold nothing that was seen; the message says how many, in what frame."""


@dataclass(frozen=True)
class Document:
    """N grasps as a tool gave them, checked."""

    poses: Array  # (N, 4, 4) of the tool's gripper in its frame
    scores: Array  # (N,)
    widths: Array | None  # (N,) [m]
    contacts: Array | None  # (N, 3) [m] in its frame
    frame: str  # one of FRAMES
    gripper: str  # one of GRIPPERS


def read_document(
    content: Mapping[str, Any], *, frame: str | None = None, gripper: str | None = None
) -> Document:
    """Returns the grasps of a document that was parsed, but not yet believed.

    Args:
        content: by name; numbers in nested lists or in arrays.
        frame, gripper: where they are known otherwise.

    Raises:
        BadDocument: saying what was given and what would be valid.
    """
    unknown = [str(name)[:40] for name in content if name not in NAMES]
    if unknown:
        valid = ", ".join(NAMES)
        raise BadDocument(f"it has no use for {unknown[0]!r}, leave it out; valid: {valid}")
    frame, gripper = _said(content, "frame", frame), _said(content, "gripper", gripper)
    count: int | None = None
    arrays: dict[str, Array | None] = {}
    for name, shape in _SHAPES.items():
        if content.get(name) is None:
            if name in ("poses", "scores"):
                raise BadDocument(f"it has no {name}; valid: {name} of shape {_shown(shape)}")
            arrays[name] = None
            continue
        arrays[name] = array = _numbers(content[name], name, shape, count)
        count = len(array)
    poses, scores, widths, contacts = arrays.values()
    assert poses is not None and scores is not None
    checked = checked_grasps(poses, scores, widths, contacts)
    return Document(*checked, frame=frame, gripper=gripper)


def _said(content: Mapping[str, Any], name: str, declared: str | None) -> str:
    """The frame or the gripper: what the document says, or who uses it; never both differently."""
    valid = ", ".join(_CHOICES[name])
    own = content.get(name)
    for given in (own, declared):
        if given is not None and str(given) not in _CHOICES[name]:
            raise BadDocument(f"unknown {name} {str(given)[:40]!r}; valid: {valid}")
    if own is not None and declared is not None and str(own) != declared:
        raise BadDocument(f"its {name} is {str(own)!r}, not {declared!r} as declared; valid: one")
    if own is None and declared is None:
        raise BadDocument(
            f"it does not say its {name}; valid: {name} in it, or in the scenario, one of {valid}"
        )
    return str(declared if own is None else own)


def _numbers(value: Any, name: str, shape: tuple[int, ...], count: int | None) -> Array:
    """The array (N, ...) of finite numbers that is meant: lists in lists, or an array."""
    valid = f"valid: {name} of shape {_shown(shape)}, finite numbers"
    if not isinstance(value, list) and not (isinstance(value, np.ndarray) and value.ndim):
        raise BadDocument(f"{name} is a {type(value).__name__}; {valid}")
    if len(value) > MAX_GRASPS:
        raise BadDocument(f"{name} holds {len(value)} grasps; valid: at most {MAX_GRASPS}")
    if count is not None and len(value) != count:
        raise BadDocument(f"{name} is for {len(value)} grasps, poses for {count}; valid: as many")
    for i, entry in enumerate(value):
        if not _is_numeric(entry, shape):
            raise BadDocument(f"{name}[{i}] is {_brief(entry)}; {valid}")
    try:
        array = np.array(value, np.float64).reshape(-1, *shape)
    except OverflowError as error:
        raise BadDocument(f"{name} holds a number that is too large; {valid}") from error
    bad = ~np.isfinite(array.reshape(len(array), math.prod(shape))).all(axis=1)
    if bad.any():
        raise BadDocument(f"{name}[{bad.argmax()}] is not finite; {valid}")
    return array


def _is_numeric(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether the value is numbers of that shape: texts, truth values and the like are none."""
    if isinstance(value, np.ndarray | np.generic):
        return value.shape == shape and value.dtype.kind in "fiu"
    if not shape:
        return type(value) in (int, float)
    return (
        isinstance(value, list)
        and len(value) == shape[0]
        and all(_is_numeric(item, shape[1:]) for item in value)
    )


def _brief(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} of {str(value.dtype)[:20]}"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return f"{value!r:.40}" if isinstance(value, str | int | float) else f"a {type(value).__name__}"


def _shown(shape: tuple[int, ...]) -> str:
    return "(N, " + ", ".join(map(str, shape)) + ")" if shape else "(N,)"


def checked_grasps(
    poses: Array, scores: Array, widths: Array | None, contacts: Array | None
) -> tuple[Array, Array, Array | None, Array | None]:
    """Returns the same, with true rotations, scores in [0, 1] and widths in [0, ``MAX_OPENING``].

    Args:
        poses: (N, 4, 4) finite; of them what rounding has done is put right.
        scores, widths, contacts: (N,), (N,) [m] and (N, 3) [m], finite.

    Raises:
        BadDocument: a pose is no rigid transform, or a number is out of bounds.
    """
    R = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2), initial=0.0)
        det = np.linalg.det(R)
        rigid = (off <= ORTHONORMAL) & (det > 0)  # not so where either is NaN
        rigid &= np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0) <= _ROUNDING
    if not rigid.all():
        i = int(rigid.argmin())
        raise BadDocument(
            f"poses[{i}] is no rigid transform (R·Rᵀ is {off[i]:.2g} off the identity, det R is "
            f"{det[i]:.2g}, the last row {poses[i, 3].tolist()}); valid: R "
            f"orthonormal to {ORTHONORMAL} with determinant 1, last row 0 0 0 1"
        )
    for name, places in (("poses", poses[:, :3, 3]), ("contacts", contacts)):
        if places is not None and np.abs(places).max(initial=0.0) > FARTHEST:
            raise BadDocument(
                f"{name} reach {np.abs(places).max():.3g} from the origin; valid: metres, at most "
                f"{FARTHEST:g}"
            )
    scores = _within(scores, "scores", 1.0)
    widths = None if widths is None else _within(widths, "widths", MAX_OPENING)
    return _true_rotations(poses, off), scores, widths, contacts


def _within(array: Array, name: str, upper: float) -> Array:
    bad = (array < -_ROUNDING) | (array > upper + _ROUNDING)
    if bad.any():
        i = int(bad.argmax())
        raise BadDocument(f"{name}[{i}] is {array[i]:g}; valid: from 0 to {upper:g}")
    return np.clip(array, 0.0, upper)


def _true_rotations(poses: Array, off: Array) -> Array:
    """The poses, where ``off`` says so with the nearest rotation (orthogonal Procrustes)."""
    row = np.flatnonzero(off > _EXACT)
    poses = poses.copy()
    u, _, vt = np.linalg.svd(poses[row, :3, :3])
    poses[row, :3, :3] = u @ vt
    poses[:, 3] = [0, 0, 0, 1]
    return poses


def grasps_in_world(document: Document, cloud: PointCloud, X_WC: Array) -> Grasps:
    """Returns the grasps of the document, best first.

    Args:
        document: what the tool gave.
        cloud: what was seen, in W.
        X_WC: the camera's pose, (4, 4).

    Raises:
        HoldNothing: more than ``MOST_EMPTY`` of the grasps hold nothing.
    """
    X_WF = X_WC if document.frame == "camera" else np.eye(4)
    X_WG = X_WF @ document.poses @ GRIPPERS[document.gripper]
    width, contact, row = document.widths, document.contacts, np.arange(len(X_WG))
    open_hand = np.full(len(X_WG), MAX_OPENING)
    empty = int(holds_nothing(X_WG, open_hand if width is None else width, cloud).sum())
    if empty > MOST_EMPTY * len(X_WG):
        raise HoldNothing(
            f"{empty} of the {len(X_WG)} grasps have nothing of the {cloud.size()} points that "
            "were seen between their fingers: are they of this view, their frame "
            f"{document.frame!r} and their gripper {document.gripper!r}?"
        )
    if contact is not None:
        contact = contact @ X_WF[:3, :3].T + X_WF[:3, 3]
    if width is None or contact is None:
        row, measured, touched = between_fingers(X_WG, width, cloud)
        width = measured if width is None else width[row]
        contact = touched if contact is None else contact[row]
    grasps = Grasps(X_WG[row], width, document.scores[row], contact)
    return grasps.take(np.argsort(-grasps.score, kind="stable"))


def between_fingers(
    X_WG: Array, widths: Array | None, cloud: PointCloud
) -> tuple[Rows, Array, Array]:
    """Returns which of N grasps have something that was seen between their fingers, and where.

    Args:
        X_WG: (N, 4, 4).
        widths: (N,) [m], how far apart the fingers are there; None: as far as they go.
        cloud: what was seen, in W.

    Returns:
        (M,) rows of the grasps; (M,) [m] how far what is between reaches along y of G; (M, 3) in W,
        the point of it that a pad touches first, nearest to that axis.
    """
    p_W = cloud.xyzs().T.astype(np.float64)
    half = np.full(len(X_WG), MAX_OPENING / 2)
    if widths is not None:
        half = np.minimum(half, widths / 2 + BESIDE)
    rows, width, contact = [], [], []
    tree = cKDTree(p_W)
    for i, X in enumerate(X_WG):
        near = np.array(tree.query_ball_point(X[:3, :3] @ _MIDDLE + X[:3, 3], _REACH), np.int64)
        p_G = (p_W[near] - X[:3, 3]) @ X[:3, :3]
        between = np.all(np.abs(p_G - _MIDDLE) <= [SLAB, half[i], _DEPTH], axis=1)
        x, y, z = p_G.T
        if not between.any():
            continue
        low, high = y[between].min(), y[between].max()
        touched = between & ((y <= low + AT_PAD) | (y >= high - AT_PAD))
        rows.append(i)
        width.append(high - low)
        contact.append(p_W[near[touched][(x**2 + z**2)[touched].argmin()]])
    return np.array(rows, np.int64), np.array(width), np.array(contact).reshape(-1, 3)
