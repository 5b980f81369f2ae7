"""A grasp for a task from a saved view: no robot, no simulation."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tog_drake.candidates import pick_candidates
from tog_drake.cloud import scene_cloud
from tog_drake.decision import Decision
from tog_drake.errors import EpisodeError, InputError, NoFeasibleGrasp, NoGrasp
from tog_drake.panda import arrival_opening
from tog_drake.pinhole import project
from tog_drake.pipeline import PipelineConfig, make_proposer, make_selector
from tog_drake.proposer import weights_of
from tog_drake.table import find_table
from tog_drake.task import read_task
from tog_drake.values import Array, FeasibleGrasps, Grasps, View
from tog_drake.visibility import hidden_share

GRASPS_SCHEMA = "tog_drake/grasps/1"


def choose_on_view(
    view: View, config: PipelineConfig, *, task: str, seed: int, X_WC: Array | None = None
) -> Decision:
    """Runs the stages that need no robot: cloud, proposer, candidates, selector.

    The world is that of the table that is found in the view. Whether an arm could reach a grasp
    is not asked, but a grasp that would push a finger behind what was seen is left out.

    Args:
        view: its ``X_WC`` is not used.
        config: workspace and camera in it are not used.
        task: what a person said.
        seed: of everything random.
        X_WC: the camera's pose in a world whose z points up, (4, 4), if known: tells up.

    Raises:
        InputError: if there is no table or nothing on it in view, or the task is empty.
    """
    read_task(task)
    decision = Decision()
    seconds = decision.seconds

    def timed(stage: str, calculate: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        try:
            return calculate()
        finally:
            seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start

    table = timed("cloud", lambda: find_table(view, seed, up=None if X_WC is None else X_WC[2, :3]))
    view = replace(view, X_WC=table.X_WC)
    config = replace(config, workspace=table.workspace)
    selector, proposer = make_selector(config, seed), make_proposer(config, seed)
    decision.view = view
    try:
        cloud = timed("cloud", lambda: scene_cloud([view], config.workspace, config.cloud))
    except NoGrasp as error:
        raise InputError(str(error)) from error  # here the view is what was given
    decision.cloud = cloud
    try:
        grasps = timed("propose", lambda: proposer.propose(cloud, view))
        decision.grasps = grasps
        if len(grasps) == 0:
            raise NoGrasp(
                f"no grasp proposed on {cloud.size()} points: nothing in view is narrower than "
                "the hand's opening and free around it"
            )
        free = timed("filter", lambda: _free(grasps, view, config.feasibility.max_hidden))
        decision.feasible_grasps = free
        candidates = timed("candidates", lambda: pick_candidates(free, config.candidates, seed))
        decision.candidates = candidates
        decision.choice = timed("select", lambda: selector.select(view, cloud, candidates, task))
    except EpisodeError as error:
        decision.error = error
    decision.weights = weights_of(proposer)
    return decision


def _free(grasps: Grasps, view: View, max_hidden: float) -> FeasibleGrasps:
    """The grasps that push no finger behind what was seen, without joint paths: there is no arm.

    Raises NoFeasibleGrasp if all do.
    """
    hidden = hidden_share(grasps.X_WG, arrival_opening(grasps.width), [view]) > max_hidden
    if hidden.all():
        raise NoFeasibleGrasp(
            f"all {len(grasps)} proposed grasps would push a finger behind what was seen: show the "
            "object from another side",
            {"hidden": len(grasps)},
        )
    free = grasps.take(np.flatnonzero(~hidden))
    nowhere = np.zeros((len(free), 0, 7))
    return FeasibleGrasps(
        X_WG=free.X_WG,
        width=free.width,
        score=free.score,
        p_WContact=free.p_WContact,
        q_approach=nowhere,
        q_lift=nowhere,
        rejected={"hidden": int(hidden.sum())},
    )


def grasps_record(decision: Decision) -> dict[str, Any]:
    """Returns the content of ``grasps.json``: the grasps that were left to choose from.

    They are in the camera's frame, best first; ``choice`` and ``candidates`` are rows of them.
    """
    assert decision.view is not None
    choice, candidates = decision.choice, decision.candidates
    X_CW = np.linalg.inv(decision.view.X_WC)
    rows = []
    if candidates is not None:
        grasps = candidates.grasps
        pixels = project(grasps.p_WContact, decision.view.intrinsics, decision.view.X_WC)
        X_CG = X_CW @ grasps.X_WG
        p_C = grasps.p_WContact @ X_CW[:3, :3].T + X_CW[:3, 3]
        rows = [
            {
                "X_CG": X_CG[i].tolist(),
                "width": float(grasps.width[i]),
                "score": float(grasps.score[i]),
                "contact": p_C[i].tolist(),
                "pixel": pixels[i].tolist(),
            }
            for i in range(len(grasps))
        ]
    return {
        "schema": GRASPS_SCHEMA,
        "frame": "camera: x right, y down, z forward [m]",
        "grasp_frame": "origin between the finger pads, z approach, y closing; "
        "a Panda's hand body (franka_hand) is 0.1034 m behind it along z",
        "X_CW": X_CW.tolist(),
        "world": "on the table top: z up, x the image's right",
        "choice": None if choice is None else choice.index,
        "candidates": [] if candidates is None else candidates.index.tolist(),
        "grasps": rows,
    }
