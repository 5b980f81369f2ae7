"""Reads a colour-and-depth view from files, checking everything, and writes one."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tog_drake.drawing import encode_png
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.values import Array, Intrinsics, View

_INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
MAX_PIXELS = 50_000_000
MAX_FILE_BYTES = 500_000_000
MAX_JSON_BYTES = 1_000_000
_PLAUSIBLE_RANGE = (0.05, 10.0)  # [m] of the median depth; outside, the scale is wrong
_PNG_UNITS_PER_METRE = 1000.0  # what depth cameras write to 16-bit files, if nobody says else


def load_view(
    rgb: Path, depth: Path, intrinsics: Path, *, units_per_metre: float | None = None
) -> View:
    """Reads a view whose camera pose is not known; its ``X_WC`` is the identity.

    Args:
        rgb: 8-bit colour image (PNG, JPEG ...).
        depth: 16-bit PNG, or float32 or float64 NPY or TIFF, of the same size and aligned to the
            colour image; 0, NaN and inf are holes.
        intrinsics: JSON ``{fx, fy, cx, cy, width, height}`` [pixel].
        units_per_metre: of the depth values; by default 1000 for whole numbers, 1 for others.

    Raises:
        InputError: saying which file is unusable and why.
    """
    color = read_color(rgb)
    metres = _read_depth(depth, units_per_metre)
    if color.shape[:2] != metres.shape:
        raise InputError(
            f"colour and depth differ in size: {rgb} is {_size(color)}, {depth} is "
            f"{_size(metres)}; they must be aligned, pixel by pixel"
        )
    camera = load_intrinsics(intrinsics)
    if (camera.height, camera.width) != metres.shape:
        raise InputError(
            f"the intrinsics {intrinsics} are for {camera.width}×{camera.height} pixels, but the "
            f"images are {_size(metres)}"
        )
    return View(color, metres, camera, np.eye(4))


def save_view(folder: Path, view: View) -> None:
    """Writes a view as the others here read it: ``color.png``, ``depth.png``, ``camera.json``,
    ``pose.json``.

    The depth has whole millimetres, and holes where it is beyond 65 m. Each file is written whole
    or not at all.
    """
    import cv2

    units = np.round(_PNG_UNITS_PER_METRE * view.depth)
    depth = np.where(units <= np.iinfo(np.uint16).max, units, 0).astype(np.uint16)
    write_atomically(folder / "color.png", encode_png(view.rgb))
    write_atomically(folder / "depth.png", cv2.imencode(".png", depth)[1].tobytes())
    write_atomically(folder / "camera.json", json.dumps(asdict(view.intrinsics), indent=1) + "\n")
    write_atomically(folder / "pose.json", json.dumps({"X_WC": view.X_WC.tolist()}) + "\n")


def load_intrinsics(path: Path) -> Intrinsics:
    """Reads a camera's intrinsics; they may also lie under a key "intrinsics".

    Raises:
        InputError: if a number is missing or makes no sense.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold a JSON object with fx, fy, cx, cy, width, height")
    inner = content.get("intrinsics")
    if isinstance(inner, dict):
        content = {**content, **inner}
    numbers = {key: _pixels(path, content, key) for key in _INTRINSICS}
    width, height = int(numbers["width"]), int(numbers["height"])
    if width <= 0 or height <= 0 or width != numbers["width"] or height != numbers["height"]:
        raise InputError(f"{path}: width and height must be whole numbers above 0")
    for key, size in (("fx", width), ("fy", height)):
        if not 0.1 * size < numbers[key] < 50 * size:
            raise InputError(
                f"{path}: {key} = {numbers[key]:g} pixels makes no camera of {width}×{height} "
                "(it is the focal length in pixels, usually 0.5 to 3 times the image's width)"
            )
    for key, size in (("cx", width), ("cy", height)):
        if not 0 <= numbers[key] <= size:
            raise InputError(f"{path}: {key} = {numbers[key]:g} lies outside the image (0..{size})")
    return Intrinsics(width, height, *(numbers[key] for key in ("fx", "fy", "cx", "cy")))


def _pixels(path: Path, content: dict[str, Any], key: str) -> float:
    value = content.get(key)
    try:
        if not isinstance(value, bool) and math.isfinite(number := float(value)):  # type: ignore[arg-type]
            return number
    except (TypeError, ValueError, OverflowError):
        pass
    raise InputError(f"{path}: {key} must be a number of pixels, not {value!r:.40}")


def load_pose(path: Path) -> Array:
    """Reads a camera pose X_WC: JSON rows of a 4×4 matrix, bare or under "X_WC".

    Raises:
        InputError: if it is no rigid transform.
    """
    content = read_json(path)
    rows = content.get("X_WC") if isinstance(content, dict) else content
    try:
        X = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path} holds no 4×4 matrix of numbers; valid: X_WC as four rows of four"
        ) from error
    if X.shape != (4, 4) or not np.isfinite(X).all():
        raise InputError(f"{path} must hold a 4×4 matrix of finite numbers, not {X.shape}")
    R = X[:3, :3]
    rigid = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    if not rigid or not np.allclose(X[3], [0, 0, 0, 1]):
        raise InputError(f"{path} is no rigid transform: rotation not orthonormal, or last row off")
    return X


def read_color(path: Path) -> NDArray[np.uint8]:
    """Returns an 8-bit colour image (H, W, 3). Raises InputError: it cannot be used as one."""
    import cv2

    _check_file(path)
    try:
        # As stored: a turn that its EXIF header asks for would part it from the depth image, and
        # 16 bits must not be cut to 8 unseen.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
        image = cv2.imread(str(path), flags)
    except cv2.error as error:
        raise InputError(f"cannot read the colour image {path}: {error.err}") from error
    if image is None:
        raise InputError(f"cannot read {path} as a colour image (PNG or JPEG is expected)")
    if image.dtype != np.uint8:
        raise InputError(f"the colour image {path} must have 8 bits a channel, not {image.dtype}")
    _check_pixels(path, image.shape)
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)


def _read_depth(path: Path, units_per_metre: float | None) -> NDArray[np.float32]:
    import cv2

    _check_file(path)
    if units_per_metre is not None and not 0 < units_per_metre < math.inf:
        raise InputError(f"--depth-scale must be above 0, not {units_per_metre:g}")
    raw: Any
    if path.suffix.lower() == ".npy":
        try:
            raw = np.load(path, allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise InputError(f"cannot read depth {path}: {error}") from error
    else:
        try:
            raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise InputError(f"cannot read depth {path}: {error.err}") from error
    if not isinstance(raw, np.ndarray):  # None, or an archive of arrays under the name of one
        raise InputError(f"cannot read {path} as depth (16-bit PNG, or float32 NPY or TIFF)")
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32, np.float64):
        raise InputError(
            f"depth {path} must have one channel of uint16 or float32, not shape {raw.shape} of "
            f"{raw.dtype}; an 8-bit or colour-coded image has lost its metres"
        )
    _check_pixels(path, raw.shape)
    scale = units_per_metre or (_PNG_UNITS_PER_METRE if raw.dtype == np.uint16 else 1.0)
    metres = raw.astype(np.float64) / scale
    metres[~(np.isfinite(metres) & (metres > 0))] = 0
    valid = metres[metres > 0]
    if valid.size == 0:
        raise InputError(
            f"depth {path} is all holes: no pixel is above 0 and finite; "
            "check the camera, and take the image again"
        )
    median = float(np.median(valid))
    if not _PLAUSIBLE_RANGE[0] < median < _PLAUSIBLE_RANGE[1]:
        raise InputError(
            f"depth {path} has a median of {median:.3g} m at {scale:g} units per metre: "
            "give the right --depth-scale"
        )
    result: NDArray[np.float32] = metres.astype(np.float32)
    return result


def read_json(path: Path) -> Any:
    """Returns what a JSON file says. Raises InputError: it is too large, or no JSON."""
    _check_file(path, MAX_JSON_BYTES)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot read {path} as JSON: {error}") from error


def _check_file(path: Path, limit: int = MAX_FILE_BYTES) -> None:
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    if path.stat().st_size > limit:
        raise InputError(f"{path} has {path.stat().st_size} bytes; at most {limit} are read")


def _check_pixels(path: Path, shape: tuple[int, ...]) -> None:
    if not 0 < shape[0] * shape[1] <= MAX_PIXELS:
        raise InputError(f"{path} has {shape[1]}×{shape[0]} pixels; at most {MAX_PIXELS} are read")


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"
