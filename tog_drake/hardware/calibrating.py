"""``tog hardware calibrate``: from views to a mount in the scenario's file."""

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.cameras import drake_config
from tog_drake.errors import InputError
from tog_drake.files import check_file, check_folder, write_atomically
from tog_drake.hardware.calibration import Board, Calibration, apart, calibrate
from tog_drake.hardware.calibration_views import load_views, save_views, take_views
from tog_drake.hardware.config import HardwareConfig
from tog_drake.hardware.mount import mount_of, with_mount
from tog_drake.scenario import Scenario, load_scenario
from tog_drake.stations.lcm_bus import make_lcm
from tog_drake.stations.lcm_camera import scenario_intrinsics

_PER_METRE = 12000.0  # [pixel] of a board to print: 305 to the inch ...
_MOST_PIXELS = 10000  # ... as long as no side of it has more


def parse_board(squares: str, square: float, marker: float, dictionary: str) -> Board:
    """Returns the board of these options. Raises InputError: there is none."""
    size = re.fullmatch(r"(\d{1,3})x(\d{1,3})", squares)
    if size is None:
        raise InputError(f"--board {squares!r} must be COLUMNSxROWS of squares, such as 7x5")
    board = Board(int(size[1]), int(size[2]), square, marker, dictionary)
    board.made()
    return board


def board_png(board: Board) -> bytes:
    """Returns a PNG file of the board: printed without scaling, it is as large as ``board`` says.

    The image ends where the squares do, and tells its resolution.
    """
    from PIL import Image

    pixels = min(round(_PER_METRE * board.square), _MOST_PIXELS // max(board.columns, board.rows))
    size = board.columns * pixels, board.rows * pixels
    image = Image.fromarray(board.made().generateImage(size))
    file = io.BytesIO()
    inch = 0.0254  # [m]
    image.save(file, "PNG", dpi=2 * (pixels / board.square * inch,))
    return file.getvalue()


def calibrate_camera(
    scenario: str,
    views: Path,
    board: Board,
    *,
    camera: str,
    out: Path | None,
    live: bool,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Calibrates, tells how well, and writes the mount; returns what was found, for JSON.

    Raises:
        InputError: of the scenario, the views, or where the mount cannot be written to.
    """
    file = Path(scenario)
    if not file.is_file():
        raise InputError(f"--scenario {scenario} is no file: copy a scenario and name the copy")
    target = out or file
    check_file(target)
    loaded = load_scenario(scenario)
    before = mount_of(loaded, camera)
    text = file.read_bytes().decode()
    with_mount(text, scenario, camera, before)  # whether it can be written is said at once
    if live:
        _take(loaded, camera, views, board, tell)
    setup = scenario_intrinsics(drake_config(loaded.cameras[camera]))
    sights, intrinsics, blind = load_views(views, board, setup)
    for name in blind:
        tell(f"{name}: too little of the board is seen; left out")
    found = calibrate(sights, intrinsics)
    for line in described(found, before):
        tell(line)
    write_atomically(target, with_mount(text, scenario, camera, found.X_HC))
    tell(f"written: {target}")
    return _for_json(found, blind)


def _take(
    scenario: Scenario, camera: str, views: Path, board: Board, tell: Callable[[str], None]
) -> None:
    hardware = scenario.hardware or HardwareConfig()
    if camera not in hardware.cameras:
        raise InputError(
            f"hardware.cameras has no {camera!r}; valid: {', '.join(hardware.cameras)}"
        )
    if views.exists() and any(views.iterdir()):
        raise InputError(f"--views {views} is not empty; name a new folder for the views of --live")
    check_folder(views, "--views")
    lcm = make_lcm(hardware.lcm_url)
    feed = hardware.cameras[camera].open(lcm, drake_config(scenario.cameras[camera]))
    try:
        taken = take_views(lcm, feed, board, input, tell)
    finally:
        feed.close()
    if not taken:
        raise InputError("no view was taken; press Enter at each posture, 12 to 15 of them")
    save_views(views, feed.intrinsics, taken)
    tell(f"views: {views}")


def described(found: Calibration, before: np.ndarray) -> list[str]:
    """Lines for a person: each view's error, how sure the mount is, how far it moved."""
    lines = [
        f"{name}: {error:.2f} pixels; without it the mount moves "
        f"{1e3 * found.left_out[name][0]:.2f} mm, {np.degrees(found.left_out[name][1]):.3f} deg"
        for name, error in found.error.items()
    ]
    moved, turned = found.uncertainty
    shift, turn = apart(found.X_HC, before)
    place = ", ".join(f"{1e3 * x:.1f}" for x in found.X_HC[:3, 3])
    return [
        *lines,
        f"camera at ({place}) mm of the hand, {found.rms:.2f} pixels rms over {len(lines)} views; "
        f"standard error by leaving one out: {1e3 * moved:.2f} mm, {np.degrees(turned):.3f} deg",
        f"{1e3 * shift:.1f} mm and {np.degrees(turn):.2f} deg from the mount of before",
    ]


def _for_json(found: Calibration, blind: list[str]) -> dict[str, Any]:
    return {
        "X_HC": found.X_HC.tolist(),
        "error": found.error,
        "left_out": found.left_out,
        "rms": found.rms,
        "uncertainty": found.uncertainty,
        "not_used": blind,
    }
