"""Grasps from a file that another tool has written: JSON or NPZ, see ``grasp_document``.

What ``tog choose`` writes, ``grasps.json``, is read too. A file is read once, when the proposer is
made; pickled objects in it are never loaded, because loading them can run any code.
"""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoGrasp
from tog_drake.npz import BadNpz, read_npz
from tog_drake.proposers.grasp_document import (
    MAX_GRASPS,
    NAMES,
    BadDocument,
    Document,
    HoldNothing,
    grasps_in_world,
    read_document,
)
from tog_drake.values import Grasps, View

MAX_FILE_BYTES = 16_000_000
_MAX_ARRAY_BYTES = 16 * 16 * MAX_GRASPS  # of 16 numbers a grasp, however precise
_CHOSEN = "tog_drake/grasps/1"  # the schema of what ``tog choose`` writes


@dataclass
class File:
    """Grasps from a file: `!File {path: grasps.json}`."""

    path: str = ""  # of a JSON or NPZ file
    frame: str | None = None  # camera | world, where the file does not say it
    gripper: str | None = None  # G | franka_hand | contact_graspnet, where it does not


class FileProposer:
    """Proposes the grasps of a file that hold something of what is seen (a ``Proposer``).

    Raises:
        InputError: the file is missing, too large, or no document; it says what would be right.
    """

    def __init__(self, config: File):
        if not config.path:
            raise InputError("!File lacks its path; valid: !File {path: FILE}, a JSON or NPZ file")
        self._path = Path(config.path)
        try:
            content = _content(self._path)
            self._document = read_document(content, frame=config.frame, gripper=config.gripper)
        except BadDocument as error:
            paste = ""
            if "does not say its" in str(error):
                fields = json.dumps({"path": str(self._path), "frame": "camera", "gripper": "G"})
                paste = f"; such as --scenario-text 'pipeline: {{proposer: !File {fields}}}'"
            raise InputError(f"grasps cannot be read from {self._path}: {error}{paste}") from error

    @property
    def document(self) -> Document:
        """What the file holds."""
        return self._document

    def propose(self, cloud: PointCloud, view: View) -> Grasps:
        """Returns grasps, best first.

        Raises:
            NoGrasp: the file has none, or most of them hold nothing that was seen.
        """
        if len(self._document.scores) == 0:
            raise NoGrasp(f"{self._path} holds no grasps")
        try:
            return grasps_in_world(self._document, cloud, view.X_WC)
        except HoldNothing as error:
            raise NoGrasp(f"no grasps from {self._path}: {error}") from error


def _content(path: Path) -> Mapping[str, Any]:
    """The named arrays and texts of a file, nothing of them checked yet."""
    if not path.is_file():
        raise InputError(f"there is no file of grasps {str(path)!r}; valid: a JSON or NPZ file")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise BadDocument(f"it has {path.stat().st_size} bytes; valid: at most {MAX_FILE_BYTES}")
    if zipfile.is_zipfile(path):
        return _read_npz(path)
    return _read_json(path)


def _read_json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadDocument(f"it is neither JSON nor NPZ ({error})") from error
    if not isinstance(content, dict):
        raise BadDocument(f"it holds a {type(content).__name__}; valid: an object with poses ...")
    if content.get("schema") != _CHOSEN:
        return content
    try:
        rows = content["grasps"]
        poses, scores = [row["X_CG"] for row in rows], [row["score"] for row in rows]
        widths, contacts = [row["width"] for row in rows], [row["contact"] for row in rows]
    except (KeyError, TypeError) as error:
        raise BadDocument(f"a grasp of {_CHOSEN} lacks X_CG, score, width or contact") from error
    arrays = {"poses": poses, "scores": scores, "widths": widths, "contacts": contacts}
    return {**arrays, "frame": "camera", "gripper": "G"}


def _read_npz(path: Path) -> Mapping[str, Any]:
    """The arrays of an NPZ file, none of them larger than it may be."""
    try:
        found = read_npz(
            path,
            max_array_bytes=_MAX_ARRAY_BYTES,
            valid=f"numbers or a text, of at most {MAX_GRASPS} grasps, under one of the names "
            f"{', '.join(NAMES)}",
        )
    except BadNpz as error:
        raise BadDocument(str(error)) from error
    pickled = [name for name, array in found.items() if array is None]
    arrays = {
        name: str(array) if array.dtype.kind == "U" else array
        for name, array in found.items()
        if array is not None
    }
    if pickled and {"poses", "scores"} <= arrays.keys():
        raise BadDocument(
            f"it holds pickled objects beside its poses and scores; valid: it without "
            f"{', '.join(pickled)}"
        )
    if pickled:
        raise BadDocument(_convert(path, pickled))
    return arrays


def _convert(path: Path, pickled: list[str]) -> str:
    """What to do about pickled dictionaries by segment, as Contact-GraspNet writes them."""
    return (
        f"it holds pickled objects ({', '.join(pickled)}), which are not loaded here, because that "
        "can run any code. If you trust who wrote it, convert it, with its own names for A, B, C: "
        f"d = numpy.load({str(path)!r}, allow_pickle=True); "
        "a = lambda name: numpy.concatenate(list(d[name].item().values())); "
        "numpy.savez('grasps.npz', poses=a('A'), scores=a('B'), contacts=a('C'), frame='camera', "
        "gripper='contact_graspnet')"
    )
