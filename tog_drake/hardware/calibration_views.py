"""The views that a calibration is made from: a folder of images, and the arm's posture at each.

`views.json` says `{"intrinsics": {fx, fy, cx, cy, width, height}, "views": [{"image": "01.png",
"q": [7 numbers, rad]}, ...]}`; without intrinsics those of the scenario's camera count.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
from pydrake.lcm import DrakeLcm

from tog_drake.drawing import encode_png
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.hardware.calibration import Board, Sight, see_board
from tog_drake.saved_view import load_intrinsics, read_color, read_json
from tog_drake.stations.camera_feed import Feed
from tog_drake.stations.lcm_bus import PANDA_STATUS, ArmStatus, ImagePair, Inbox, read_arm_status
from tog_drake.values import Array, Intrinsics

INDEX = "views.json"
MAX_VIEWS = 200
STILL = 0.01  # [rad/s] an arm that is held by hand is not quieter
_WAIT = 5.0  # [s] for a status and an image of after the key was pressed


def load_views(
    folder: Path, board: Board, camera: Intrinsics
) -> tuple[list[Sight], Intrinsics, list[str]]:
    """Returns what the images of a folder show, by which intrinsics, and which show too little.

    Raises:
        InputError: a file is missing or senseless.
    """
    index = folder / INDEX
    content = read_json(index)
    listed = content.get("views") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not 0 < len(listed) <= MAX_VIEWS:
        raise InputError(f'{index} must hold {{"views": [1 to {MAX_VIEWS} of them]}}')
    if "intrinsics" in content:
        camera = load_intrinsics(index)
    sights, blind = [], []
    for view in listed:
        name, q = _checked(index, view)
        sight = see_board(name, read_color(folder / name), q, board, camera)
        if sight is None:
            blind.append(name)
        else:
            sights.append(sight)
    return sights, camera, blind


def _checked(index: Path, view: object) -> tuple[str, Array]:
    name, q = (view.get("image"), view.get("q")) if isinstance(view, dict) else (None, None)
    if not isinstance(name, str) or not name or Path(name).name != name:
        raise InputError(f"{index}: a view's image must be the name of a file beside it")
    try:
        angles = np.array(q, dtype=float)
    except (TypeError, ValueError):
        angles = np.zeros(0)
    if angles.shape != (7,) or not (np.abs(angles) < 2 * math.pi).all():
        raise InputError(f"{index}: the q of {name} must be the seven joint angles in radians")
    return name, angles


def save_views(folder: Path, camera: Intrinsics, taken: list[tuple[np.ndarray, Array]]) -> None:
    """Writes images (H, W, 3) and postures (7,) [rad], as ``load_views`` reads them."""
    views = []
    for number, (rgb, q) in enumerate(taken, 1):
        name = f"{number:02}.png"
        write_atomically(folder / name, encode_png(rgb))
        views.append({"image": name, "q": q.tolist()})
    content = {"intrinsics": asdict(camera), "views": views}
    write_atomically(folder / INDEX, json.dumps(content, indent=1) + "\n")


def take_views(
    lcm: DrakeLcm,
    feed: Feed,
    board: Board,
    ask: Callable[[str], str],
    tell: Callable[[str], None],
) -> list[tuple[np.ndarray, Array]]:
    """Takes views while a person moves the arm by hand: one for each Enter, until `d`.

    Nothing is ever commanded.

    Args:
        lcm: where the arm's driver speaks.
        feed: the camera.
        board: what is looked at.
        ask: shows a question, returns the answer (``input``).
        tell: shows a line.

    Raises:
        InputError: the camera's images have another size than its intrinsics.
    """
    arm = Inbox(lcm, PANDA_STATUS, read_arm_status)
    taken: list[tuple[np.ndarray, Array]] = []
    while len(taken) < MAX_VIEWS:
        answer = ask(f"view {len(taken) + 1}: move the arm, let it rest, press Enter (d: done) ")
        if answer.strip().lower() in ("d", "done"):
            break
        found = _now(lcm, arm, feed)
        if isinstance(found, str):
            tell(f"not taken: {found}")
            continue
        status, images = found
        sight = see_board("the image", images.rgb, status.q, board, feed.intrinsics)
        if sight is None:
            tell("not taken: too little of the board is seen; show all of it, in good light")
            continue
        taken.append((images.rgb, status.q))
        tell(f"taken: {len(sight.pixel)} corners, {np.linalg.norm(sight.X_CT[:3, 3]):.2f} m away")
    return taken


def _now(lcm: DrakeLcm, arm: Inbox[ArmStatus], feed: Feed) -> tuple[ArmStatus, ImagePair] | str:
    """A status and an image of after now, the arm at rest; else what is missing."""
    pressed, end = time.time(), time.monotonic() + _WAIT
    while time.monotonic() < end:
        lcm.HandleSubscriptions(10)
        images, status = feed.newest(), arm.newest
        if images is None or images.utime / 1e6 < pressed:
            continue
        if status is not None and status.utime / 1e6 >= pressed:
            if np.abs(status.v).max() > STILL:
                return f"the arm moves, {np.abs(status.v).max():.3f} rad/s; let it rest"
            return status, images
    if arm.newest is None or arm.age() > _WAIT:
        return f"no {PANDA_STATUS} from the arm's driver in {_WAIT:g} s; is it running?"
    return f"no image in {_WAIT:g} s; is the camera running? {feed.problem()}"
