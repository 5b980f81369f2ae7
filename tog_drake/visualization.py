"""Draws in Meshcat what was decided, and turns the recording into a page that needs no server.

What is drawn are values that were computed once and kept, never a port of a stage: a live camera
invalidates every stage at every step, and drawing from a port would run the pipeline again.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba, Sphere
from pydrake.math import RigidTransform
from pydrake.perception import BaseField, Fields, PointCloud

from tog_drake.drawing import (
    candidate_color,
    candidate_color_name,
    choice_color,
    hand_wireframe,
)
from tog_drake.errors import InputError
from tog_drake.panda import X_HG, forward_kinematics
from tog_drake.values import Array, Candidates, Choice, GraspMotion, Grasps

if TYPE_CHECKING:
    from IPython.display import HTML

DECISION = "/decision"  # everything that draw_decision draws is below this path
MAX_POINTS = 20_000  # of the cloud: 0.4 MB in a static page
EYE, TARGET = (0.98, -0.48, 0.5), (0.36, 0.0, 0.25)  # [m] in W: where the camera is and looks
POINT_SIZE = 0.004  # [m]
PATH_COLOR = (255, 120, 0)
FAINT_RGBA, FAINT_OPACITY = Rgba(0.35, 0.35, 0.35), 0.15
# Radii of bars [m]. WebGL draws every line one pixel wide, so what must stand out is a solid.
CANDIDATE_RADIUS, CHOICE_RADIUS, PATH_RADIUS, CONTACT_RADIUS = 0.002, 0.0045, 0.002, 0.009


def make_meshcat(*, host: str = "localhost", port: int | None = None) -> Meshcat:
    """Starts Meshcat with the camera on the table and the arm.

    Args:
        host: who may connect; "localhost" is this machine only, "*" everybody.
        port: None takes the first that is free from 7000 on.

    Raises:
        RuntimeError: the port is taken.
    """
    # Any, here and below: pydrake's type stubs refuse arrays where they are meant.
    meshcat: Any = Meshcat(MeshcatParams(host=host, port=port, show_stats_plot=False))
    meshcat.SetProperty("/Grid", "visible", False)  # it would flicker in the plane of the table
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(np.array(EYE), np.array(TARGET))
    started: Meshcat = meshcat
    return started


def inline(meshcat: Meshcat, *, live: bool = False, height: int = 400) -> "HTML":
    """Returns what shows a scene as the last value of a notebook's cell.

    Args:
        meshcat: the scene.
        live: follow it; the browser must be on this machine. Otherwise, as in Colab or Deepnote,
            where no port can be reached, the cell holds the scene as it is now: 2.2 MB and more.
        height: [pixel] of the cell.

    Raises:
        InputError: there is no IPython, so no notebook either.
    """
    if live:
        return notebook_cell("src", meshcat.web_url(), height)
    return notebook_cell("srcdoc", meshcat.StaticHtml(), height)


def notebook_cell(source: str, page: str, height: int) -> "HTML":
    """Returns a cell that holds a page: its address (``src``) or its text (``srcdoc``).

    Raises:
        InputError: there is no IPython, so no notebook either.
    """
    try:
        from IPython.display import HTML
    except ImportError as error:
        raise InputError(
            f"a notebook's cell needs IPython ({error}); install it with: "
            "pip install 'tog_drake[notebooks]'"
        ) from error

    shown: Any = HTML  # it has no types
    cell: HTML = shown(
        f'<div style="height: {height}px"><iframe {source}="{html.escape(page)}" '
        'style="width: 100%; height: 100%; border: 0"></iframe></div>'
    )
    return cell


@dataclass(frozen=True)
class Sketch:
    """What is drawn of a decision, in W [m]; what its stage did not come to has no rows."""

    cloud: Array  # (M, 3) what the robot saw
    cloud_rgb: NDArray[np.uint8]  # (M, 3) its colours; no rows: it has none
    grasps: Array  # (S, 2, 3) segments, of all hands
    candidates: Array  # (K, 4, 2, 3) the segments of each hand, the best first
    choice: Array  # (4, 2, 3) those of the hand that was chosen
    contact: Array  # (1, 3) where a pad of it touches
    choice_rgb: NDArray[np.uint8]  # (3,)
    path: Array  # (P, 3) of the origin of the grasp frame


def sketch_of(
    *,
    cloud: PointCloud | None = None,
    grasps: Grasps | None = None,
    candidates: Candidates | None = None,
    choice: Choice | None = None,
    motion: GraspMotion | None = None,
    X_WL0: Array | None = None,
) -> Sketch:
    """Returns what is drawn of a decision. What is None, because its stage failed, is not.

    Args:
        cloud: what the robot saw, in W, in its colours.
        grasps: all of them, faint; None takes those that the candidates were picked from.
        candidates: each in its colour.
        choice: bold, with a ball at the contact point; where the motion carries out an alternative
            to it, that one is drawn.
        motion: the path of the grasp frame.
        X_WL0: (4, 4) where the arm stands; None is at the origin of W.
    """
    if grasps is None:
        grasps = Grasps.empty() if candidates is None else candidates.grasps
    few, chosen = Grasps.empty(), Grasps.empty()
    if candidates is not None:
        few = candidates.grasps.take(candidates.index)
    if choice is not None:
        chosen = choice.grasp if motion is None or len(motion.grasp) == 0 else motion.grasp
    seen = PointCloud(0) if cloud is None else cloud
    rows = np.arange(0, seen.size(), max(1, -(-seen.size() // MAX_POINTS)))
    return Sketch(
        cloud=seen.xyzs().T[rows],
        cloud_rgb=seen.rgbs().T[rows] if seen.has_rgbs() else np.zeros((0, 3), np.uint8),
        grasps=hand_wireframe(grasps).reshape(-1, 2, 3),
        candidates=hand_wireframe(few),
        choice=hand_wireframe(chosen).reshape(-1, 2, 3),
        contact=chosen.p_WContact,
        choice_rgb=np.array(
            (255, 255, 255) if choice is None else choice_color(candidates, choice), np.uint8
        ),
        path=np.zeros((0, 3)) if motion is None else grasp_path(motion, X_WL0),
    )


def draw_decision(meshcat: Meshcat, **decided: Any) -> None:
    """Draws a decision in place of the last one; ``decided`` is as in ``sketch_of``."""
    draw_sketch(meshcat, sketch_of(**decided))


def draw_sketch(meshcat: Meshcat, sketch: Sketch) -> None:
    """Draws a decision in place of the last one."""
    meshcat.Delete(DECISION)
    if len(sketch.cloud):
        _draw_cloud(meshcat, f"{DECISION}/seen/cloud", sketch.cloud, sketch.cloud_rgb)
    if len(sketch.grasps):
        _draw_faint(meshcat, f"{DECISION}/seen/grasps", sketch.grasps)
    for rank, hand in enumerate(sketch.candidates):
        path = f"{DECISION}/seen/candidates/{rank:02d}_{candidate_color_name(rank)}"
        _draw_bars(meshcat, path, hand, CANDIDATE_RADIUS, candidate_color(rank))
    if len(sketch.choice):
        color = sketch.choice_rgb.tolist()
        _draw_bars(meshcat, f"{DECISION}/seen/choice/hand", sketch.choice, CHOICE_RADIUS, color)
        ball = f"{DECISION}/seen/choice/contact"
        meshcat.SetObject(ball, Sphere(CONTACT_RADIUS), _rgba(color))
        meshcat.SetTransform(ball, RigidTransform(sketch.contact[0]))
    if len(sketch.path):
        ends = np.stack([sketch.path[:-1], sketch.path[1:]], axis=1)
        _draw_bars(meshcat, f"{DECISION}/path", ends, PATH_RADIUS, PATH_COLOR)


def grasp_path(motion: GraspMotion, X_WL0: Array | None = None, samples: int = 100) -> Array:
    """Returns where the motion takes the origin of the grasp frame, (samples, 3) [m] in W."""
    q = np.stack([motion.arm.value(t)[:, 0] for t in np.linspace(0.0, motion.duration, samples)])
    X_WL0 = np.eye(4) if X_WL0 is None else X_WL0
    return np.asarray((X_WL0 @ forward_kinematics(q) @ X_HG)[:, :3, 3])


def replay_html(
    meshcat: Meshcat, *, duration: float, decided: float = 0.0, closed: float | None = None
) -> str:
    """Ends the recording and returns a page that plays it over and over, without a server.

    The page is 2.2 MB plus the scene and its motion. Every object repeats its *own* track: have
    the visualizer publish at ``duration``, so that all tracks are equally long. The times are as in
    ``record_decision``.
    """
    record_decision(meshcat, duration=duration, decided=decided, closed=closed)
    publish_recording(meshcat)
    return str(meshcat.StaticHtml())


def record_decision(
    meshcat: Meshcat, *, duration: float, decided: float = 0.0, closed: float | None = None
) -> None:
    """Records when the drawing of a decision is visible.

    Args:
        meshcat: which records.
        duration: when the recording ends [s].
        decided: when the decision was made [s]; its drawing appears then.
        closed: when the hand began to close [s], if it came to that. The drawing vanishes then,
            except for the path: it shows where things *were*.
    """
    _record_visible(meshcat, DECISION, {0.0: False, decided: True, duration: True})
    if closed is not None and closed < duration:
        _record_visible(meshcat, f"{DECISION}/seen", {0.0: True, closed: False, duration: False})


def publish_recording(meshcat: Meshcat) -> None:
    """Ends the recording; whoever looks sees it over and over."""
    meshcat.StopRecording()
    recording = meshcat.get_mutable_recording()
    recording.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    recording.set_repetitions(20)
    meshcat.PublishRecording()


def _record_visible(meshcat: Meshcat, path: str, visible: dict[float, bool]) -> None:
    """Records whether ``path`` is visible from each time [s] on; right now it is."""
    for time, value in visible.items():
        meshcat.SetProperty(path, "visible", value, time)
    meshcat.SetProperty(path, "visible", True)


def _draw_cloud(meshcat: Any, path: str, points: Array, rgb: NDArray[np.uint8]) -> None:
    fields: Any = BaseField.kXYZs | (BaseField.kRGBs if len(rgb) else BaseField.kNone)
    cloud = PointCloud(len(points), Fields(fields))
    cloud.mutable_xyzs()[:] = points.T
    if len(rgb):
        cloud.mutable_rgbs()[:] = rgb.T
    meshcat.SetObject(path, cloud, POINT_SIZE)


def _draw_faint(meshcat: Any, path: str, ends: Array) -> None:
    """Draws (M, 2, 3) segments [m] as thin lines, in one object."""
    meshcat.SetLineSegments(path, ends[:, 0].T, ends[:, 1].T, 1.0, FAINT_RGBA)
    meshcat.SetProperty(path, "modulated_opacity", FAINT_OPACITY)  # a line ignores its own alpha


def _draw_bars(meshcat: Any, path: str, ends: Array, radius: float, color: Sequence[int]) -> None:
    """Draws (M, 2, 3) segments [m] as square bars, in one object."""
    vertices, faces = _bars(ends, radius)
    meshcat.SetTriangleMesh(path, vertices.T, faces.T, _rgba(color))


def _bars(ends: Array, radius: float) -> tuple[Array, NDArray[np.int32]]:
    """Returns vertices (8 M, 3) [m] and triangles (12 M, 3) of bars around (M, 2, 3) segments."""
    along = ends[:, 1] - ends[:, 0]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    least = np.eye(3)[np.abs(along).argmin(axis=1)]  # the axis that the segment is least along
    side = np.cross(along, least)
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    up = np.cross(along, side)
    corners = radius * np.stack([side + up, side - up, -side - up, -side + up], axis=1)  # (M, 4, 3)
    caps = radius * along[:, None] * np.array([-1, 1])[:, None]  # bars that meet fill the corner
    vertices = (ends + caps)[:, :, None] + corners[:, None]  # (M, 2 ends, 4 corners, 3)
    quads = [[0, 1, 2, 3], [7, 6, 5, 4]] + [
        [i, i + 4, (i + 1) % 4 + 4, (i + 1) % 4] for i in range(4)
    ]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    faces = triangles + 8 * np.arange(len(ends))[:, None, None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32)


def _rgba(color: Sequence[int]) -> Rgba:
    r, g, b = (channel / 255 for channel in color)
    return Rgba(r, g, b, 1.0)
