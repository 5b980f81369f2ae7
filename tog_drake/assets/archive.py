"""Takes an archive apart that comes from elsewhere: nothing of it lands outside its folder.

A .tgz or .zip may name ``../../.bashrc``, an absolute path, a link that leads out and a file that
follows it, a device, the same name twice, or hold a gigabyte of zeros in a megabyte. Only plain
files and folders with plain names are taken, as many and as large as a scanned object may need;
one entry that is anything else and the whole archive is refused.
"""

import gzip
import io
import secrets
import shutil
import stat
import tarfile
import unicodedata
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from tog_drake.errors import InputError
from tog_drake.visible_text import quoted

GZIP = b"\x1f\x8b"
ZIP = b"PK\x03\x04"
_CHUNK = 65_536
_LONGEST_READ = 2**20  # [bytes] at once: no header or directory of a real archive is longer
_MAX_NAME = 500  # characters of a path
_MAX_DEPTH = 12
_BOMB = "it would unpack to far more than its size allows for: a bomb?"
_BY_HAND = "try again later, or unpack it yourself and use `tog assets add-dir DIR`"
_PLAIN = frozenset({tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE})


@dataclass(frozen=True)
class Limits:
    """What an archive may hold. YCB's have some 12 MB in 6 files, Google's some 30 MB in 12."""

    files: int = 2000
    total: int = 10**9  # [bytes] unpacked
    ratio: float = 200.0  # unpacked to packed, beyond a first 10 MB


@dataclass(frozen=True)
class _Entry:
    name: str
    folder: bool
    content: IO[bytes] | None  # None for a folder


def extract(archive: Path, target: Path, limits: Limits | None = None) -> None:
    """Unpacks a .tgz or a .zip, told apart by its first bytes, into a new folder.

    ``target`` appears whole or not at all. Modes, owners and times of the archive are not taken.

    Raises:
        InputError: this is no such archive, it is damaged, or something in it is not acceptable.
        FileExistsError: ``target`` is there already.
        OSError: the disk does not take it.
    """
    if target.exists():
        raise FileExistsError(f"{target} is there already")
    unfinished = target.parent / f".{secrets.token_hex(4)}.tmp"
    try:
        unfinished.mkdir(parents=True)
        _unpack(archive, unfinished, limits or Limits())
        unfinished.rename(target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _unpack(archive: Path, folder: Path, limits: Limits) -> None:
    with archive.open("rb") as file:
        start = file.read(4)
        file.seek(0)
        packed = archive.stat().st_size
        allowed = min(limits.total, max(10**7, int(limits.ratio * packed)))
        if start.startswith(GZIP):
            entries = _tar_entries(file, allowed)
        elif start == ZIP:
            entries = _zip_entries(file)
        else:
            raise InputError(
                f"{archive.name} is neither a .tgz nor a .zip, and cannot be unpacked; {_BY_HAND}"
            )
        try:
            _write(entries, folder, limits.files, allowed)
        except InputError as error:
            raise InputError(f"{archive.name} is not unpacked: {error}; {_BY_HAND}") from error
        except Exception as error:  # readers of damaged archives raise anything
            if isinstance(error, OSError) and error.errno is not None:
                raise  # the disk, not the archive
            raise InputError(
                f"{archive.name} is damaged: {type(error).__name__}: {quoted(str(error))}; "
                f"{_BY_HAND}"
            ) from error


def _write(entries: Iterator[_Entry], folder: Path, files: int, allowed: int) -> None:
    names: dict[str, bool] = {}  # of all paths, folders of files included: whether it is a file
    for count, entry in enumerate(entries, start=1):
        if count > files:
            raise InputError(f"it holds more than {files} files")
        parts = _checked_parts(entry.name)
        if not parts and entry.folder:
            continue  # "./", the archive's own root
        _claim(names, parts, entry)
        path = folder.joinpath(*parts)
        (path if entry.folder else path.parent).mkdir(parents=True, exist_ok=True)
        if entry.content is not None:
            allowed -= _copy(entry.content, path, allowed)


def _copy(content: IO[bytes], path: Path, allowed: int) -> int:
    """Writes a file; returns its size [bytes]. Believes nothing that the archive says of it."""
    size = 0
    with path.open("xb") as file:
        while chunk := content.read(_CHUNK):
            size += len(chunk)
            if size > allowed:
                raise InputError(_BOMB)
            file.write(chunk)
    return size


def _checked_parts(name: str) -> tuple[str, ...]:
    """Returns the parts of a plain relative path; raises InputError where it is none."""
    shown = quoted(name)
    if name.startswith("/") or "\\" in name or name[1:2] == ":":
        raise InputError(f"the path {shown} in it is not relative, or not a plain one")
    parts = tuple(part for part in name.split("/") if part not in ("", "."))
    if ".." in parts:
        raise InputError(f"the path {shown} in it leads out of its folder")
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
        raise InputError(f"the path {shown} in it has control characters or broken ones")
    long = len(name) > _MAX_NAME or len(parts) > _MAX_DEPTH
    if long or any(len(part.encode()) > 200 for part in parts):
        raise InputError(f"the path {shown} in it is too long")
    return parts


def _claim(names: dict[str, bool], parts: tuple[str, ...], entry: _Entry) -> None:
    """Notes the path and its folders; raises InputError where two would be the same file.

    Also where a file system that ignores case, or how an accent is written, would take them so.
    """
    if not parts:
        raise InputError("it holds a file without a name")
    path = ""
    for depth, part in enumerate(parts, start=1):
        path += "/" + unicodedata.normalize("NFC", part).casefold()
        is_file = depth == len(parts) and not entry.folder
        if path in names and (is_file or names[path]):
            raise InputError(f"the path {quoted(entry.name)} is in it twice")
        names[path] = is_file


class _Careful(io.RawIOBase):
    """A file that never gives more than ``_LONGEST_READ`` bytes at once.

    The readers of tar and zip ask for a header or a directory of whatever length it claims to
    have, at once. Here that ends before the memory does.

    Args:
        file: what is read.
        end: where reading ends [bytes]; then nothing goes back either, which would unpack a .tgz
            again each time. None: the file ends by itself, and may be read in any order.
    """

    def __init__(self, file: IO[bytes] | gzip.GzipFile, end: int | None = None):
        self._file = file
        self._end = end

    def read(self, size: int | None = -1) -> bytes:
        limit = _LONGEST_READ + 1 if size is None or size < 0 else size
        data = self._file.read(min(limit, _LONGEST_READ + 1))
        if len(data) > _LONGEST_READ:
            raise InputError("a header or directory in it is longer than any that is needed")
        if self._end is not None and self._file.tell() > self._end:
            raise InputError(_BOMB)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        first = 0 if self._end is None else self._file.tell()
        if whence == io.SEEK_SET and offset < first:
            raise InputError("its entries overlap")
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True


def _tar_entries(file: IO[bytes], allowed: int) -> Iterator[_Entry]:
    with gzip.open(file) as unpacked:
        reader = _Careful(unpacked, end=allowed + _LONGEST_READ)
        with tarfile.open(fileobj=reader, mode="r:", errorlevel=2) as tar:
            while (member := tar.next()) is not None:
                if member.type not in _PLAIN:
                    raise InputError(f"{quoted(member.name)} in it is a link, a device or the like")
                content = None if member.isdir() else tar.extractfile(member)
                yield _Entry(member.name, member.isdir(), content)
        while reader.read(_CHUNK):  # to its end, where its checksum is
            pass


def _zip_entries(file: IO[bytes]) -> Iterator[_Entry]:
    with zipfile.ZipFile(_Careful(file)) as archive:
        for member in archive.infolist():
            name = member.orig_filename  # the other one ends at a NUL
            mode = member.external_attr >> 16
            if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise InputError(f"{quoted(name)} in it is a link, a device or the like")
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise InputError(f"{quoted(name)} in it is packed in a way that is not read here")
            if name.endswith("/"):
                yield _Entry(name, True, None)
            else:
                with archive.open(member) as content:
                    yield _Entry(name, False, content)
