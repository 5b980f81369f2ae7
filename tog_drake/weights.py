"""Where the weights of networks come from, under which licence, and where they are kept here.

None of them comes with the package: they are downloaded when somebody accepts their licence, or
taken from a file. Beside the kept file stands a record: its SHA-256 and where it came from.
"""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tog_drake.download import Missing, Wanted, discard, download
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.http_stream import Unreachable
from tog_drake.urls import official_or_mirror

VARIABLE = "TOG_WEIGHTS"  # environment variable that names another folder
MAX_BYTES = 200_000_000  # of a file of weights; the released one has about 26 MB
TORCH_FILE = b"PK\3\4"  # what torch.save has written since torch 1.6 begins like any ZIP
_MAX_RECORD_BYTES = 10_000

Progress = Callable[[int, int | None], None]  # bytes so far, and of all where that is known


@dataclass(frozen=True)
class Model:
    """A network whose weights were published."""

    name: str  # of the proposer, as the command spells it
    path: str  # of the weights in the folder of weights
    folder: str  # URL of the folder that the released file is in
    variable: str  # environment variable that names a mirror of that folder
    git_sha1: str
    """What git calls the released file: its SHA-1 with a header. No SHA-256 of it is published."""
    licence: str
    terms: str  # what the licence restricts
    licence_text: str  # where it can be read

    @property
    def url(self) -> str:
        """Of the released file, there or on the mirror that the environment names.

        Raises:
            InputError: the mirror's URL is none.
        """
        return f"{official_or_mirror(self.folder, self.variable)}/{Path(self.path).name}"


CONTACT_GRASPNET = Model(
    name="contact-graspnet",
    path="contact_graspnet/model.pt",
    # Of the branch: whatever it holds one day, no other file than that of git_sha1 is taken.
    folder="https://raw.githubusercontent.com/elchun/contact_graspnet_pytorch/main/"
    "checkpoints/contact_graspnet/checkpoints",
    variable="TOG_CGN_URL",
    git_sha1="b52cf0c889511c17acdded2dde8062710299b73e",
    licence="NVIDIA Source Code License (non-commercial)",
    terms="for research and evaluation only, not for commercial use; it is that of the code, and "
    "the weights are taken to be under it too",
    licence_text="https://github.com/NVlabs/contact_graspnet/blob/"
    "f28013a1a9f593fafc7c6dc0ca022b63464800a0/License.pdf",
)
MODELS = {model.name: model for model in (CONTACT_GRASPNET,)}


CHANGED = "no longer what was stored (its SHA-256 is another)"


def which(released: bool) -> str:
    """Returns how a file of weights is called by all who tell of it."""
    return "the released checkpoint" if released else "not the released checkpoint"


@dataclass(frozen=True)
class Stored:
    """Weights that are kept on this machine."""

    model: Model
    file: Path
    size: int  # [bytes]
    sha256: str
    git_sha1: str
    origin: str | None  # URL or file; None: there is no record of it
    changed: bool  # since it was recorded

    @property
    def released(self) -> bool:
        """Whether it is the released file."""
        return self.git_sha1 == self.model.git_sha1

    @property
    def note(self) -> str:
        """What it is, in a few words."""
        return which(self.released) + (f", and {CHANGED}" if self.changed else "")


def weights_dir() -> Path:
    """Returns the folder of stored weights: that of ``TOG_WEIGHTS``, or the platform's cache."""
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given).expanduser().resolve()
    from platformdirs import user_cache_path

    return user_cache_path("tog_drake", appauthor=False) / "weights"


def stored_file(model: Model) -> Path:
    """Returns the file of a model's weights.

    Raises:
        InputError: none are stored; says how to get them.
    """
    file = weights_dir() / model.path
    if not file.is_file():
        raise InputError(
            f"no weights of {model.name} are stored (there is no {file}); `tog weights fetch "
            f"{model.name} --accept-licence` gets them, `tog weights add FILE` stores a file of "
            "yours, --checkpoint FILE uses one once"
        )
    return file


def stored(model: Model) -> Stored | None:
    """Returns what is stored of a model, None where nothing is; the file is read and hashed.

    Raises:
        InputError: the file is far too large for weights.
    """
    file = weights_dir() / model.path
    if not file.is_file():
        return None
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{file} has {size} bytes, too many for weights; delete it")
    data = file.read_bytes()
    digest = sha256(data)
    recorded, origin = _read_record(file)
    changed = recorded is not None and recorded != digest
    return Stored(model, file, len(data), digest, git_sha1(data), origin, changed)


def fetch(
    model: Model, *, accept_licence: bool, force: bool = False, progress: Progress | None = None
) -> Stored:
    """Downloads the released weights, unless they are stored already.

    Args:
        model: one of ``MODELS``.
        accept_licence: without it nothing is downloaded.
        force: puts them in place of others, and downloads also what is there.
        progress: is told of every piece that arrives.

    Raises:
        InputError: the licence was not accepted, other weights are stored, there is no connection,
            or what comes is not the released file: then nothing of it is kept.
        OSError: the disk does not take it.
    """
    if not accept_licence:
        raise InputError(
            f"nothing was downloaded: the weights of {model.name} are under the {model.licence}, "
            f"{model.terms}; --accept-licence accepts it"
        )
    present = stored(model)
    if present is not None and not force:
        if present.released:
            return present
        raise InputError(
            f"{present.file} holds other weights (SHA-256 {present.sha256}, from "
            f"{present.origin or 'nobody knows where'}); --force puts the released ones in their "
            "place"
        )
    url = model.url
    arrived = weights_dir() / ".downloads" / f"{model.name}.pt"
    wanted = Wanted("weights", (TORCH_FILE,), MAX_BYTES, lambda part: _check(part, url, model))
    try:
        download(url, arrived, wanted, force=force, progress=progress)
    except (Unreachable, Missing) as error:
        raise InputError(
            f"{error}. Where there is a network, {model.url} can be downloaded by other means; "
            "`tog weights add FILE` then stores it"
        ) from error
    kept = _store(model, arrived.read_bytes(), url)
    discard(arrived)
    return kept


def add(model: Model, file: Path) -> Stored:
    """Stores a file of weights in place of what was stored, once it is known to fit the network.

    Raises:
        InputError: torch is missing, or see ``read_checkpoint``; then nothing has changed.
        OSError: the disk does not take it.
    """
    from tog_drake.proposers.contact_graspnet import require_torch

    require_torch()
    from tog_drake.proposers.contact_graspnet.checkpoint import read_checkpoint

    checked = read_checkpoint(file)
    data = file.read_bytes()
    if sha256(data) != checked.sha256:
        raise InputError(f"{file} changed while it was read; try again when it is complete")
    return _store(model, data, f"file {file.resolve()}")


def git_sha1(data: bytes) -> str:
    """Returns the name that git gives to a file with this content."""
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def sha256(data: bytes) -> str:
    """Returns the SHA-256 of ``data``, as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def _check(part: Path, url: str, model: Model) -> None:
    """Raises InputError unless the file is the released one."""
    found = git_sha1(part.read_bytes())
    if found != model.git_sha1:
        raise InputError(
            f"{url} is not the released file, and nothing of it was kept: its git SHA-1 is "
            f"{found}, expected {model.git_sha1}. Weights of your own: tog weights add FILE"
        )


def _store(model: Model, data: bytes, origin: str) -> Stored:
    """Puts a file in its place. Without a record a file counts as one of unknown origin."""
    file = weights_dir() / model.path
    record = _record_of(file)
    record.unlink(missing_ok=True)
    write_atomically(file, data)
    write_atomically(record, json.dumps({"sha256": sha256(data), "origin": origin}) + "\n")
    return Stored(model, file, len(data), sha256(data), git_sha1(data), origin, changed=False)


def _record_of(file: Path) -> Path:
    return file.with_name(file.name + ".json")


def _read_record(file: Path) -> tuple[str | None, str | None]:
    """SHA-256 and origin of a stored file; None, None where nothing readable tells."""
    try:
        with _record_of(file).open("rb") as opened:
            record = json.loads(opened.read(_MAX_RECORD_BYTES))
        return str(record["sha256"]), str(record["origin"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None, None
