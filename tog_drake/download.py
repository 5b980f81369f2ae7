"""One large file from a server that may be far, slow, overloaded or none at all.

The file arrives under the name ``<file>.part`` and takes its own when it is complete; what was cut
off goes on where it ended, if the server still has the same file. Beside it stands its SHA-256, and
each later use asks whether it is still that.
"""

import fcntl
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tog_drake.errors import InputError
from tog_drake.files import file_sha256, write_atomically
from tog_drake.http_stream import Again, ask
from tog_drake.visible_text import quoted

if TYPE_CHECKING:
    from requests import Response

ATTEMPTS = 5
FIRST_DELAY = 0.5  # [s] doubled each time
LONGEST_WAIT = 60.0  # [s] that a server may ask for
RETRYABLE = frozenset({408, 425, 429, 500, 502, 503, 504})

Progress = Callable[[int, int | None], None]  # bytes so far, and of all where that is known


class Missing(InputError):
    """The server has no such file."""


@dataclass(frozen=True)
class Wanted:
    """What kind of file is asked for: whatever else comes is not kept."""

    what: str  # such as "an archive"
    starts: tuple[bytes, ...]  # it begins with one of these
    limit: int  # greatest size [bytes]
    check: Callable[[Path], None] = lambda part: None  # raises InputError unless it is the one


def download(
    url: str,
    file: Path,
    wanted: Wanted,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> str:
    """Brings the file at ``url`` to ``file``, unless it is there; returns its SHA-256.

    Args:
        url: redirects are followed to https alone, or on this machine.
        file: appears complete or not at all, as does what replaces it.
        wanted: what to take it for.
        force: downloads also what is there already.
        progress: is told of every piece.

    Raises:
        Unreachable: there is no connection.
        Missing: there is no such file.
        InputError: the server sends something else or not all of it, or the file on this machine
            is no longer what was downloaded.
        OSError: the disk does not take it.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with _alone_in(file.parent):
        recorded = None if force else recorded_sha256(file)
        if recorded is not None:
            return _verified(file, recorded)
        part = _beside(file, ".part")
        _fill(part, url, wanted, progress)
        _check_kind(part, url, wanted)
        return _keep(part, file)


def recorded_sha256(file: Path) -> str | None:
    """Returns the SHA-256 with which a file was downloaded; None where it was not."""
    try:
        record = _beside(file, ".sha256").read_text(encoding="ascii")[:100]
    except (OSError, ValueError):
        return None
    digest = record.partition(" ")[0]
    return digest if file.is_file() and re.fullmatch("[0-9a-f]{64}", digest) else None


def discard(file: Path) -> None:
    """Deletes a downloaded file, and what is recorded of it."""
    _beside(file, ".sha256").unlink(missing_ok=True)
    file.unlink(missing_ok=True)


def _beside(file: Path, suffix: str) -> Path:
    return file.with_name(file.name + suffix)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Waits until no other process downloads to the folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _verified(file: Path, recorded: str) -> str:
    if file_sha256(file) != recorded:
        raise InputError(
            f"{file} is no longer what was downloaded (its SHA-256 is another): --force downloads "
            "it again"
        )
    return recorded


def _keep(part: Path, file: Path) -> str:
    """Gives a complete file its name. A file without a record counts as none, at every moment."""
    digest = file_sha256(part)
    _beside(file, ".sha256").unlink(missing_ok=True)
    part.replace(file)
    write_atomically(_beside(file, ".sha256"), f"{digest}  {file.name}\n")
    _forget(part)
    return digest


def _check_kind(part: Path, url: str, wanted: Wanted) -> None:
    try:
        with part.open("rb") as content:
            start = content.read(1000)
        if not start.startswith(wanted.starts):
            said = quoted(start.decode("utf-8", "replace"))
            raise InputError(
                f"{url} answers with something else than {wanted.what}: {said}. Does this network "
                "want a login first?"
            )
        wanted.check(part)
    except InputError:
        _forget(part)
        raise


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _beside(part, ".json").unlink(missing_ok=True)


def _fill(part: Path, url: str, wanted: Wanted, progress: Progress | None) -> None:
    """Downloads to ``part``, trying again where that may help."""
    for attempt in range(ATTEMPTS):
        try:
            _attempt(part, url, wanted, progress)
            return
        except Again as again:
            failure, asked = again.failure, again.delay
        if asked is not None and asked > LONGEST_WAIT:
            raise InputError(f"{failure}; it asks to be left alone for {asked:.0f} s")
        if attempt < ATTEMPTS - 1:
            time.sleep(FIRST_DELAY * 2**attempt if asked is None else asked)
    raise failure


def _attempt(part: Path, url: str, wanted: Wanted, progress: Progress | None) -> None:
    start, validator = _begun(part, url)
    headers = {"Accept-Encoding": "identity"}
    if start:
        headers |= {"Range": f"bytes={start}-", "If-Range": validator}
    response, arriving = ask(url, headers)
    with closing(arriving):
        _check_status(response, url, part)
        done, total = _extent(response, url, part, start)
        _check_size(total or 0, url, part, wanted)
        if not done:
            _begin(part, url, response)
        with part.open("r+b" if done else "wb") as file:
            file.seek(done)
            for chunk in arriving:
                done += len(chunk)
                _check_size(done, url, part, wanted)
                file.write(chunk)
                if progress is not None:
                    progress(done, total)
            file.flush()
            os.fsync(file.fileno())
    if total is not None and done != total:
        raise Again(InputError(f"{url}: only {done} of {total} bytes arrived"))


def _begun(part: Path, url: str) -> tuple[int, str]:
    """How many bytes of the same file are there [bytes], and what tells that it is the same."""
    try:
        begun = json.loads(_beside(part, ".json").read_text(encoding="utf-8")[:10_000])
        if begun["url"] == url and isinstance(begun["validator"], str):
            return part.stat().st_size, begun["validator"]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        pass
    return 0, ""


def _begin(part: Path, url: str, response: "Response") -> None:
    """Notes by what to recognise the file. Without that, a rest could be one of another file."""
    _forget(part)
    tag = response.headers.get("ETag", "")
    validator = tag if tag.startswith('"') else response.headers.get("Last-Modified", "")
    if validator:
        note = json.dumps({"url": url, "validator": validator})
        write_atomically(_beside(part, ".json"), note)


def _check_status(response: "Response", url: str, part: Path) -> None:
    code = response.status_code
    if code in (200, 206):
        return
    if code == 416:
        _forget(part)
        raise Again(InputError(f"{url}: the server does not give the rest of what was cut off"))
    message = f"{url}: the server answers with status {code}"
    if code in RETRYABLE:
        raise Again(InputError(message), _asked_delay(response))
    if code in (403, 404, 410):  # 403 is what S3 says of what it does not have
        raise Missing(f"{message}: it has no such file")
    raise InputError(message)


def _asked_delay(response: "Response") -> float | None:
    """How long the server wants to be left alone [s], where it says so in seconds."""
    asked = response.headers.get("Retry-After", "").strip()
    return float(asked) if re.fullmatch("[0-9]{1,9}", asked) else None


def _extent(response: "Response", url: str, part: Path, start: int) -> tuple[int, int | None]:
    """Where the answer begins and how long the file is [bytes]; None where that is not told."""
    if response.status_code == 200:
        length = response.headers.get("Content-Length", "")
        return 0, int(length) if re.fullmatch("[0-9]{1,18}", length) else None
    told = response.headers.get("Content-Range", "")
    match = re.fullmatch("bytes ([0-9]{1,18})-([0-9]{1,18})/([0-9]{1,18})", told)
    first, last, total = map(int, match.groups()) if match else (-1, -1, -1)
    if first != start or last != total - 1:
        _forget(part)
        raise Again(InputError(f"{url}: the server answers with the wrong part of the file"))
    return start, total


def _check_size(size: int, url: str, part: Path, wanted: Wanted) -> None:
    if size > wanted.limit:
        _forget(part)
        raise InputError(f"{url} has more than {wanted.limit} bytes: too many for {wanted.what}")
