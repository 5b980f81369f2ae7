"""Writes what happened in one or a few episodes as one HTML file that needs nothing else.

The page loads nothing from anywhere: images are data URLs, and each Meshcat replay is carried
compressed and unpacked only when somebody opens it. Task, reason and every other text came from
outside (a user, a model) and is escaped; a content security policy forbids all requests besides.
"""

import base64
import gzip
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tog_drake.decision import STAGES
from tog_drake.drawing import HOLE_COLOR, depth_image, depth_range, encode_png
from tog_drake.files import write_atomically
from tog_drake.pages import page_environment
from tog_drake.record import ChoiceRecord, EpisodeRecord, proposer_name, usage
from tog_drake.values import Exchange, GraspMotion, View
from tog_drake.visible_text import visible

FUNNEL = {
    "points": "points of the cloud",
    "proposed": "grasps proposed",
    "feasible": "feasible",
    "candidates": "candidates shown",
}


LONGEST = 2000  # characters of a text from outside that the page shows


@dataclass(frozen=True)
class EpisodeReport:
    """One episode as the report shows it. What is None, because a stage failed, is left out."""

    record: Mapping[str, Any]  # the content of episode.json
    view: View | None = None  # what the robot saw
    decision: NDArray[np.uint8] | None = None  # (H, W, 3) see drawing.decision_image
    motion: GraspMotion | None = None  # as planned
    replay: str | None = None  # see visualization.replay_html
    exchanges: Sequence[Exchange] = ()  # what a model was asked, and what it said
    exchanges_before: Sequence[Exchange] = ()  # likewise, at looks whose grasp failed
    views: Sequence[tuple[str, NDArray[np.uint8]]] = ()
    """Of each camera that the pipeline read, if several, its name and (H, W, 3) with the
    candidates drawn in."""


def write_report(
    path: Path, episodes: Sequence[EpisodeReport], *, title: str = "Grasping by task"
) -> None:
    """Writes the report to ``path``, whole or not at all.

    Two episodes at 640×480 with replays take about 3 MB.

    Raises:
        OSError: the file cannot be written.
    """
    write_atomically(path, report_html(episodes, title=title))


_GROUPS: dict[str, Iterable[str]] = {
    "choice": ChoiceRecord.__annotations__,
    "counts": ("feasible",),
    "held": (),
    "proposer": (),
    "rejected": (),
    "seconds": ("decide", "execute"),
    "selector": ("kind",),
    "sim": ("seconds", "real_time_rate"),
}
"""Of each group of the record what the template reads without asking whether it is there."""


def report_html(episodes: Sequence[EpisodeReport], *, title: str = "Grasping by task") -> str:
    """Returns the report as the text of a page."""
    environment = page_environment()
    environment.filters.update(words=_words, milliseconds=_milliseconds)
    return environment.get_template("report.html.j2").render(
        title=title,
        episodes=[_page_of(episode) for episode in episodes],
        funnel=FUNNEL,
        hole_color="#{:02x}{:02x}{:02x}".format(*HOLE_COLOR),
    )


def _page_of(episode: EpisodeReport) -> dict[str, Any]:
    """Returns what the template shows of an episode, as plain values."""
    # What a failed stage or an older version left out reads as none, and need not be asked for.
    record = dict.fromkeys(EpisodeRecord.__annotations__) | _shown(dict(episode.record))
    for group, fields in _GROUPS.items():
        record[group] = dict.fromkeys(fields) | (record[group] or {})
    view = episode.view
    return {
        "record": record,
        "held": _held(record["held"]),
        "proposer": proposer_name(record["proposer"]) if record["proposer"] else None,
        "json": json.dumps(_shown(dict(episode.record)), indent=2, ensure_ascii=False, default=str),
        "rgb": None if view is None else _data_url(view.rgb),
        "depth": None if view is None else _data_url(depth_image(view.depth)),
        "depth_range": None if view is None else depth_range(view.depth),
        "decision": None if episode.decision is None else _data_url(episode.decision),
        "views": _strip(episode.views, record["view_selection"] or {}),
        "asked": _asked(
            record["vlm"] or {},
            episode.exchanges_before,
            episode.exchanges,
            record["choice"].get("index"),
        ),
        "stages": _timings(record["seconds"]),
        "motion": None if episode.motion is None else _plot(episode.motion),
        "replay": None if episode.replay is None else _pack(episode.replay),
    }


def _shown(value: Any) -> Any:
    """Returns a value of the record with each text in it, from wherever it came, fit to be shown.

    ``episode.json`` itself has the texts as they are and whole.
    """
    if isinstance(value, str):
        return visible(value, limit=LONGEST, lines=True)
    if isinstance(value, Mapping):
        return {_shown(key): _shown(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [_shown(content) for content in value]
    return value


def _asked(
    vlm: Mapping[str, Any],
    before: Sequence[Exchange],
    last: Sequence[Exchange],
    chosen: int | None,
) -> dict[str, Any] | None:
    """Returns what the template shows of the questions to a model; None where there were none.

    Args:
        vlm: of the record.
        before: the questions at looks whose grasp failed.
        last: those at the last look.
        chosen: the grasp that was chosen at the last look.
    """
    exchanges = [*before, *last]
    if not exchanges:
        return None
    fallback = vlm.get("fallback")
    chosen = None if fallback else chosen  # the grasp that the model chose
    first: dict[bytes, str] = {}  # an image that is sent again is shown once
    return {
        "summary": {
            "Strategy": vlm.get("strategy"),
            "Rendering": vlm.get("rendering"),
            "Model asked for": vlm.get("model"),
            "Seed of the marks": vlm.get("seed"),
            "Status": _words(vlm.get("status") or exchanges[-1].status),
            "Fallback": f"{fallback}, which made the choice" if fallback else "not needed",
            "In all": usage(
                sum(exchange.seconds for exchange in exchanges),
                [exchange.tokens for exchange in exchanges],
                [exchange.cost for exchange in exchanges],
                [_cassette(exchange) for exchange in exchanges],
            ),
        },
        "questions": [
            _question(number, exchange, first, None if number <= len(before) else chosen)
            | {"before": number <= len(before)}
            for number, exchange in enumerate(exchanges, 1)
        ],
    }


def _question(
    number: int, exchange: Exchange, first: dict[bytes, str], chosen: int | None
) -> dict[str, Any]:
    answer = exchange.answer
    marks = [
        f"{label} is grasp {row}" + (" (chosen)" if row == chosen else "")
        for label, row in exchange.marks.items()
    ]
    return {
        "number": number,
        "prompt": visible(exchange.prompt, limit=100),
        "status": exchange.status,
        "images": [
            _image(image, number, i, first, exchange.points if i == len(exchange.images) else {})
            for i, image in enumerate(exchange.images, 1)
        ],
        "text": visible(exchange.text, limit=4 * LONGEST, lines=True),
        "answer": None if answer is None else visible(answer, limit=LONGEST, lines=True),
        "facts": {
            "What is wrong": visible(exchange.message, limit=LONGEST) or None,
            "Marks": visible("; ".join(marks), limit=LONGEST) or None,
            "Model that answered": (
                "not said" if exchange.model is None else visible(exchange.model, limit=100)
            ),
            "It took": usage(
                exchange.seconds, [exchange.tokens], [exchange.cost], [_cassette(exchange)]
            ),
            "Tokens": ", ".join(f"{n:,} {of}" for of, n in (exchange.tokens or {}).items()) or None,
            "Key": visible(exchange.key, limit=100),
        },
    }


def _strip(
    views: Sequence[tuple[str, NDArray[np.uint8]]], selection: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Returns what the template shows of the views of several cameras."""
    scores, seen = selection.get("scores", {}), selection.get("candidates_visible", {})
    return [
        {
            "camera": visible(camera, limit=100),
            "picture": _data_url(image),
            "score": scores.get(camera),
            "seen": seen.get(camera),
            "selected": camera == selection.get("camera"),
        }
        for camera, image in views
    ]


def _cassette(exchange: Exchange) -> str | None:
    return None if exchange.replayed is None else visible(exchange.replayed, limit=LONGEST)


def _image(
    image: NDArray[np.uint8],
    number: int,
    i: int,
    first: dict[bytes, str],
    points: Mapping[str, tuple[float, float]],
) -> dict[str, Any]:
    """An image as it was sent and the points to ring in it, or where it was shown before."""
    height, width = image.shape[:2]
    size = f"{width}×{height}"
    content = image.tobytes()
    if content in first and not points:
        return {"source": None, "text": f"{size}, the same as {first[content]}", "rings": []}
    first[content] = f"image {i} of question {number}"
    rings = [
        (role, *np.clip([100 * (u + 0.5) / width, 100 * (v + 0.5) / height], 0.0, 100.0).tolist())
        for role, (u, v) in points.items()
    ]
    roles = (f"{role} (dashed)" if role == "avoid" else role for role in points)
    ringed = f", ringed: where the model points to {' and to '.join(roles)}" if points else ""
    return {
        "source": _data_url(image, compression=9),
        "text": visible(size + ringed, limit=LONGEST),
        "rings": rings,
    }


def _held(shares: Mapping[str, float]) -> str | None:
    """Returns the part that is held, with the shares where there are several."""
    if len(shares) < 2:
        return next(iter(shares), None)
    parts = sorted(shares.items(), key=lambda part: -part[1])
    return ", ".join(f"{part} {share:.0%}" for part, share in parts)


def _timings(seconds: Mapping[str, float | None]) -> list[tuple[str, float, float]]:
    """Returns of each timed stage what it does, its seconds, and its share of the longest."""
    timed = [(s.does, value) for s in STAGES if (value := seconds.get(s.key)) is not None]
    longest = max((value for _, value in timed), default=0.0) or 1.0
    return [(text, value, value / longest) for text, value in timed]


WIDTH, HEIGHT = 760.0, 324.0  # of the plot, in units of its viewBox
LEFT, RIGHT, TOP, BOTTOM = 40.0, 36.0, 36.0, 26.0  # margins
HAND_HEIGHT = 46.0  # of the strip with the hand's opening, below the joints


def _plot(motion: GraspMotion) -> dict[str, Any]:
    """Returns the planned motion as what an SVG needs: joint angles above, the opening below."""
    times = np.linspace(0.0, motion.duration, 120)
    q = np.stack([motion.arm.value(t)[:, 0] for t in times])
    opening = 1e3 * np.clip([motion.hand.value(t)[0, 0] for t in times], 0.0, None)
    low, high = np.floor(q.min()), np.ceil(q.max())
    joints_bottom = HEIGHT - BOTTOM - HAND_HEIGHT - 24.0
    hand_bottom = HEIGHT - BOTTOM
    widest = max(80.0, float(opening.max()))

    def x_of(t: Any) -> Any:
        return LEFT + (WIDTH - LEFT - RIGHT) * t / max(motion.duration, 1e-9)

    def y_of(angle: Any) -> Any:
        return joints_bottom - (joints_bottom - TOP) * (angle - low) / max(high - low, 1e-9)

    hand = hand_bottom - HAND_HEIGHT * opening / widest
    begins = {"transfer": 0.0} | motion.phase_times
    phases = sorted(begins.items(), key=lambda phase: phase[1])
    return {
        "size": (WIDTH, HEIGHT),
        "frame": (LEFT, WIDTH - RIGHT, TOP, joints_bottom, hand_bottom),
        "joints": [_points(x_of(times), y_of(angle)) for angle in q.T],
        "labels": _spread([float(y_of(angle)) for angle in q[-1]]),
        "hand": _points(
            np.r_[LEFT, x_of(times), WIDTH - RIGHT], np.r_[hand_bottom, hand, hand_bottom]
        ),
        "angles": [(int(a), float(y_of(a))) for a in np.arange(low, high + 1)],
        "seconds": [(int(t), float(x_of(t))) for t in np.arange(0, motion.duration + 1e-9)],
        "phases": [(name, float(x_of(begin))) for name, begin in phases],
        "widest": widest,
        "hand_height": HAND_HEIGHT,
        "duration": motion.duration,
        "note": motion.note,
    }


def _points(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def _spread(heights: list[float], apart: float = 12.0) -> list[float]:
    """Moves labels down until none covers another; they keep their order."""
    placed = list(heights)
    for before, label in zip(order := np.argsort(heights), order[1:], strict=False):
        placed[label] = max(placed[label], placed[before] + apart)
    return placed


def _data_url(image: NDArray[np.uint8], compression: int = 1) -> str:
    png = encode_png(image, compression=compression)
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _pack(page: str) -> str:
    """Returns the page as base64 of gzip: a third of its size; ``mtime`` keeps it reproducible."""
    return base64.b64encode(gzip.compress(page.encode(), mtime=0)).decode()


def _words(identifier: object) -> str:
    """Returns ``hand_collision`` as "hand collision" and ``no_ik`` as "no IK"."""
    return " ".join("IK" if word == "ik" else word for word in str(identifier).split("_"))


def _milliseconds(seconds: float) -> str:
    ms = 1e3 * seconds
    return f"{ms:.1f}" if ms < 10 else f"{ms:,.0f}"
