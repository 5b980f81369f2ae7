"""Writing a file so that nobody ever sees half of it, asking beforehand whether one can, and
reading one that a person wrote, or telling it from others."""

import hashlib
import os
import secrets
from pathlib import Path
from typing import Any

from tog_drake.errors import InputError

MAX_YAML_BYTES = 1_000_000
_PIECE = 1 << 20  # [byte] that are read at a time


def write_atomically(path: Path, data: bytes | str) -> None:
    """Writes ``data`` to ``path``: afterwards the file is complete, or as it was before.

    The data goes to a hidden file in the same folder, which then takes the name in one step of
    the file system. Whatever interrupts the writing, Ctrl-C included, leaves no hidden file.

    Args:
        path: the file; missing folders above it are made.
        data: text is written as UTF-8.

    Raises:
        OSError: the folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with unfinished.open("xb") as file:
            file.write(data.encode() if isinstance(data, str) else data)
            file.flush()
            os.fsync(file.fileno())  # the rename must not reach the disk before the content
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def check_folder(folder: Path, option: str = "--out") -> None:
    """Refuses a folder that nothing can be written to, before the work instead of after it.

    ``option`` is the one by which it was given.
    """
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"{option} {folder}: {existing} is a file; name a folder")
    if not os.access(existing, os.W_OK):
        raise InputError(
            f"{option} {folder}: {existing} may not be written to; name another folder"
        )


def check_file(file: Path, option: str = "--out", *, suffixes: tuple[str, ...] = ()) -> None:
    """The same for a file; nor is a device such as /dev/stdout replaced by a file.

    ``suffixes`` are those that its name may end in, if not all may: nothing is written that does
    not open.
    """
    if file.is_dir():
        raise InputError(f"{option} {file} is a folder; name a file in it")
    if file.exists() and not file.is_file():
        raise InputError(f"{option} {file} is no ordinary file; name one")
    if suffixes and file.suffix.lower() not in suffixes:
        raise InputError(f"{option} must end in {' or '.join(suffixes)}, not {file}")
    check_folder(file.parent, option)


def read_yaml(file: Path) -> Any:
    """Returns what a YAML file says that a person wrote; whether it makes sense is for the caller.

    Raises:
        InputError: it cannot be read, is too large, or is no YAML. The message says why, and
            leaves it to the caller to say what the file is and what belongs into it.
    """
    import yaml

    try:
        with file.open("rb") as opened:
            data = opened.read(MAX_YAML_BYTES + 1)
        if len(data) > MAX_YAML_BYTES:
            raise InputError(f"it has more than {MAX_YAML_BYTES} bytes")
        return yaml.safe_load(data.decode())
    except RecursionError as error:
        raise InputError("it is nested too deeply") from error
    except (OSError, yaml.YAMLError, ValueError) as error:  # of its bytes, or a date such as 0-0-0
        raise InputError(str(error)) from error


def file_sha256(path: Path) -> str:
    """Returns the SHA-256 of a file's content, in hexadecimal. Raises OSError."""
    total = hashlib.sha256()
    with path.open("rb") as content:
        while piece := content.read(_PIECE):
            total.update(piece)
    return total.hexdigest()
