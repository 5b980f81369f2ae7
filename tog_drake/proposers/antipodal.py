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
    PAD_WIDTH,
    PALM_Z,
    arrival_opening,
)
from tog_drake.points import Rows
from tog_drake.proposers.hypotheses import (
    Surface,
    Tries,
    hand_tries,
    spread_anchors,
    thinned_surface,
)
from tog_drake.proposers.profile import REACH, profiles, walk_outwards
from tog_drake.values import Array, Grasps, Workspace


@dataclass
class Antipodal:
    """How densely to search, and what a grasp must keep clear of."""

    voxel: float = 0.004  # [m] resolution at which the cloud is searched
    anchor_spacing: float = 0.010  # [m] between anchors, where they are not too many
    anchors: int = 80  # at most, on a single thing; spread over it
    max_anchors: int = 160  # at most, on many things
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
    per_group: int = 10  # best deep and best shallow grasps of each anchor: checked exactly
    max_grasps: int = 300  # returned


POINTS_PER_ANCHOR = 15  # of the searched cloud; a single thing has about 1000 points
SLAB = PAD_WIDTH / 2 + 0.001  # [m] half the width of what a finger may touch, along x
HAND_REACH = 0.20  # [m] from an anchor, within which the hand could touch something
EDGE = 0.005  # [m] a finger touches what is this close to the end of the stretch
AT_PAD = 0.002  # [m] a pad is pressed against what is this close to the end
MIN_FACING = 0.60  # cosine; a surface turned farther from its finger lets it slip at any friction
UNSEEN = 0.75  # cosine for a side that was not seen but whose outline runs along the pad; times
# that of the tilt, for what is outline from above may be the corner of a block from the side


class AntipodalProposer:
    """Proposes antipodal grasps on a single-view cloud (a ``Proposer``).

    The hand is symmetric under a half turn about its approach: only one of each such pair of
    grasps is returned. What the camera did not see is neither trusted nor avoided.

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

    def propose(self, cloud: PointCloud) -> Grasps:
        """Returns at most ``max_grasps`` grasps, best first, possibly none."""
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
        return _best_free(found, surface, config, self._table)


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
    shallow: NDArray[np.bool_]  # (K,) at the least depth


@dataclass(frozen=True)
class _Found(Grasps):
    """Grasps, before the hand is checked against its surroundings."""

    group: Rows = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) twice the row of the anchor on the surface; and one more for a shallow grip."""


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
    for i, depth in enumerate(sorted(config.depths)):
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
        shallow = np.full(np.count_nonzero(fits), i == 0)
        grips.append((attempt[fits], tip[fits], stretch.low[fits], stretch.high[fits], shallow))
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
    upright = -R_WG[:, 2, 2]
    facing_high, covered = _facing(x, y, towards_y, grip, high, upright)
    facing_low, _ = _facing(x, -y, -towards_y, grip, -low, upright)
    side = np.where(facing_high >= facing_low, 1, -1)[grip]
    depth_below = np.where(side > 0, high[grip] - y, y - low[grip])
    contact = row[_middle_rows(x, sweep.z[e], depth_below < AT_PAD, grip, count)]

    X_WG = np.tile(np.eye(4), (count, 1, 1))
    X_WG[:, :3, :3] = R_WG
    offset = np.stack([np.zeros(count), (high + low) / 2, grips.tip - FINGERTIP_Z], axis=-1)
    X_WG[:, :3, 3] = surface.point[anchor] + np.einsum("nij,nj->ni", R_WG, offset)
    balance = surface.balance[surface.thing[anchor]]
    score = _score(
        facing=np.stack([facing_high, facing_low]),
        depth=grips.tip - top,
        tilt=np.arccos(np.clip(upright, -1, 1)),
        covered=covered,
        lever=np.linalg.norm(X_WG[:, :2, 3] - balance, axis=1),
        spare=max_width - (high - low),
    )
    foreign = surface.thing[row] != surface.thing[anchor][grip]
    good = (np.bincount(grip[foreign], minlength=count) == 0) & (high - low <= max_width)
    good &= np.minimum(facing_high, facing_low) >= MIN_FACING
    width = (high - low).astype(np.float64)
    found = _Found(X_WG, width, score, surface.point[contact], 2 * anchor + grips.shallow)
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


def _middle_rows(x: Array, z: Array, touched: NDArray[np.bool_], grip: Rows, count: int) -> Rows:
    """Which of the points that a pad touches is in the middle of them, for each of K grips.

    Args:
        x, z: (E,) [m] the points between the fingers.
        touched: (E,) those at one pad, at least one for each grip.
        grip: (E,) 0 .. K−1, ascending: which grip each belongs to.

    Returns:
        (K,) rows of the E points.
    """
    row = np.flatnonzero(touched)
    number = np.maximum(np.bincount(grip[row], minlength=count), 1)
    away = [
        v[row] - (np.bincount(grip[row], v[row], minlength=count) / number)[grip[row]]
        for v in (x, z)
    ]
    order = np.lexsort((away[0] ** 2 + away[1] ** 2, grip[row]))
    first = np.searchsorted(grip[row][order], np.arange(count))
    return np.asarray(row[order][first])


def _facing(
    x: Array, y: Array, towards: Array, grip: Rows, end: Array, upright: Array
) -> tuple[Array, Array]:
    """How well the surface at the finger on the side of larger y faces it.

    Where that surface was seen, its normals say so. Where it was not, only its outline is known,
    which ought to run along the pad.

    Args:
        x, y: (E,) [m] the points between the fingers.
        towards: (E,) cosine between their normals and the direction to the finger.
        grip: (E,) 0 .. K−1, which grip each belongs to.
        end: (K,) [m] the largest y of each grip.
        upright: (K,) cosine of the tilt of the approach.

    Returns:
        (K,) cosine; (K,) the share of the pad's width along which there is something to hold.
    """
    count, bins = len(end), 5
    at_end = y > end[grip] - EDGE
    seen = at_end & (towards > 0.3)
    number = np.bincount(grip[seen], minlength=count)
    by_normals = np.bincount(grip[seen], towards[seen], minlength=count) / np.maximum(number, 1)
    enough = number >= 0.25 * np.bincount(grip[at_end], minlength=count)

    column = np.clip((x / SLAB + 1) / 2 * bins, 0, bins - 1).astype(np.int64)
    outline = np.full(count * bins, -np.inf, dtype=y.dtype)
    np.maximum.at(outline, grip * bins + column, y)
    held = np.isfinite(outline).reshape(count, bins)
    slope = _slope(np.where(held, outline.reshape(count, bins), 0), held)
    by_outline = UNSEEN * upright / np.sqrt(1 + slope**2)
    return np.where(enough, by_normals, by_outline), held.mean(axis=1)


def _slope(y: Array, valid: NDArray[np.bool_]) -> Array:
    """The slope (K,) of the line through the valid ones of B points across the slab, (K, B)."""
    weight = valid / valid.sum(axis=1, keepdims=True)
    x = np.arange(y.shape[1]) * (2 * SLAB / y.shape[1])
    x = x - (weight * x).sum(axis=1, keepdims=True)
    spread = (weight * x**2).sum(axis=1)
    return np.asarray((weight * x * y).sum(axis=1) / np.maximum(spread, 1e-9))


def _score(
    *, facing: Array, depth: Array, tilt: Array, covered: Array, lever: Array, spare: Array
) -> Array:
    """Confidence in [0, 1] (K,), from what told good grasps from bad ones in simulated lifts.

    Args:
        facing: (2, K) cosine of the surface at each finger.
        depth: (K,) [m] of the fingertips below the top of what is gripped.
        tilt: (K,) [rad] of the approach from the vertical.
        covered: (K,) share of the pad that holds something.
        lever: (K,) [m] horizontally from where the centre of mass may be.
        spare: (K,) [m] by which it could be wider.
    """
    return np.asarray(
        0.30 * np.clip((facing - MIN_FACING) / (0.95 - MIN_FACING), 0, 1).mean(axis=0)
        + 0.20 * np.minimum(depth / 0.025, 1)
        + 0.10 * (1 - (tilt / np.radians(75)) ** 2)
        + 0.10 * covered
        + 0.25 * np.exp(-((lever / 0.06) ** 2))
        + 0.05 * np.clip(spare / 0.02, 0, 1)
    )


def _best_free(found: _Found, surface: Surface, config: Antipodal, table: float) -> Grasps:
    """Of the best grasps of each anchor those at which the open hand is free, best first.

    Shallow grips count as another anchor's: deeper ones score higher, but where a small part sits
    on top of a larger one, as a cap on a bottle, only shallow ones hold that part alone.
    """
    found = found.take(np.lexsort((-found.score, found.group)))
    found = found.take(np.flatnonzero(_rank(found.group) < config.per_group))
    if len(found) == 0:
        return Grasps.empty()
    groups = np.split(np.arange(len(found)), np.flatnonzero(np.diff(found.group // 2)) + 1)
    free = np.concatenate([_is_free(found.take(g), surface, config, table) for g in groups])
    found = found.take(np.flatnonzero(free))
    # Every group's best grasp comes before any group's second, so that no part is left out.
    chosen = np.lexsort((-found.score, _rank(found.group)))[: config.max_grasps]
    best = chosen[np.argsort(-found.score[chosen], kind="stable")]
    return Grasps(*(getattr(found, name)[best] for name in Grasps.__annotations__))


def _rank(group: Rows) -> Rows:
    """The place of each row within its group, from 0; ``group`` is ascending."""
    return np.arange(len(group)) - np.searchsorted(group, group)


def _is_free(found: _Found, surface: Surface, config: Antipodal, table: float) -> NDArray[np.bool_]:
    """Whether the open hand touches neither the table nor a point, for grasps at one anchor."""
    lower, upper = hand_boxes(arrival_opening(found.width))
    free: NDArray[np.bool_] = lowest_corner(found.X_WG, lower, upper) > (
        table + config.table_clearance - 1e-6
    )
    near = surface.tree.query_ball_point(surface.point[found.group[0] // 2], HAND_REACH)
    lower, upper = lower - config.clearance, upper + config.clearance
    free &= points_inside(found.X_WG, lower, upper, surface.point[near]) == 0
    return free
