"""Grasps by geometry alone: two fingers on opposite sides of what the camera saw.

At points spread over the cloud (*anchors*) the hand is tried in many orientations. For each, the
slab of points that the fingers would sweep is reduced to a *profile*: how far along the approach
the first surface lies, for every 4 mm of the closing direction. On the profile one walks from the
anchor outwards until there is room for a finger; that gives the width, and re-centres the hand.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud
from scipy.spatial import cKDTree

from tog_drake.hand_clearance import hand_boxes, lowest_corner, points_inside
from tog_drake.panda import (
    FINGER_THICKNESS,
    FINGERTIP_Z,
    MAX_OPENING,
    PAD_WIDTH,
    PALM_Z,
)
from tog_drake.points import Rows, clusters, group_means, neighbors, voxel_numbers
from tog_drake.values import Array, Grasps, Workspace

Mask = NDArray[np.bool_]


@dataclass
class Antipodal:
    """How densely to search and what counts as a good grasp."""

    voxel: float = 0.004  # [m] resolution at which the cloud is searched
    anchor_spacing: float = 0.012  # [m] between anchors
    max_anchors: int = 160  # spread over the cloud when there would be more, as in clutter
    yaws: int = 8  # closing directions over half a turn, the first across the local shape
    tilts_deg: list[float] = field(default_factory=lambda: [20.0, 40.0, 60.0])  # besides vertical
    depths: list[float] = field(default_factory=lambda: [0.012, 0.022, 0.032, 0.042])
    """[m] of the fingertips below the anchor, along the approach; the table may allow less."""
    min_depth: float = 0.005  # [m] of the fingertips below the top of what is gripped
    bin: float = 0.004  # [m] of the profile along the closing direction
    max_gap: float = 0.012  # [m] an empty stretch up to this does not end an object
    max_width: float = 0.072  # [m] between the contacts; the hand opens to 0.08
    opening_margin: float = 0.040  # [m] the hand arrives open this much wider, if it can
    table_clearance: float = 0.0035  # [m] between the hand and the table
    clearance: float = 0.002  # [m] between the open hand and every point
    per_anchor: int = 16  # best grasps of each anchor that are checked exactly
    max_grasps: int = 300  # returned


class AntipodalProposer:
    """Proposes antipodal grasps on a single-view cloud (a ``Proposer``).

    The hand is symmetric under a half turn about its approach; only one of each such pair of
    grasps is returned. What the camera did not see is neither trusted nor avoided.

    Args:
        seed: shifts the grid of anchors. The order of the cloud's points does not matter.
    """

    def __init__(self, config: Antipodal, workspace: Workspace, seed: int):
        self._config = config
        self._table = workspace.table_height
        self._seed = seed

    def propose(self, cloud: PointCloud) -> Grasps:
        """Returns at most ``max_grasps`` grasps, best first, possibly none."""
        if cloud.size() == 0:
            return Grasps.empty()
        config = self._config
        surface = _surface(cloud, config.voxel)
        anchor = _anchors(surface, config, np.random.default_rng(self._seed))
        tries = _tries(surface, anchor, config)
        sweep = _sweep(surface, tries, max(config.depths) + config.clearance)
        grips = _walk(surface, tries, sweep, config, self._table)
        found = _measure(surface, tries, sweep, grips, config)
        return _best_free(found, surface, config, self._table)


@dataclass(frozen=True)
class _Sweep:
    """E pairs of a try and a point in its slab: |x| < half a pad, in G's axes at the anchor."""

    attempt: Rows  # (E,) ascending
    row: Rows  # (E,) of the surface
    x: Array  # (E,) [m]
    y: Array  # (E,) [m]
    z: Array  # (E,) [m]


REACH = 0.10  # [m] half the span of the profile: half a palm
HAND_REACH = 0.20  # [m] from an anchor, within which the hand could touch something
UNSEEN = 0.75  # cosine that a side gets which was not seen, when its outline is right
SLAB = PAD_WIDTH / 2 + 0.001  # [m] half the width of the slab: what a finger may touch


def _sweep(surface: Surface, tries: Tries, deepest: float) -> _Sweep:
    """All points that the hands of ``tries`` could touch when their tips go ``deepest`` [m]."""
    sweeps = []
    for start in range(0, len(tries.anchor), tries.per_anchor):
        R_GW = tries.R_WG[start : start + tries.per_anchor].transpose(2, 0, 1)  # rows by axis
        origin = surface.point[tries.anchor[start]]
        row = np.array(surface.tree.query_ball_point(origin, 1.1 * REACH, return_sorted=True))
        p = (surface.point[row] - origin).T.astype(np.float32)  # single precision: twice as fast
        x, y, z = (R_GW.reshape(-1, 3).astype(np.float32) @ p).reshape(3, -1)  # (tries · points,)
        e = np.flatnonzero((np.abs(x) < SLAB) & (z < deepest))
        attempt, point = np.divmod(e, len(row))
        sweeps.append((attempt + start, row[point], x[e], y[e], z[e]))
    attempt, row, x, y, z = (np.concatenate(column) for column in zip(*sweeps, strict=True))
    return _Sweep(attempt, row, x, y, z)


@dataclass(frozen=True)
class _Grips:
    """K combinations of a try and a depth at which the fingers have room."""

    attempt: Rows  # (K,)
    tip: Array  # (K,) [m] of the fingertips beyond the anchor, along z
    low: Array  # (K,) [m] end of the gripped stretch along y, to within a bin
    high: Array  # (K,) [m] the other end


def _walk(
    surface: Surface, tries: Tries, sweep: _Sweep, config: Antipodal, table: float
) -> _Grips:
    """Walks over the profiles from the anchors outwards, at each depth."""
    profile = _profiles(len(tries.anchor), sweep, config.bin)
    lowest = _lowest_tip(surface, tries, table + config.table_clearance)
    found = []
    tip_before = np.full(len(lowest), -np.inf)
    for depth in config.depths:
        tip = np.minimum(depth, lowest)
        attempt = np.flatnonzero((tip > 0.001) & (tip > tip_before + 0.002))
        tip_before = tip
        low, high, fits = _walk_outwards(profile[attempt], tip[attempt], config)
        found.append(
            _Grips(attempt[fits], tip[attempt][fits], low[fits], high[fits]),
        )
    return _Grips(
        *(np.concatenate([getattr(g, name) for g in found]) for name in _Grips.__annotations__)
    )


def _profiles(count: int, sweep: _Sweep, bin_size: float) -> Array:
    """For each try, z [m] of the first surface along the approach in each bin of y; inf if none.

    The middle bin is centred on the anchor. Returns (H, B).
    """
    half = int(REACH / bin_size)
    column = np.rint(sweep.y / bin_size).astype(np.int64) + half
    inside = (column >= 0) & (column <= 2 * half)
    profile = np.full(count * (2 * half + 1), np.inf, dtype=sweep.z.dtype)  # else `at` is slow
    cell = sweep.attempt[inside] * (2 * half + 1) + column[inside]
    np.minimum.at(profile, cell, sweep.z[inside])
    return profile.reshape(count, -1)


def _lowest_tip(surface: Surface, tries: Tries, floor: float) -> Array:
    """How far beyond the anchor along z (H,) [m] the tips of the open hand stay above ``floor``."""
    x_z, y_z, z_z = np.moveaxis(tries.R_WG[:, 2, :], -1, 0)
    side = np.abs(x_z) * 0.011 + np.abs(y_z) * (MAX_OPENING / 2 + FINGER_THICKNESS)
    return np.asarray((surface.point[tries.anchor, 2] - side - floor) / -z_z)


def _walk_outwards(profile: Array, tip: Array, config: Antipodal) -> tuple[Array, Array, Mask]:
    """Where what is around the anchor ends on both sides, and whether the fingers have room there.

    Args:
        profile: (H, B) [m].
        tip: (H,) [m] of the fingertips; what lies deeper is not in the way.

    Returns:
        Low and high end along y (H,) [m]; whether a grasp is possible (H,).
    """
    middle = profile.shape[1] // 2
    occupied = profile < tip[:, None]
    blocked = profile < tip[:, None] + config.clearance
    right, room_right = _end(occupied[:, middle:], blocked[:, middle:], config)
    left, room_left = _end(occupied[:, middle::-1], blocked[:, middle::-1], config)
    width = (left + right + 1) * config.bin  # up to a bin too much
    column = np.arange(profile.shape[1]) - middle
    gripped = (column >= -left[:, None]) & (column <= right[:, None])
    top = np.min(np.where(gripped, profile, np.inf), axis=1)
    needed = (np.minimum(width + config.opening_margin, MAX_OPENING) - width) / 2 + FINGER_THICKNESS
    fits = (width <= config.max_width + config.bin) & occupied[:, middle]
    fits &= np.minimum(room_left, room_right) + config.bin >= needed
    fits &= tip - top >= config.min_depth
    fits &= profile.min(axis=1) > tip - (FINGERTIP_Z - PALM_Z) + config.clearance
    return -(left + 0.5) * config.bin, (right + 0.5) * config.bin, fits


def _end(occupied: Mask, blocked: Mask, config: Antipodal) -> tuple[Rows, Array]:
    """Where the stretch that starts in column 0 ends, (H,), and the room beyond it, (H,) [m]."""
    gap = round(config.max_gap / config.bin) + 1
    columns = occupied.shape[1]
    count = np.cumsum(np.pad(occupied, ((0, 0), (1, gap))), axis=1, dtype=np.int32)
    last = occupied & (count[:, gap + 1 :][:, :columns] == count[:, 1 : columns + 1])
    end = np.argmax(last, axis=1)
    beyond = blocked & (np.arange(columns) > end[:, None])
    next_blocked = np.where(beyond.any(axis=1), np.argmax(beyond, axis=1), columns + 100)
    return end, (next_blocked - end - 1) * config.bin


@dataclass(frozen=True)
class _Found(Grasps):
    anchor: Rows = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) rows of the surface."""


def _measure(
    surface: Surface, tries: Tries, sweep: _Sweep, grips: _Grips, config: Antipodal
) -> _Found:
    """Exact width, centre, contact and score of each grip; those across two things are dropped."""
    count = len(grips.attempt)
    grip, e = _points_between(sweep, grips)
    x, y, row = sweep.x[e], sweep.y[e], sweep.row[e]
    start = np.searchsorted(grip, np.arange(count))  # every grip holds at least its anchor
    high, low = np.maximum.reduceat(y, start), np.minimum.reduceat(y, start)
    top = np.minimum.reduceat(sweep.z[e], start)

    anchor, R_WG = tries.anchor[grips.attempt], tries.R_WG[grips.attempt]
    towards_y = np.einsum("ei,ei->e", surface.normal[row], R_WG[grip, :, 1])
    facing_high, covered = _facing(x, y, towards_y, grip, high)
    facing_low, _ = _facing(x, -y, -towards_y, grip, -low)
    contact = np.empty(count, dtype=np.int64)
    at_contact = y == np.where(facing_high >= facing_low, high, low)[grip]
    contact[grip[at_contact]] = row[at_contact]

    X_WG = np.tile(np.eye(4), (count, 1, 1))
    X_WG[:, :3, :3] = R_WG
    offset = np.stack([np.zeros(count), (high + low) / 2, grips.tip - FINGERTIP_Z], axis=-1)
    X_WG[:, :3, 3] = surface.point[anchor] + np.einsum("nij,nj->ni", R_WG, offset)
    width = high - low
    centroid = surface.centroid[surface.thing[anchor]]
    lever = np.linalg.norm((X_WG[:, :3, 3] - centroid)[:, :2], axis=1)
    score = _score(facing_high, facing_low, grips.tip - top, -R_WG[:, 2, 2], covered, lever, width)
    foreign = surface.thing[row] != surface.thing[anchor][grip]
    single = (np.bincount(grip[foreign], minlength=count) == 0) & (width <= config.max_width)
    found = _Found(X_WG, width, score, surface.point[contact], anchor)
    return found.take(np.flatnonzero(single))


def _score(facing_high, facing_low, depth, vertical, covered, lever, width):
    facing = (facing_high + facing_low) / 2
    return (
        0.40 * facing
        + 0.20 * np.minimum(depth / 0.025, 1)
        + 0.12 * (1 - np.arccos(np.clip(vertical, -1, 1)) / (np.pi / 2))
        + 0.10 * covered
        + 0.12 * np.exp(-((lever / 0.08) ** 2))
        + 0.06 * np.clip((0.072 - width) / 0.02, 0, 1)
    )


def _points_between(sweep: _Sweep, grips: _Grips) -> tuple[Rows, Rows]:
    """The pairs of a grip and a row of the sweep that lies between its fingers, by grip."""
    first = np.searchsorted(sweep.attempt, grips.attempt, side="left")
    length = np.searchsorted(sweep.attempt, grips.attempt, side="right") - first
    grip = np.repeat(np.arange(len(first)), length)
    e = np.arange(len(grip)) - np.repeat(np.cumsum(length) - length, length) + first[grip]
    y = sweep.y[e]
    between = (y >= grips.low[grip]) & (y <= grips.high[grip]) & (sweep.z[e] < grips.tip[grip])
    return grip[between], e[between]


def _facing(x: Array, y: Array, towards: Array, grip: Rows, end: Array) -> tuple[Array, Array]:
    """How well the surface at the finger on the side of larger y faces it.

    Where that surface was seen, its normals say so. Where it was not, only the outline is known:
    it ought to run along the pad.

    Args:
        x, y: (E,) [m] the points between the fingers.
        towards: (E,) cosine between their normals and the direction to the finger.
        grip: (E,) 0 .. K−1, which grip each belongs to.
        end: (K,) [m] the largest y of each grip.

    Returns:
        (K,) cosine; (K,) the share of the pad's width along which there is something to hold.
    """
    count = len(end)
    at_end = y > end[grip] - 0.005
    seen = at_end & (towards > 0.3)
    number = np.bincount(grip[seen], minlength=count)
    by_normals = np.bincount(grip[seen], towards[seen], minlength=count) / np.maximum(number, 1)
    enough = number >= 0.25 * np.bincount(grip[at_end], minlength=count)

    bins = 5  # along the pad
    column = np.clip((x / SLAB + 1) / 2 * bins, 0, bins - 1).astype(np.int64)
    outline = np.full(count * bins, -np.inf, dtype=y.dtype)
    np.maximum.at(outline, grip * bins + column, y)
    outline = outline.reshape(count, bins)
    held = np.isfinite(outline)
    weight = held / held.sum(axis=1, keepdims=True)
    place = np.arange(bins) * (2 * SLAB / bins)
    place = place - (weight * place).sum(axis=1, keepdims=True)
    level = np.where(held, outline, 0)
    level -= (weight * level).sum(axis=1, keepdims=True)
    spread = (weight * place**2).sum(axis=1)
    slope = (weight * place * level).sum(axis=1) / np.maximum(spread, 1e-9)
    by_outline = UNSEEN / np.sqrt(1 + slope**2)
    return np.where(enough, by_normals, by_outline), held.mean(axis=1)


def _best_free(found: _Found, surface: Surface, config: Antipodal, table: float) -> Grasps:
    """Of the best grasps of each anchor those at which the open hand is free, best first."""
    found = found.take(np.lexsort((-found.score, found.anchor)))
    found = found.take(np.flatnonzero(_rank(found.anchor) < config.per_anchor))
    groups = np.split(np.arange(len(found)), np.flatnonzero(np.diff(found.anchor)) + 1)
    free = np.concatenate([_is_free(found.take(g), surface, config, table) for g in groups])
    found = found.take(np.flatnonzero(free))
    # Every anchor's best grasp comes before any anchor's second, so that no part is left out.
    chosen = np.lexsort((-found.score, _rank(found.anchor)))[: config.max_grasps]
    best = chosen[np.argsort(-found.score[chosen], kind="stable")]
    return Grasps(*(getattr(found, name)[best] for name in Grasps.__annotations__))


def _rank(group: Rows) -> Rows:
    """The place of each row within its group, from 0; ``group`` is ascending."""
    return np.arange(len(group)) - np.searchsorted(group, group)


def _is_free(found: _Found, surface: Surface, config: Antipodal, table: float) -> Mask:
    """Whether the open hand touches neither the table nor a point, for grasps at one anchor."""
    opening = np.minimum(found.width + config.opening_margin, MAX_OPENING)
    lower, upper = hand_boxes(opening)
    above = lowest_corner(found.X_WG, lower, upper) > table + config.table_clearance - 1e-6
    near = surface.tree.query_ball_point(surface.point[found.anchor[0]], HAND_REACH)
    lower, upper = lower - config.clearance, upper + config.clearance
    return above & (points_inside(found.X_WG, lower, upper, surface.point[near]) == 0)
