"""The protocol ``tog_drake/propose/1``: how a proposer on another machine is asked for grasps.

The request is a POST of JSON. W is the world, z up, [m]; C the camera: x right, y down, z forward::

    {"schema": "tog_drake/propose/1",
     "points":  ARRAY of float32 (N, 3),    what stands on the table, in W [m]
     "normals": ARRAY of float32 (N, 3),    of length 1, towards the camera
     "colors":  ARRAY of uint8 (N, 3),      red, green, blue
     "camera": {"width": 1280, "height": 720, "fx": 900.0, "fy": 900.0, "cx": 639.5, "cy": 359.5},
     "X_WC": [[...], [...], [...], [0, 0, 0, 1]],
     "depth": ARRAY of float32 (H, W),      [m] along z of C, 0 is a hole; may be missing
     "rgb":   ARRAY of uint8 (H, W, 3),     may be missing
     "workspace": {"lower": [x, y, z], "upper": [x, y, z], "table_height": 0.0},    in W [m]
     "seed": 0}                             of whatever is random

An ARRAY is ``{"dtype": "float32", "shape": [N, 3], "base64": "..."}``: little-endian, row by row.
The answer is a document (see ``grasp_document``) with the same ``schema``, as JSON; in what frame
and for what gripper is up to the server. It may say who proposed, as ``"proposer": {"name": "mine",
"note": "trained on mugs", "sha256": "of the weights"}``; records keep that. A server of one's own,
whole::

    import base64, json, numpy as np
    from http.server import BaseHTTPRequestHandler, HTTPServer

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            data = base64.b64decode(asked["points"]["base64"])
            points = np.frombuffer(data, "float32").reshape(asked["points"]["shape"])
            poses, scores = my_network(points)    # (N, 4, 4) and (N,)
            answer = {"schema": asked["schema"], "frame": "world", "gripper": "franka_hand",
                      "poses": poses.tolist(), "scores": scores.tolist()}
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(answer).encode())

    HTTPServer(("127.0.0.1", 8001), Handler).serve_forever()

What is wrong is answered with a status of 400 or more and ``{"error": {"message": "..."}}``.
"""

import base64
import binascii
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydrake.perception import BaseField, Fields, PointCloud

from tog_drake.proposers.answered import Answerer, read_answerer
from tog_drake.proposers.grasp_document import (
    MAX_GRASPS,
    BadDocument,
    Document,
    checked_grasps,
    read_document,
)
from tog_drake.values import Array, Grasps, Intrinsics, View, Workspace

SCHEMA = "tog_drake/propose/1"
MAX_POINTS = 1_000_000
MAX_PIXELS = 10_000_000
MAX_SEED = 2**63
_CLOUD = ("points", "normals", "colors")


class BadRequest(ValueError):
    """What came is no request; the message says what is wrong and what would be right."""


@dataclass(frozen=True)
class Request:
    """What a proposer is given."""

    cloud: PointCloud  # in W, with normals and colours
    view: View  # all holes where no image was sent
    workspace: Workspace
    seed: int


def request_body(request: Request, *, images: bool) -> dict[str, Any]:
    """Returns the JSON of a request; ``images``: whether depth and colours of the view are sent."""
    cloud, view = request.cloud, request.view
    body = {
        "schema": SCHEMA,
        "points": _array(cloud.xyzs().T),
        "normals": _array(cloud.normals().T),
        "colors": _array(cloud.rgbs().T),
        "camera": asdict(view.intrinsics),
        "X_WC": view.X_WC.tolist(),
        "workspace": asdict(request.workspace),
        "seed": request.seed,
    }
    if images:
        body |= {"depth": _array(view.depth), "rgb": _array(view.rgb)}
    return body


def read_request(body: Any) -> Request:
    """Returns what the JSON of a request asks for.

    Raises:
        BadRequest: saying what was given and what would be valid.
    """
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        raise BadRequest(f"this is no request of {SCHEMA}; valid: an object with that schema")
    points = _read_array(body, "points", "float32", (None, 3), MAX_POINTS)
    count = len(points)
    normals = _read_array(body, "normals", "float32", (count, 3), MAX_POINTS)
    colors = _read_array(body, "colors", "uint8", (count, 3), MAX_POINTS)
    cloud = PointCloud(count, Fields(BaseField.kXYZs | BaseField.kNormals | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = points.T
    cloud.mutable_normals()[:] = normals.T
    cloud.mutable_rgbs()[:] = colors.T
    seed = body.get("seed", 0)
    if type(seed) is not int or not 0 <= seed < MAX_SEED:
        raise BadRequest(f"seed is {_brief(seed)}; valid: a whole number from 0")
    return Request(cloud, _read_view(body), _read_workspace(body), seed)


def _read_view(body: Mapping[str, Any]) -> View:
    camera = body.get("camera")
    names = Intrinsics.__dataclass_fields__
    if not isinstance(camera, dict) or set(camera) != set(names):
        raise BadRequest(f"camera must be an object with {', '.join(names)}")
    numbers = {name: _read_numbers(camera, name, ()) for name in names}
    height, width = int(numbers["height"]), int(numbers["width"])
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise BadRequest(f"camera: {width}×{height} pixels; valid: at most {MAX_PIXELS} in all")
    if numbers["fx"] <= 0 or numbers["fy"] <= 0:
        raise BadRequest("camera: fx and fy must be above 0")
    focal = (float(numbers[name]) for name in ("fx", "fy", "cx", "cy"))
    rgb, depth = np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32)
    if body.get("rgb") is not None:
        rgb = _read_array(body, "rgb", "uint8", (height, width, 3), MAX_PIXELS)
    if body.get("depth") is not None:
        depth = _read_array(body, "depth", "float32", (height, width), MAX_PIXELS)
    X_WC = _read_numbers(body, "X_WC", (4, 4))
    try:
        checked_grasps(X_WC[None], np.zeros(1), None, None)
    except BadDocument as error:
        raise BadRequest(f"X_WC: {error}") from error
    return View(rgb, depth, Intrinsics(width, height, *focal), X_WC)


def _read_workspace(body: Mapping[str, Any]) -> Workspace:
    given = body.get("workspace")
    if given is None:
        return Workspace()
    if not isinstance(given, dict):
        raise BadRequest("workspace must be an object with lower, upper, table_height")
    lower, upper = _read_numbers(given, "lower", (3,)), _read_numbers(given, "upper", (3,))
    height = float(_read_numbers(given, "table_height", ()))
    if (lower > upper).any():
        raise BadRequest(
            f"workspace: lower {lower.tolist()} is above upper {upper.tolist()}; valid: at most it"
        )
    return Workspace(lower.tolist(), upper.tolist(), height)


def _array(array: Any) -> dict[str, Any]:
    data = np.ascontiguousarray(array)
    text = base64.b64encode(data.astype(data.dtype.newbyteorder("<")).tobytes()).decode()
    return {"dtype": str(data.dtype), "shape": list(data.shape), "base64": text}


def _read_array(
    body: Mapping[str, Any], name: str, dtype: str, shape: tuple[int | None, ...], most: int
) -> "np.ndarray[Any, Any]":
    """The array of that name, all finite; a None in the shape is any length up to ``most``."""
    wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ")"
    valid = f"valid: {{dtype, shape, base64}} of {dtype} {wanted}, finite"
    given = body.get(name)
    sizes = given.get("shape") if isinstance(given, dict) else None
    if not isinstance(given, dict) or given.get("dtype") != dtype or not isinstance(sizes, list):
        raise BadRequest(f"{name} is no array of {dtype}; {valid}")
    if len(sizes) != len(shape) or not all(
        type(size) is int and 0 <= size <= most and wants in (None, size)
        for size, wants in zip(sizes, shape, strict=True)
    ):
        raise BadRequest(f"{name} has the shape {_brief(sizes)}; {valid}, N at most {most}")
    try:
        data = base64.b64decode(given.get("base64", ""), validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise BadRequest(f"{name} is not base64; {valid}") from error
    size = math.prod(sizes) * np.dtype(dtype).itemsize
    if len(data) != size:
        raise BadRequest(f"{name} has {len(data)} bytes, not {size}; {valid}")
    array = np.frombuffer(data, np.dtype(dtype).newbyteorder("<")).reshape(sizes).astype(dtype)
    if not np.isfinite(array).all():
        raise BadRequest(f"{name} is not finite; {valid}")
    return array


def _read_numbers(body: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> Array:
    try:
        given = np.array(body[name])
        if given.dtype.kind not in "iuf" or not _all_numbers(body[name]):
            raise TypeError("texts and truth values are no numbers")
        array = given.astype(np.float64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadRequest(f"{name} is missing or no numbers") from error
    if array.shape != shape or not np.isfinite(array).all():
        raise BadRequest(f"{name} must be finite numbers of shape {shape}, not {array.shape}")
    return array


def _all_numbers(value: Any) -> bool:
    """Whether there are only numbers in a list of lists; of true beside 1.0 NumPy makes 1.0."""
    if isinstance(value, list):
        return all(map(_all_numbers, value))
    return type(value) in (int, float)


def _brief(value: Any) -> str:
    return f"{value!r:.60}" if isinstance(value, str | int | float | list) else "of another kind"


def answer_body(grasps: Grasps, answerer: Answerer) -> dict[str, Any]:
    """Returns the JSON of an answer; of more than ``MAX_GRASPS`` grasps the best."""
    return {
        "schema": SCHEMA,
        "proposer": asdict(answerer),
        "frame": "world",
        "gripper": "G",
        "poses": grasps.X_WG[:MAX_GRASPS].tolist(),
        "scores": grasps.score[:MAX_GRASPS].tolist(),
        "widths": grasps.width[:MAX_GRASPS].tolist(),
        "contacts": grasps.p_WContact[:MAX_GRASPS].tolist(),
    }


def read_answer(body: Any) -> tuple[Document, Answerer | None]:
    """Returns the grasps of an answer, and who proposed them, where it says so.

    Raises:
        BadDocument: saying what was given and what would be valid.
    """
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        schema = _brief(body.get("schema")) if isinstance(body, dict) else "none"
        raise BadDocument(f"its schema is {schema}; valid: {SCHEMA!r}")
    rest = {name: value for name, value in body.items() if name not in ("schema", "proposer")}
    return read_document(rest), read_answerer(body.get("proposer"))
