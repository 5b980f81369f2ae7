"""Writing a file so that nobody ever sees half of it."""

import os
import secrets
from pathlib import Path


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
