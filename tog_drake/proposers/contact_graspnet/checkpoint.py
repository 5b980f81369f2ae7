"""Reads weights from a file of PyTorch, and believes nothing of it before it is checked.

The file comes from somewhere: it is read without running what is in it, its size is bounded, and
its tensors must be exactly those of the network.
"""

import io
import pickle
import pickletools
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tog_drake.errors import InputError
from tog_drake.proposers.contact_graspnet.network import ContactGraspNet
from tog_drake.weights import CONTACT_GRASPNET, MAX_BYTES, TORCH_FILE, git_sha1, sha256

OLDEST_TORCH = (2, 6)  # older ones can be made to run code by a file even with weights_only
MAX_PICKLE_BYTES = 1_000_000  # names and shapes; that of a state dict has about 30 000
_NAMED = 3  # as many wrong keys are named
# What a pickle of tensors, numbers, texts and containers asks for. torch itself would allow more,
# such as a bytearray of any length.
_GLOBALS = re.compile(
    r"collections OrderedDict|_codecs encode|numpy dtype|numpy\._?core\.multiarray scalar|"
    r"torch \w+Storage|torch\._utils (_rebuild_tensor_v2|_rebuild_parameter)"
)


@dataclass(frozen=True)
class Checkpoint:
    """Weights that fit the network, and whose they are."""

    file: Path
    state: dict[str, Tensor]  # on the CPU
    git_sha1: str  # of the file, as git names it
    sha256: str  # of the file

    @property
    def released(self) -> bool:
        """Whether the file is the one that was published for the network's PyTorch port."""
        return self.git_sha1 == CONTACT_GRASPNET.git_sha1


def load_network(file: Path, *, device: str, batch_norm: str) -> tuple[ContactGraspNet, Checkpoint]:
    """Returns the network with the weights of a file, loaded once per process.

    Args:
        file: see ``read_checkpoint``.
        device: "cpu", "cuda", or "auto": cuda where there is one.
        batch_norm: see ``ContactGraspNet``.

    Raises:
        InputError: see ``read_checkpoint``; or there is no such device.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("device cuda: torch finds no GPU here; valid: cpu, auto")
    return _load(file.resolve(), _version(file), device, batch_norm)


def _version(file: Path) -> tuple[int, ...]:
    """What becomes another when the file does, as far as that shows without reading it."""
    if not file.is_file():
        return ()
    stat = file.stat()
    return stat.st_mtime_ns, stat.st_size, stat.st_ino


@lru_cache(maxsize=4)
def _load(
    file: Path, version: tuple[int, ...], device: str, batch_norm: Any
) -> tuple[ContactGraspNet, Checkpoint]:
    checkpoint = read_checkpoint(file)
    network = ContactGraspNet(batch_norm)
    network.load_state_dict(checkpoint.state)
    return network.eval().to(device), checkpoint


def read_checkpoint(file: Path) -> Checkpoint:
    """Reads weights: what ``torch.save`` wrote of a dictionary with the state dict under ``model``,
    whatever else is in it, or of a bare state dict.

    Raises:
        InputError: there is no file, it is too large, no file of torch, cut off, asks for code to
            be run, or its tensors are not those of the network; torch is too old to be trusted.
    """
    if tuple(map(int, torch.__version__.split(".")[:2])) < OLDEST_TORCH:
        raise InputError(
            f"torch {torch.__version__} can be made to run code by a file of weights; install 2.6 "
            "or newer with: pip install 'tog_drake[cgn]'"
        )
    data = _read(file)
    content = _unpickled(file, data)
    state = content.get("model", content) if isinstance(content, dict) else content
    if not isinstance(state, Mapping):
        raise InputError(
            f"the checkpoint {file} holds {type(state).__name__}; valid: a state dict, bare or "
            "under the key 'model'"
        )
    _check(file, state)
    return Checkpoint(file, dict(state), git_sha1(data), sha256(data))


def _read(file: Path) -> bytes:
    if file.is_dir():
        raise InputError(f"the checkpoint {file} is a folder; valid: a file that torch.save wrote")
    if not file.is_file():
        raise InputError(f"there is no checkpoint {file}; valid: a file that torch.save wrote")
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"the checkpoint {file} has {size} bytes; at most {MAX_BYTES} are read")
    data = file.read_bytes()
    if not data.startswith(TORCH_FILE):
        raise InputError(
            f"{file} is no checkpoint: valid is a file that torch.save wrote (torch 1.6 or newer)"
        )
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise InputError(
            f"the checkpoint {file} is cut off or damaged ({error}): its {size} bytes are no whole "
            "archive; get it again"
        ) from error
    if unpacked > MAX_BYTES:
        raise InputError(
            f"the checkpoint {file} unpacks to {unpacked} bytes; at most {MAX_BYTES} are read"
        )
    return data


def _unpickled(file: Path, data: bytes) -> Any:
    """What the file holds, made of tensors, numbers, texts and containers alone."""
    try:
        _check_pickle(torch._C.PyTorchFileReader(io.BytesIO(data)).get_record("data.pkl"))
        with torch.serialization.safe_globals(_NUMPY):
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        wanted = re.search(r"GLOBAL (\S+)", str(error))
        what = f"asks for {wanted[1]}" if wanted else "holds what is no tensor"
        raise InputError(
            f"the checkpoint {file} is refused: it {what}, and could run any code or take any "
            "memory; nothing of it was run. Valid: tensors, numbers and texts"
        ) from error
    except Exception as error:  # who knows what a damaged or a malicious file leads to
        first = (str(error).splitlines() or [""])[0]
        raise InputError(
            f"the checkpoint {file} is cut off or damaged ({type(error).__name__}: {first:.200})"
        ) from error


def _check_pickle(data: bytes) -> None:
    """Raises UnpicklingError where a pickle asks for something else than ``_GLOBALS``; runs none.

    ValueError: it is too long, or no pickle.
    """
    if len(data) > MAX_PICKLE_BYTES:
        raise ValueError(f"a pickle of {len(data)} bytes; at most {MAX_PICKLE_BYTES} are read")
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name in ("STACK_GLOBAL", "INST", "OBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"):
            raise pickle.UnpicklingError(f"GLOBAL {opcode.name}")
        if opcode.name == "GLOBAL" and not _GLOBALS.fullmatch(str(argument)):
            raise pickle.UnpicklingError(f"GLOBAL {str(argument).replace(' ', '.')}")


class _Ignored:
    """In the place of a number of NumPy: published weights have one beside them, unused here."""

    def __init__(self, *_: Any):
        pass

    def __setstate__(self, state: Any) -> None:
        pass


_NUMPY: list[Any] = [
    (_Ignored, "numpy.dtype"),
    (_Ignored, "numpy.core.multiarray.scalar"),  # so NumPy 1 wrote it
    (_Ignored, "numpy._core.multiarray.scalar"),  # and so NumPy 2
]


def _check(file: Path, state: Mapping[Any, Any]) -> None:
    """Raises InputError unless the tensors are those of the network: names, shapes, finite."""
    with torch.device("meta"):  # names and shapes, no numbers
        wanted = ContactGraspNet().state_dict()
    missing = [key for key in wanted if key not in state]
    unknown = [key for key in state if key not in wanted]
    if missing or unknown:
        raise InputError(
            f"the checkpoint {file} is not one of Contact-GraspNet's PyTorch port: of its "
            f"{len(wanted)} tensors {_some('missing', missing)}; {_some('not among them', unknown)}"
        )
    for key, tensor in wanted.items():
        given = state[key]
        if not isinstance(given, Tensor) or given.layout != torch.strided or given.is_complex():
            raise InputError(f"the checkpoint {file}: {key} is no dense real tensor")
        if given.shape != tensor.shape:
            raise InputError(
                f"the checkpoint {file}: {key} has the shape {list(given.shape)}; expected: "
                f"{list(tensor.shape)}"
            )
        if not torch.isfinite(given.to(tensor.dtype)).all():  # as the network will have it
            raise InputError(
                f"the checkpoint {file}: {key} holds numbers that are not finite as {tensor.dtype}"
            )
        if key.endswith(".running_var") and not (given >= 0).all():
            raise InputError(f"the checkpoint {file}: {key} holds variances below 0")


def _some(what: str, keys: list[Any]) -> str:
    """Such as "5 missing (sa1.bn_blocks.0.0.bias, fp1.mlp_convs.0.weight ...)"."""
    names = ", ".join(f"{key!s:.60}" for key in keys[:_NAMED])
    more = " ..." if len(keys) > _NAMED else ""
    return f"{len(keys)} {what}" + (f" ({names}{more})" if keys else "")
