"""Grasps by geometry alone: two fingers on opposite sides of what the camera saw.

At *anchors* spread over the cloud the hand is tried in many orientations. For each, the slab of
points that the fingers would sweep is reduced to a profile, on which one walks from the anchor
outwards until there is room for the fingers. That gives width and centre; the points in between
give the score.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.perception import PointCloud

from tog_drake.errors import InputError
from tog_drake.hand_boxes import hand_boxes, lowest_corner, points_inside
from tog_drake.panda import (
    FINGER_THICKNESS,
    FINGERTIP_Z,
    MAX_OPENING,
    PALM_Z,
    arrival_opening,
)
from tog_drake.points import Rows
from tog_drake.proposers.grip_quality import MIN_FACING, confidence, facing_of, middle_rows
from tog_drake.proposers.hypotheses import (
    Surface,
    Tries,
    hand_tries,
    spread_anchors,
    thinned_surface,
)
from tog_drake.proposers.profile import REACH, SLAB, profiles, walk_outwards
from tog_drake.values import Array, Grasps, View, Workspace


@dataclass
class Antipodal:
    """How densely to search, and what a grasp must keep clear of."""

    voxel: float = 0.004  # [m] resolution at which the cloud is searched
    anchor_spacing: float = 0.010  # [m] between anchors, where they are not too many
    anchors: int = 80  # at most, on a single thing; spread over it
    max_anchors: int = 240  # at most, on many things
    yaws: int = 8  # closing directions over half a turn, the first across the local shape
    tilts_deg: list[float] = field(default_factory=lambda: [20.0, 40.0, 60.0])  # besides vertical
    depths: list[float] = field(default_factory=lambda: [0.012, 0.022, 0.032, 0.042])
    """[m] of the fingertips below the anchor, along the approach; the table may allow less."""
    min_depth: float = 0.005  # [m] of the fingertips below the top of what is gripped
    bin: float = 0.004  # [m] of the profiles along the closing direction
    max_gap: float = 0.012  # [m] an empty stretch up to this does not end an object
    max_width: float = 0.072  # [m] between the contacts; the hand opens to 0.08
    table_clearance: float = 0.0035  # [m] between the hand and the table
    clearance: float = 0.002  # [m] between the open hand and every point
    per_kind: int = 6  # best grasps of each kind at an anchor that are checked exactly
    max_grasps: int = 300  # returned; on many things twice as many as there are anchors, if more


POINTS_PER_ANCHOR = 15  # of the searched cloud; a single thing has about 1000 points
HAND_REACH = 0.20  # [m] from an anchor, within which the hand could touch something
AT_PAD = 0.002  # [m] a pad is pressed against what is this close to the end
NARROW = 0.6  # of the width of the best grasp at the same anchor: less holds something else there
SHALLOW = 0.005  # [m] less deep than that: may hold the top alone; and the spread of such


class AntipodalProposer:
    """Proposes antipodal grasps on a single-view cloud (a ``Proposer``).

    The hand is symmetric under a half turn about its approach: only one of each such pair of
    grasps is returned. What the camera did not see is neither trusted nor avoided here.

    Args:
        seed: shifts the grid of anchors. The order of the cloud's points does not matter.
    """

    def __init__(self, config: Antipodal, workspace: Workspace, seed: int):
        if min(config.voxel, config.anchor_spacing, config.bin) <= 0 or config.yaws < 1:
            raise InputError(
                "proposer: voxel, anchor_spacing, bin must be above 0 [m], yaws at least 1; given: "
                f"{config.voxel}, {config.anchor_spacing}, {config.bin} and {config.yaws}"
            )
        if not config.depths or not all(0 <= tilt < 90 for tilt in config.tilts_deg):
            raise InputError(
                "proposer: depths must hold at least one [m], tilts_deg must be from 0 to below "
                f"90; given: {config.depths} and {config.tilts_deg}"
            )
        self._config = config
        self._table = workspace.table_height
        self._seed = seed

    def propose(self, cloud: PointCloud, view: View) -> Grasps:
        """Returns grasps, best first, possibly none. The view is not used."""
        if cloud.size() == 0:
            return Grasps.empty()
        config = self._config
        surface = thinned_surface(cloud, config.voxel)
        count = int(
            np.clip(len(surface.point) // POINTS_PER_ANCHOR, config.anchors, config.max_anchors)
        )
        rng = np.random.default_rng(self._seed)
        anchor = spread_anchors(surface, config.anchor_spacing, count, rng)
        tries = hand_tries(surface, anchor, config.yaws, np.radians(config.tilts_deg))
        sweep = _sweep(surface, tries, max(config.depths) + config.clearance)
        grips = _grips(surface, tries, sweep, config, self._table)
        found = _measure(surface, tries, sweep, grips, config.max_width)
        return _best_free(
            found, surface, config, self._table, max(config.max_grasps, 2 * len(anchor))
        )


@dataclass(frozen=True)
class _Sweep:
    """E pairs of a try and a point in its slab |x| < SLAB, in G's axes about the anchor."""

    attempt: Rows  # (E,) ascending
    row: Rows  # (E,) of the surface
    x: Array  # (E,) [m]
    y: Array  # (E,) [m]
    z: Array  # (E,) [m]


@dataclass(frozen=True)
class _Grips:
    """K combinations of a try and a depth at which the fingers have room."""

    attempt: Rows  # (K,)
    tip: Array  # (K,) [m] of the fingertips beyond the anchor, along z
    low: Array  # (K,) [m] end of the gripped stretch along y, to within a bin
    high: Array  # (K,) [m] the other end


@dataclass(frozen=True)
class _Found(Grasps):
    """Grasps, before the hand is checked against its surroundings."""

    anchor: Rows = field(default_factory=lambda: np.zeros(0, np.int64))  # (N,) rows of the surface


def _sweep(surface: Surface, tries: Tries, deepest: float) -> _Sweep:
    """All points that the hands could touch with their tips ``deepest`` [m] beyond the anchor."""
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


def _grips(
    surface: Surface, tries: Tries, sweep: _Sweep, config: Antipodal, table: float
) -> _Grips:
    """At each depth, the tries whose fingers have room on both sides of something narrow."""
    profile = profiles(sweep.attempt, sweep.y, sweep.z, len(tries.anchor), config.bin)
    first_of_all = profile.min(axis=1)
    lowest = _lowest_tip(surface, tries, table + config.table_clearance)
    before = np.full(len(lowest), -np.inf)
    grips = []
    for depth in config.depths:
        tip = np.minimum(depth, lowest)
        attempt = np.flatnonzero((tip > 0.001) & (tip > before + 0.002))
        before, tip = tip, tip[attempt]
        stretch = walk_outwards(
            profile[attempt],
            tip,
            width=config.bin,
            max_gap=config.max_gap,
            clearance=config.clearance,
        )
        width = stretch.high - stretch.low  # up to a bin too much
        aside = (arrival_opening(width) - width) / 2  # from the thing to an open finger
        fits = stretch.found & (width <= config.max_width + config.bin)
        fits &= stretch.room + config.bin >= aside + FINGER_THICKNESS
        fits &= tip - stretch.top >= config.min_depth
        fits &= tip - first_of_all[attempt] < FINGERTIP_Z - PALM_Z - config.clearance
        grips.append((attempt[fits], tip[fits], stretch.low[fits], stretch.high[fits]))
    return _Grips(*(np.concatenate(column) for column in zip(*grips, strict=True)))


def _lowest_tip(surface: Surface, tries: Tries, floor: float) -> Array:
    """How far beyond the anchor along z (H,) [m] the tips of the open hand stay above ``floor``."""
    x_z, y_z, z_z = np.moveaxis(tries.R_WG[:, 2, :], -1, 0)
    side = np.abs(x_z) * SLAB + np.abs(y_z) * (MAX_OPENING / 2 + FINGER_THICKNESS)
    return np.asarray((surface.point[tries.anchor, 2] - side - floor) / -z_z)


def _measure(
    surface: Surface, tries: Tries, sweep: _Sweep, grips: _Grips, max_width: float
) -> _Found:
    """Width, centre, contact and score of each grip that holds one thing by surfaces that face."""
    count = len(grips.attempt)
    grip, e = _points_between(sweep, grips)
    x, y, row = sweep.x[e], sweep.y[e], sweep.row[e]
    start = np.searchsorted(grip, np.arange(count))  # every grip holds at least its anchor
    high, low = np.maximum.reduceat(y, start), np.minimum.reduceat(y, start)
    top = np.minimum.reduceat(sweep.z[e], start)

    anchor, R_WG = tries.anchor[grips.attempt], tries.R_WG[grips.attempt]
    towards_y = np.einsum("ei,ei->e", surface.normal[row], R_WG[grip, :, 1])
    facing_high, seen_high, covered = facing_of(x, y, towards_y, grip, high)
    facing_low, seen_low, _ = facing_of(x, -y, -towards_y, grip, -low)
    side = np.where(facing_high >= facing_low, 1, -1)[grip]
    depth_below = np.where(side > 0, high[grip] - y, y - low[grip])
    below = sweep.z[e] - (grips.tip - FINGERTIP_Z)[grip]
    contact = row[middle_rows(x, below, depth_below < AT_PAD, grip, count)]

    X_WG = np.tile(np.eye(4), (count, 1, 1))
    X_WG[:, :3, :3] = R_WG
    offset = np.stack([np.zeros(count), (high + low) / 2, grips.tip - FINGERTIP_Z], axis=-1)
    X_WG[:, :3, 3] = surface.point[anchor] + np.einsum("nij,nj->ni", R_WG, offset)
    balance = surface.balance[surface.thing[anchor]]
    score = confidence(
        facing=np.stack([facing_high, facing_low]),
        seen=np.stack([seen_high, seen_low]),
        depth=grips.tip - top,
        tilt=np.arccos(np.clip(-R_WG[:, 2, 2], -1, 1)),
        covered=covered,
        lever=np.linalg.norm(X_WG[:, :2, 3] - balance, axis=1),
        spare=max_width - (high - low),
    )
    foreign = surface.thing[row] != surface.thing[anchor][grip]
    good = (np.bincount(grip[foreign], minlength=count) == 0) & (high - low <= max_width)
    good &= np.minimum(facing_high, facing_low) >= MIN_FACING
    width = (high - low).astype(np.float64)
    found = _Found(X_WG, width, score, surface.point[contact], anchor)
    return found.take(np.flatnonzero(good))


def _points_between(sweep: _Sweep, grips: _Grips) -> tuple[Rows, Rows]:
    """The pairs of a grip and a row of the sweep that lies between its fingers, by grip."""
    first = np.searchsorted(sweep.attempt, grips.attempt, side="left")
    length = np.searchsorted(sweep.attempt, grips.attempt, side="right") - first
    grip = np.repeat(np.arange(len(first)), length)
    e = np.arange(len(grip)) - np.repeat(np.cumsum(length) - length, length) + first[grip]
    y = sweep.y[e]
    between = (y >= grips.low[grip]) & (y <= grips.high[grip]) & (sweep.z[e] < grips.tip[grip])
    return grip[between], e[between]


def _best_free(
    found: _Found, surface: Surface, config: Antipodal, table: float, count: int
) -> Grasps:
    """The ``count`` best grasps at which the open hand is free, best first.

    Every anchor's best comes first, then every anchor's best narrow one, its best shallow one, and
    so on, so that no part is left out.
    """
    found = found.take(np.lexsort((-found.score, found.anchor)))
    kind = _kinds(found)
    kept = np.flatnonzero(_rank(found.anchor, kind) < config.per_kind)
    found, kind = found.take(kept), kind[kept]
    if len(found) == 0:
        return Grasps.empty()
    groups = np.split(np.arange(len(found)), np.flatnonzero(np.diff(found.anchor)) + 1)
    free = np.concatenate([_is_free(found.take(g), surface, config, table) for g in groups])
    found, kind = found.take(np.flatnonzero(free)), kind[free]
    order = np.lexsort((-found.score, kind, _rank(found.anchor, kind)))[:count]
    best = order[np.argsort(-found.score[order], kind="stable")]
    return Grasps(*(getattr(found, name)[best] for name in Grasps.__annotations__))


def _kinds(found: _Found) -> Rows:
    """Tells what may hold a small part alone: the ear of a cup, the cap on a bottle.

    Args:
        found: by anchor, best first.

    Returns:
        (N,) 1 for grasps that are far narrower than the best at their anchor, 2 for the least
        deep of the others, else 0.
    """
    _, first, number = np.unique(found.anchor, return_index=True, return_inverse=True)
    best = found.take(first[number])
    retreat = np.einsum("ni,ni->n", best.X_WG[:, :3, 3] - found.X_WG[:, :3, 3], best.X_WG[:, :3, 2])
    least_deep = np.maximum.reduceat(retreat, first)[number] - SHALLOW
    return np.select(
        [found.width < NARROW * best.width, retreat > np.maximum(least_deep, SHALLOW)], [1, 2], 0
    )


def _rank(anchor: Rows, kind: Rows) -> Rows:
    """How many rows come before each with the same anchor and kind, (N,)."""
    group = 3 * anchor + kind
    order = np.argsort(group, kind="stable")
    rank = np.empty(len(group), dtype=np.int64)
    rank[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order])
    return rank


def _is_free(found: _Found, surface: Surface, config: Antipodal, table: float) -> NDArray[np.bool_]:
    """Whether the open hand touches neither the table nor a point, for grasps at one anchor."""
    lower, upper = hand_boxes(arrival_opening(found.width))
    free: NDArray[np.bool_] = lowest_corner(found.X_WG, lower, upper) > (
        table + config.table_clearance - 1e-6
    )
    near = surface.tree.query_ball_point(surface.point[found.anchor[0]], HAND_REACH)
    lower, upper = lower - config.clearance, upper + config.clearance
    free &= points_inside(found.X_WG, lower, upper, surface.point[near]) == 0
    return free
