"""A question as it would be sent to a model: its key, and its images by their hash."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.drawing import encode_png
from tog_drake.errors import EpisodeError, InputError
from tog_drake.files import write_atomically
from tog_drake.selectors.vlm.api import Api
from tog_drake.selectors.vlm.question import Image, Message

MAX_IMAGE = 64_000_000  # [byte] of a PNG, and [pixel] in it


def pixel_hash(image: Image) -> str:
    """Returns the SHA-256 of an image's shape and raw RGB pixels, in hex.

    Not of a file: versions of the PNG encoder differ in bytes for the same pixels.
    """
    pixels = np.ascontiguousarray(image, np.uint8)
    return hashlib.sha256(repr(pixels.shape).encode() + pixels.tobytes()).hexdigest()


def image_token(image: Image) -> str:
    """Returns what stands for an image in the body of a recorded question."""
    return f"sha256:{pixel_hash(image)}"


def question_key(provider: str, path: str, body: Any) -> str:
    """Returns the SHA-256 of what is asked, in hex; where it is sent makes no difference.

    Args:
        provider: openai, gemini or anthropic.
        path: of the URL.
        body: of the request, with every image as its ``image_token``.
    """
    asked = {"provider": provider, "path": path, "body": body}
    text = json.dumps(asked, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Request:
    """A question as it would be sent."""

    key: str  # question_key, followed by #2, #3, ... where it is asked again
    api: Api
    message: Message = field(repr=False)
    model: str  # specification, such as "gemini:gemini-3.8-flash"
    profile: str  # name of the profile

    @staticmethod
    def make(api: Api, message: Message, *, model: str, profile: str, repeat: int = 1) -> "Request":
        """Returns the request; ``repeat`` counts how often this very question is asked, from 1."""
        key = question_key(api.provider, api.path(), api.body(message, image_token))
        return Request(key if repeat == 1 else f"{key}#{repeat}", api, message, model, profile)

    @property
    def images(self) -> tuple[Image, ...]:
        return tuple(part for part in self.message.parts if not isinstance(part, str))


class QuestionPending(EpisodeError):
    """Questions that are to be asked elsewhere; the episode goes on when they are answered."""

    outcome = "no_choice"

    def __init__(self, requests: tuple[Request, ...]):
        asked = ", ".join(f"{r.message.prompt or 'question'} {r.key[:12]}" for r in requests)
        super().__init__(f"waiting for the answer to {asked}")
        self.requests = requests


def save_images(folder: Path, request: Request) -> None:
    """Writes the images of a question into a folder, each once, as ``<hex>.png``.

    One that is there but damaged is written anew.
    """
    for image in request.images:
        digest = pixel_hash(image)
        try:
            read_image(folder, digest)
        except InputError:
            write_atomically(folder / f"{digest}.png", encode_png(image))


def read_image(folder: Path, digest: str) -> Image:
    """Returns an image that ``save_images`` wrote; ``digest`` is its hash in hex.

    Raises:
        InputError: it is missing, too large, no PNG, or not the one that ``digest`` names.
    """
    import cv2

    file = folder / f"{digest}.png"
    try:
        with file.open("rb") as opened:
            data = opened.read(MAX_IMAGE + 1)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}") from error
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))  # of the PNG header
    if len(data) > MAX_IMAGE or width * height > MAX_IMAGE:
        raise InputError(f"{file} is larger than {MAX_IMAGE} bytes or pixels, the most for one")
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise InputError(f"{file} is no PNG image")
    image = np.asarray(decoded[..., ::-1], np.uint8)
    if pixel_hash(image) != digest:
        raise InputError(f"{file} does not show what its name says: its pixels were changed")
    return image
