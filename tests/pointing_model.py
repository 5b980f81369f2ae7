"""A model of classical vision that points at a part of a mug or a bottle, as far as it sees one.

It stands where a provider would, behind ``vlm_server``, and is asked to point (CPG). It gets the
text and the picture of a question and knows nothing of the simulation. A part that is not to be
seen, or is not to be recognised as one, it does not refuse to point at: it takes for it what it
sees most of, as a model that has to answer does. So its answer is as good as the view.
"""

import re
from collections.abc import Sequence

import cv2
import numpy as np
from seeing_server import Image, Mask, point_out

_LEAST = 60  # [pixel] of a colour make a thing
_HANDLE = 0.03  # of the cup: what is less, at its rim, is its rounding


def point_and_answer(text: str, images: Sequence[Image]) -> str:
    """Returns the answer to a question of CPG, in pixels of the picture."""
    part, parts = _seen(text, images[-1])
    held = parts.get(part)
    if held is None:
        held = max(parts.values(), key=np.count_nonzero)
    places = {"grasp": _deepest(held)}
    if '"avoid"' in text:
        places["avoid"] = _deepest(next((m for p, m in parts.items() if m is not held), held))
    return point_out(text, images[-1], places, "pixels")


def _seen(text: str, image: Image) -> tuple[str, dict[str, Mask]]:
    """Returns the part that the task wants to be held, and the parts that are seen."""
    task = " ".join(re.findall(r'"((?:[^"\\]|\\.)*)"', text)).lower()
    if re.search(r"\bmug\b", task):
        return ("handle" if "drink" in task else "body"), mug_parts(image)
    if re.search(r"\bbottle\b", task):
        return ("label" if "label" in task else "cap"), bottle_parts(image)
    raise AssertionError(f"the task is of no mug and no bottle: {task}")


def mug_parts(image: Image) -> dict[str, Mask]:
    """A red cup and, thinner, its handle; what the handle's loop encloses counts as handle."""
    h, s, v = _hsv(image)
    mug = _thing(((h < 14) | (h > 346)) & (s > 0.6) | (v < 0.12))
    reach = max(3, int(0.55 * np.sqrt(mug.sum() / np.pi)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    body = _largest(cv2.morphologyEx(mug.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0)
    handle = _largest(mug & ~cv2.dilate(body.astype(np.uint8), np.ones((7, 7))).astype(bool))
    return _known(body=body, handle=handle if handle.sum() > _HANDLE * body.sum() else None)


def bottle_parts(image: Image) -> dict[str, Mask]:
    """A deep blue cap at the top, and a label around the body, white as nothing else of it."""
    h, s, v = _hsv(image)
    blue, white = (h > 185) & (h < 240), (s < 0.12) & (v > 0.25) & (v < 0.97)
    bottle = _thing((blue & (s > 0.25) & (v < 0.97)) | white)
    deep = bottle & blue & (s > 0.8)
    _, component, stats, _ = cv2.connectedComponentsWithStats(deep.astype(np.uint8))
    large = [i for i in range(1, len(stats)) if stats[i, cv2.CC_STAT_AREA] >= _LEAST]
    # The print on the label is as blue as the cap.
    cap = component == min(large, key=lambda i: stats[i, cv2.CC_STAT_TOP], default=-1)
    label = np.zeros_like(bottle)
    band = cv2.morphologyEx((bottle & white).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    if np.count_nonzero(band) > _LEAST:
        hull = cv2.convexHull(np.argwhere(band)[:, ::-1].astype(np.int32))
        label = cv2.fillConvexPoly(band, hull, 1) > 0
    return _known(cap=cap, label=label)


def _known(**parts: Mask | None) -> dict[str, Mask]:
    return {name: mask for name, mask in parts.items() if mask is not None and mask.sum() > _LEAST}


def _deepest(part: Mask) -> tuple[int, int]:
    depth = cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5)
    v, u = np.unravel_index(depth.argmax(), depth.shape)
    return int(u), int(v)


def _largest(mask: Mask) -> Mask:
    _, component, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if len(stats) < 2:
        return np.zeros_like(mask)
    return component == 1 + stats[1:, cv2.CC_STAT_AREA].argmax()


def _thing(mask: Mask) -> Mask:
    """The largest piece of it, with small gaps closed and all that its outline encloses."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5)))
    outlines, _ = cv2.findContours(
        _largest(closed > 0).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0


def _hsv(image: Image) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    h, s, v = cv2.split(cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2HSV))
    return h, s, v
