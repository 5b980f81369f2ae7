"""From the names of published scans to imported objects: download, unpack, import, say whose."""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, Literal

from tog_drake.assets.archive import GZIP, ZIP, extract
from tog_drake.assets.importing import LICENCE, ImportOptions, import_mesh
from tog_drake.assets.library import asset_names, library_dir
from tog_drake.assets.sources import Remote, read_spec
from tog_drake.download import Missing, Wanted, discard, download, recorded_sha256
from tog_drake.errors import InputError
from tog_drake.http_stream import Unreachable

Progress = Callable[[str, int, int | None], None]  # object, bytes so far, of all if that is known
ARCHIVE = Wanted("an archive", (GZIP, ZIP), 300_000_000)  # those of YCB and GSO have 3 to 30 MB
OFFLINE = (
    "Objects that are imported already still work, and archives that are downloaded already are "
    "imported without a network; scans that are on this machine come in by `tog assets add-dir DIR`"
)


@dataclass(frozen=True)
class Fetched:
    """What became of one object."""

    spec: str
    asset: str  # its name in the library
    status: Literal["imported", "present", "failed"]
    message: str = ""  # why it failed
    report: dict[str, Any] | None = None  # of its import


def downloads_dir() -> Path:
    """Returns the folder of downloaded archives, which stay: importing again needs no network."""
    return library_dir() / ".downloads"


def fetch(
    specs: Sequence[str],
    *,
    force: bool = False,
    decompose: bool = False,
    progress: Progress | None = None,
    tell: Callable[[Fetched], None] | None = None,
) -> list[Fetched]:
    """Downloads and imports objects such as ``ycb:048_hammer``; one that fails stops no other.

    Args:
        specs: see ``read_spec``.
        force: downloads and imports also what is there already.
        decompose: cuts convex pieces, which none of the archives holds: seconds to minutes.
        progress: is told of every piece that arrives.
        tell: is told of every object when it is over.

    Raises:
        InputError: something in ``specs`` names no object at all; then nothing is done.
        OSError: the disk does not take it.
    """
    remotes = [read_spec(spec) for spec in dict.fromkeys(specs)]
    present = frozenset() if force else frozenset(asset_names())
    run = _Run(force, decompose, progress)
    done = []
    for remote in remotes:
        if remote.asset in present:
            fetched = Fetched(remote.spec, remote.asset, "present")
        else:
            fetched = run.fetch(remote)
        done.append(fetched)
        if tell is not None:
            tell(fetched)
    return done


@dataclass
class _Run:
    """What the objects of one call have in common."""

    force: bool
    decompose: bool
    progress: Progress | None
    gone: dict[str, str] = field(default_factory=dict)  # collections' hosts without a connection

    def fetch(self, remote: Remote) -> Fetched:
        try:
            archive = downloads_dir() / remote.archive
            report = self._import(remote, archive, self._download(remote, archive))
        except Unreachable as error:
            self.gone[remote.source.title] = error.host
            return Fetched(remote.spec, remote.asset, "failed", f"{error}. {OFFLINE}")
        except InputError as error:
            return Fetched(remote.spec, remote.asset, "failed", str(error))
        return Fetched(remote.spec, remote.asset, "imported", report=report)

    def _download(self, remote: Remote, archive: Path) -> str:
        """Returns the SHA-256 of the archive, which is there then."""
        url, host = remote.url, self.gone.get(remote.source.title)
        if host is not None and (self.force or recorded_sha256(archive) is None):
            raise InputError(f"not tried, because there is no connection to {host}")

        def progress(done: int, total: int | None) -> None:
            if self.progress is not None:
                self.progress(remote.spec, done, total)

        try:
            return download(url, archive, ARCHIVE, force=self.force, progress=progress)
        except Missing as error:
            raise InputError(f"{error}. Names: {remote.source.catalogue}") from error

    def _import(self, remote: Remote, archive: Path, sha256: str) -> dict[str, Any]:
        # By this name the folder is swept up if the process is killed: see importing.sweep.
        prefix = f".{os.getpid()}-"
        with TemporaryDirectory(prefix=prefix, suffix=".tmp", dir=library_dir()) as folder:
            unpacked = Path(folder) / remote.asset
            try:
                extract(archive, unpacked)
            except InputError:
                discard(archive)  # or it would be taken for good the next time
                raise
            mesh = _mesh_in(unpacked, remote)
            (mesh.parent / LICENCE).write_text(remote.licence_text(sha256), encoding="utf-8")
            options = ImportOptions(
                scale=remote.source.scale,
                up=remote.source.up,
                mass=remote.mass,
                decompose=self.decompose,
                source=remote.provenance(sha256),
            )
            return import_mesh(mesh, remote.asset, options)


def _mesh_in(folder: Path, remote: Remote) -> Path:
    """Finds the mesh of an unpacked archive, and brings its textures beside it.

    A mirror may have packed it into another folder: then its name alone must tell.
    """
    expected = PurePosixPath(remote.mesh)
    mesh = folder / expected
    if not mesh.is_file():
        found = sorted(folder.rglob(expected.name))
        if len(found) != 1:
            held = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
            raise InputError(
                f"the archive of {remote.spec} holds {len(found)} files {expected.name}; expected "
                f"{expected}, given {', '.join(held[:8])}"
            )
        mesh = found[0]
    textures = remote.source.textures
    if textures is not None:
        root = mesh.parents[len(expected.parts) - 1]
        for texture in sorted((root / textures).glob("*")):
            if texture.is_file() and not (mesh.parent / texture.name).exists():
                shutil.copyfile(texture, mesh.parent / texture.name)
    return mesh
