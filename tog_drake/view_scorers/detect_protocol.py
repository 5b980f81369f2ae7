"""The protocol ``tog_drake/detect/1``: how a detector on another machine is asked for boxes.

The request is a POST of JSON, one for each view::

    {"schema": "tog_drake/detect/1",
     "image": "...",            a PNG of the view, in base64
     "labels": ["red mug"]}     what is looked for

The answer is JSON, too; one entry of each list for every box, at most ``MAX_BOXES``::

    {"schema": "tog_drake/detect/1",
     "boxes": [[u0, v0, u1, v1], ...],    [pixel] of the image that was sent; u right, v down
     "labels": ["red mug", ...],          boxes of other labels do not count
     "scores": [0.83, ...]}               confidences, from 0 to 1

A server of one's own, whole::

    import base64, io, json
    from http.server import BaseHTTPRequestHandler, HTTPServer
    from PIL import Image

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            image = Image.open(io.BytesIO(base64.b64decode(asked["image"])))
            boxes, labels, scores = my_detector(image, asked["labels"])    # lists
            answer = {"schema": asked["schema"],
                      "boxes": boxes, "labels": labels, "scores": scores}
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps(answer).encode())

    HTTPServer(("127.0.0.1", 8002), Handler).serve_forever()

What is wrong is answered with a status of 400 or more and ``{"error": {"message": "..."}}``.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tog_drake.drawing import encode_png
from tog_drake.view_scorers.detections import Box, Detection
from tog_drake.visible_text import quoted

SCHEMA = "tog_drake/detect/1"
MAX_BOXES = 1000
MAX_LABEL = 200  # characters
FARTHEST = 1e6  # [pixel] from the corner of the image; what is farther was not given in pixels


class BadAnswer(ValueError):
    """What a server sent is no answer; the message says what is wrong and what would be right."""


def request_body(image: NDArray[np.uint8], labels: Sequence[str]) -> dict[str, Any]:
    """Returns the JSON of a request for boxes in an image (H, W, 3) RGB."""
    png = base64.b64encode(encode_png(image)).decode()
    return {"schema": SCHEMA, "image": png, "labels": list(labels)}


def read_answer(body: Any) -> list[Detection]:
    """Returns the boxes of an answer.

    Raises:
        BadAnswer: saying what was given and what would be valid.
    """
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        given = body.get("schema") if isinstance(body, dict) else None
        schema = quoted(given, 60) if isinstance(given, str) else "none"
        raise BadAnswer(f"its schema is {schema}; valid: {SCHEMA!r}")
    boxes, labels, scores = (_list(body, name) for name in ("boxes", "labels", "scores"))
    if not len(boxes) == len(labels) == len(scores):
        raise BadAnswer(
            f"{len(boxes)} boxes, {len(labels)} labels and {len(scores)} scores; valid: as many of "
            "each"
        )
    return [
        Detection(_label(label, i), _box(box, i), _score(score, i))
        for i, (box, label, score) in enumerate(zip(boxes, labels, scores, strict=True))
    ]


def _list(body: Mapping[str, Any], name: str) -> list[Any]:
    given = body.get(name)
    if not isinstance(given, list):
        raise BadAnswer(f"{name} is missing or no list")
    if len(given) > MAX_BOXES:
        raise BadAnswer(f"{len(given)} {name}; valid: at most {MAX_BOXES}")
    return given


def _label(given: Any, i: int) -> str:
    if not isinstance(given, str) or len(given) > MAX_LABEL:
        raise BadAnswer(f"labels[{i}] is no text of at most {MAX_LABEL} characters")
    return given


def _box(given: Any, i: int) -> Box:
    numbers = [_number(edge) for edge in given] if isinstance(given, list) else []
    if len(numbers) == 4:
        u0, v0, u1, v1 = numbers
        if u0 <= u1 and v0 <= v1 and max(map(abs, numbers)) <= FARTHEST:
            return u0, v0, u1, v1
    raise BadAnswer(
        f"boxes[{i}] is no box; valid: [u0, v0, u1, v1] in pixels, u0 at most u1, v0 at most v1"
    )


def _score(given: Any, i: int) -> float:
    score = _number(given)
    if not 0.0 <= score <= 1.0:
        raise BadAnswer(f"scores[{i}] is no number from 0 to 1")
    return score


def _number(given: Any) -> float:
    """A number of JSON, NaN for anything else; the length of a whole number is not bounded."""
    try:
        return float(given) if type(given) in (int, float) else math.nan
    except OverflowError:
        return math.nan
