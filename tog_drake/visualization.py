"""Draws in Meshcat what was decided, and turns the recording into a page that needs no server.

What is drawn are values that were computed once and kept, never a port of a stage: a live camera
invalidates every stage at every step, and drawing from a port would run the pipeline again.
"""

import html
from collections.abc import Sequence
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


def draw_decision(
    meshcat: Meshcat,
    *,
    cloud: PointCloud | None = None,
    grasps: Grasps | None = None,
    candidates: Candidates | None = None,
    choice: Choice | None = None,
    motion: GraspMotion | None = None,
    X_WL0: Array | None = None,
) -> None:
    """Draws a decision in place of the last one. What is None, because its stage failed, is not.

    Args:
        cloud: what the robot saw, in W, in its colours.
        grasps: all of them, faint; None takes those that the candidates were picked from.
        candidates: each in its colour.
        choice: bold, with a ball at the contact point; where the motion carries out an alternative
            to it, that one is drawn.
        motion: the path of the grasp frame.
        X_WL0: (4, 4) where the arm stands; None is at the origin of W.
    """
    meshcat.Delete(DECISION)
    if grasps is None and candidates is not None:
        grasps = candidates.grasps
    if cloud is not None:
        _draw_cloud(meshcat, f"{DECISION}/seen/cloud", cloud)
    if grasps is not None and len(grasps):
        _draw_faint(meshcat, f"{DECISION}/seen/grasps", hand_wireframe(grasps).reshape(-1, 2, 3))
    if candidates is not None:
        _draw_candidates(meshcat, f"{DECISION}/seen/candidates", candidates)
    if choice is not None:
        color = choice_color(candidates, choice)
        grasp = choice.grasp if motion is None or len(motion.grasp) == 0 else motion.grasp
        _draw_grasp(meshcat, f"{DECISION}/seen/choice", grasp, color)
    if motion is not None:
        points = grasp_path(motion, X_WL0)
        ends = np.stack([points[:-1], points[1:]], axis=1)
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
    the visualizer publish at ``duration``, so that all tracks are equally long.

    Args:
        duration: when the recording ends [s].
        decided: when the decision was made [s]; its drawing appears then.
        closed: when the hand began to close [s], if it came to that. The drawing vanishes then,
            except for the path: it shows where things *were*.
    """
    _record_visible(meshcat, DECISION, {0.0: False, decided: True, duration: True})
    if closed is not None and closed < duration:
        _record_visible(meshcat, f"{DECISION}/seen", {0.0: True, closed: False, duration: False})
    publish_recording(meshcat)
    return str(meshcat.StaticHtml())


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


def _draw_cloud(meshcat: Any, path: str, cloud: PointCloud) -> None:
    rows = np.arange(0, cloud.size(), max(1, -(-cloud.size() // MAX_POINTS)))
    fields: Any = BaseField.kXYZs | (BaseField.kRGBs if cloud.has_rgbs() else BaseField.kNone)
    thin = PointCloud(len(rows), Fields(fields))
    thin.mutable_xyzs()[:] = cloud.xyzs()[:, rows]
    if cloud.has_rgbs():
        thin.mutable_rgbs()[:] = cloud.rgbs()[:, rows]
    meshcat.SetObject(path, thin, POINT_SIZE)


def _draw_candidates(meshcat: Meshcat, path: str, candidates: Candidates) -> None:
    hands = hand_wireframe(candidates.grasps.take(candidates.index))
    for rank, hand in enumerate(hands):
        color = candidate_color(rank)
        _draw_bars(
            meshcat,
            f"{path}/{rank:02d}_{candidate_color_name(rank)}",
            hand,
            CANDIDATE_RADIUS,
            color,
        )


def _draw_grasp(meshcat: Meshcat, path: str, grasp: Grasps, color: Sequence[int]) -> None:
    _draw_bars(meshcat, f"{path}/hand", hand_wireframe(grasp)[0], CHOICE_RADIUS, color)
    meshcat.SetObject(f"{path}/contact", Sphere(CONTACT_RADIUS), _rgba(color))
    meshcat.SetTransform(f"{path}/contact", RigidTransform(grasp.p_WContact[0]))


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
