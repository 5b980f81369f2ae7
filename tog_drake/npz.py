"""Reading an NPZ file that others have written: every size is checked before what it is of."""

import math
import zipfile
from pathlib import Path
from typing import IO, Any, Literal, TypeAlias

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

MAX_ENTRIES = 100  # arrays in a file

AnyArray: TypeAlias = NDArray[Any]


class BadNpz(ValueError):
    """What is wrong with an NPZ file, and what would be valid; the caller names the file."""


def read_npz(path: Path, *, max_array_bytes: int, valid: str) -> dict[str, AnyArray | None]:
    """Returns the arrays of an NPZ file by name; None stands for pickled objects, never loaded.

    Args:
        path: the file.
        max_array_bytes: of each array, unpacked.
        valid: what such an array may be, for the message.

    Raises:
        BadNpz: it is no such file, or not whole, or holds too much or other than numbers and text.
    """
    arrays: dict[str, AnyArray | None] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > MAX_ENTRIES:
                raise BadNpz(f"it holds {len(entries)} files; valid: at most {MAX_ENTRIES}")
            for entry in entries:
                name = entry.filename.removesuffix(".npy")[:40]
                with archive.open(entry) as stream:
                    arrays[name] = _read_array(stream, name, max_array_bytes, valid)
    except BadNpz:
        raise
    except Exception as error:  # of zipfile, of what it unpacks with, of NumPy's header
        raise BadNpz(f"it is no sound NPZ file ({error})") from error
    return arrays


def _read_array(stream: IO[bytes], name: str, max_bytes: int, valid: str) -> AnyArray | None:
    if npy.read_magic(stream) != (1, 0):  # what NumPy writes unless the header is beyond 64 kB
        raise BadNpz(f"{name!r} is no array of NPY version 1.0")
    shape, fortran_order, dtype = npy.read_array_header_1_0(stream)
    if dtype.hasobject:
        return None
    size = math.prod(shape) * dtype.itemsize
    if dtype.kind not in "fiuU" or min(shape, default=0) < 0 or size > max_bytes:
        raise BadNpz(f"{name!r} is an array of shape {shape} of {dtype!s:.20}; valid: {valid}")
    data = stream.read(size)
    if len(data) != size:
        raise BadNpz(f"{name!r} is cut short: {len(data)} of {size} bytes")
    order: Literal["F", "C"] = "F" if fortran_order else "C"
    return np.frombuffer(data, dtype).reshape(shape, order=order)
