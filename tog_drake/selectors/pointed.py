"""Strategies in which a model points at the object, and the nearest grasp is taken."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tog_drake.errors import NoChoice, Unanswered
from tog_drake.pinhole import project
from tog_drake.selectors import prompts
from tog_drake.selectors.marks import plain
from tog_drake.selectors.scene import Ask, Pick, Scene
from tog_drake.selectors.vlm.question import Answer, Points, Question
from tog_drake.values import Array, Grasps

MAX_MISS = 15.0
"""[pixel] in a view 640 wide, in proportion in others: a point that misses everything that was
seen by more is on no object. At half a metre from the camera it is about 1 cm."""
MAX_REACH = 0.06
"""[m] A grasp whose contact is farther from the place pointed at does not hold that place. From
the middle of what is seen of a part the nearest contact on it is 9 mm away in the median, 26 mm in
95 of 100 cases, and 44 mm with the body of a mug, which is held by its rim (20 objects, 2 poses,
parts to use and to hand over by). The paper has no such limit, nor has its rule, ``contact``."""
KEEP_OFF = 0.03  # [m] a grasp with a contact nearer than this to the place to avoid is dropped


def cpg(scene: Scene, ask: Ask) -> Pick:
    """Contact point guided: of all feasible grasps the nearest to where it points wins."""
    pixels, (grasp,) = _seen_points(scene, ask, "cpg", ("grasp",))
    pick = _nearest(scene, grasp, np.ones(len(scene.candidates.grasps), bool))
    return replace(pick, pointed=pixels)


def avoid(scene: Scene, ask: Ask) -> Pick:
    """As cpg, without the grasps with a finger close to the place to avoid, or nearer to it than
    to the place to hold."""
    pixels, (grasp, avoided) = _seen_points(scene, ask, "avoid", ("grasp", "avoid"))
    grasps = scene.candidates.grasps
    away = _distances(grasps, avoided).min(axis=1)
    allowed = (away > KEEP_OFF) & (away > _distances(grasps, grasp).min(axis=1))
    pick = _nearest(scene, grasp, allowed)
    reason = f"{pick.reason} {(~allowed).sum()} grasps at the place to avoid are left out."
    return replace(pick, reason=reason, pointed=pixels)


def _seen_points(
    scene: Scene, ask: Ask, name: str, roles: tuple[str, ...]
) -> tuple[dict[str, tuple[float, float]], list[Array]]:
    """Asks for a point in the picture for each role; returns their pixels in the view by role, and
    the points in W that are seen there."""
    framing = scene.framing(Grasps.empty())  # the things alone: nothing is marked
    prompt = scene.prompt or prompts.load(name)

    def seen(answer: Answer) -> dict[str, tuple[Array, Array]]:
        assert isinstance(answer, dict)
        pixels = {role: framing.to_view(answer[role]) for role in roles}
        return {role: (pixel, _seen_point(scene, pixel, role)) for role, pixel in pixels.items()}

    answer = ask(
        Question(
            prompt=prompt.version,
            parts=(plain(scene.view, framing), prompt.render(task=scene.task)),
            expects=Points(roles, framing.size),
            check=seen,
        )
    )
    places = seen(answer)
    pixels = {role: (float(u), float(v)) for role, ((u, v), _) in places.items()}
    return pixels, [point for _, point in places.values()]


def _seen_point(scene: Scene, pixel: Array, role: str) -> Array:
    """Returns the point of the cloud, (3,) in W, that is seen nearest to a pixel (2,) of the view.

    Raises Unanswered where the pixel is outside the view, or on nothing that was seen.
    """
    camera = scene.view.intrinsics
    u, v = pixel
    where = f"the point to {role}, ({u:.0f}, {v:.0f}) in the view,"
    if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
        raise Unanswered(
            "off_image", f"{where} is outside the view of {camera.width}×{camera.height}"
        )
    miss = np.linalg.norm(project(scene.points, camera, scene.view.X_WC) - pixel, axis=1)
    miss = np.where(np.isfinite(miss), miss, np.inf)
    nearest = int(np.argmin(miss))
    limit = MAX_MISS * max(camera.width, camera.height) / 640
    if miss[nearest] > limit:
        raise Unanswered(
            "off_object",
            f"{where} is on no object: the nearest is {miss[nearest]:.0f} pixels away, and "
            f"{limit:.0f} would do",
        )
    return np.asarray(scene.points[nearest])


def _nearest(scene: Scene, point: Array, allowed: NDArray[np.bool_]) -> Pick:
    """Returns the allowed grasp that is nearest to a point, (3,) in W.

    In the paper that is the one with the nearest contact, and its other finger may be on another
    part. By default the farther of its two contacts counts: of all places seen on 14 parts of seven
    objects 92 % then lead to a grasp of that part alone, instead of 85 % (a hammer's head: 95 %
    instead of 65 %, a mug's handle: 90 % instead of 53 %).
    """
    distances = _distances(scene.candidates.grasps, point)
    contact = distances[:, 0]
    both = scene.nearest == "both"
    fits = allowed & (contact <= MAX_REACH) if both else allowed
    if not fits.any():
        raise NoChoice(_why_none(contact, allowed), status="no_grasp_on_part")
    counts = distances.max(axis=1) if both else contact
    worth = np.where(fits, -counts, -np.inf)
    index = int(np.argmax(worth))
    which = "the farther of its two contacts" if both else "its contact"
    among = f"{fits.sum()} grasps " + ("there" if both else "allowed")
    reason = (
        f"Of {among} it is nearest to where the model points: {which} is "
        f"{1e3 * counts[index]:.0f} mm away."
    )
    return Pick(index, reason, worth)


def _distances(grasps: Grasps, point: Array) -> Array:
    """Returns how far both contacts are from a point: (N, 2) [m], that at ``p_WContact`` first."""
    contacts = np.stack([grasps.p_WContact, grasps.p_WOtherContact], axis=1)
    return np.asarray(np.linalg.norm(contacts - point, axis=2))


def _why_none(distance: Array, allowed: NDArray[np.bool_]) -> str:
    if not allowed.any():
        return (
            f"All {len(allowed)} feasible grasps have a finger nearer to the place to avoid than "
            f"to the place to hold, or within {100 * KEEP_OFF:.0f} cm of it."
        )
    dropped = f" {(~allowed).sum()} others are at the place to avoid." if not allowed.all() else ""
    return (
        f"No feasible grasp holds the place that the model points at: the nearest of "
        f"{allowed.sum()} contacts is {100 * distance[allowed].min():.1f} cm away, and at most "
        f"{100 * MAX_REACH:.0f} cm are allowed.{dropped}"
    )
