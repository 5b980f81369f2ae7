"""Weights from a file: those that fit are used, everything else is refused and never run."""

import io
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_weights import synthetic_state, write_checkpoint

from tog_drake.errors import InputError
from tog_drake.proposers.contact_graspnet import checkpoint as module
from tog_drake.proposers.contact_graspnet.checkpoint import load_network, read_checkpoint
from tog_drake.weights import CONTACT_GRASPNET

KEY = "sa1.conv_blocks.0.0.weight"


@pytest.fixture(scope="module")
def state():
    return synthetic_state()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    file = tmp_path_factory.mktemp("weights") / "model.pt"
    write_checkpoint(file)
    return file


def saved(file, content):
    torch.save(content, file)
    return file


def in_other_words(file, old, new):
    """The archive with other bytes in its pickle."""
    with zipfile.ZipFile(file) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in entries:
            archive.writestr(name, data.replace(old, new) if name.endswith(".pkl") else data)
    return file


# -- what is accepted ----------------------------------------------------------------------------


def test_the_network_gets_the_weights_of_the_file(good, state):
    network, _ = load_network(good, device="cpu", batch_norm="running")
    assert all(torch.equal(tensor, state[key]) for key, tensor in network.state_dict().items())
    assert not network.training


def test_a_bare_state_dict_will_do(tmp_path, state):
    assert set(read_checkpoint(saved(tmp_path / "bare.pt", state)).state) == set(state)


@pytest.mark.parametrize("package", [b"numpy._core.multiarray", b"numpy.core.multiarray"])
def test_a_number_of_numpy_beside_the_weights_does_no_harm_whichever_numpy_wrote_it(
    tmp_path, state, package
):
    content = {"model": state, "loss_val_best": np.float64(0.5), "opt": {"lr": [1e-3]}}
    file = saved(tmp_path / "full.pt", content)
    written = b"numpy._core.multiarray" if np.__version__ >= "2" else b"numpy.core.multiarray"
    in_other_words(file, written, package)
    assert set(read_checkpoint(file).state) == set(state)


def test_a_file_is_loaded_once_unless_it_changes(good):
    first = load_network(good, device="cpu", batch_norm="running")
    assert load_network(good, device="cpu", batch_norm="running") is first
    assert load_network(good, device="cpu", batch_norm="batch")[0] is not first[0]


def test_another_file_of_the_same_age_is_another(tmp_path, state):
    file = saved(tmp_path / "model.pt", state)
    first = load_network(file, device="cpu", batch_norm="running")[1]
    other = saved(tmp_path / "other.pt", {**state, KEY: state[KEY] + 1})
    time = file.stat().st_mtime_ns
    os.utime(other, ns=(time, time))
    assert other.stat().st_size == file.stat().st_size
    other.replace(file)
    assert load_network(file, device="cpu", batch_norm="running")[1].sha256 != first.sha256


def test_only_the_released_file_counts_as_released(good, monkeypatch):
    checkpoint = read_checkpoint(good)
    assert not checkpoint.released
    other = replace(CONTACT_GRASPNET, git_sha1=checkpoint.git_sha1)
    monkeypatch.setattr(module, "CONTACT_GRASPNET", other)
    assert read_checkpoint(good).released


# -- what is refused -----------------------------------------------------------------------------


def refused(file, *words):
    with pytest.raises(InputError) as error:
        read_checkpoint(file)
    for word in (str(file), *words):
        assert word in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    refused(tmp_path / "model.pt", "there is no checkpoint")
    refused(tmp_path, "is a folder")


@pytest.mark.parametrize("content", [b"", b"no weights", pickle.dumps({"model": {}})])
def test_what_torch_did_not_write_is_no_checkpoint(tmp_path, content):
    file = tmp_path / "model.pt"
    file.write_bytes(content)
    refused(file, "is no checkpoint", "torch.save")


def test_a_zip_of_something_else_is_refused(tmp_path):
    file = tmp_path / "photos.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("photo.png", b"png")
    refused(file, "damaged")


@pytest.mark.parametrize("share", [0.01, 0.5, 0.9999])
def test_a_file_that_was_cut_off_is_refused(tmp_path, good, share):
    data = good.read_bytes()
    file = tmp_path / "cut.pt"
    file.write_bytes(data[: int(share * len(data))])
    refused(file, "cut off or damaged", "get it again")


def test_files_that_are_too_large_are_not_read(tmp_path, good, monkeypatch):
    monkeypatch.setattr(module, "MAX_BYTES", good.stat().st_size - 1)
    refused(good, "bytes; at most")
    bomb = tmp_path / "bomb.pt"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(2 * good.stat().st_size))
    assert bomb.stat().st_size < 100_000
    refused(bomb, "unpacks to")


class Hostile:
    """What makes ``pickle`` touch a file."""

    def __init__(self, file):
        self.file = file

    def __reduce__(self):
        return Path.touch, (self.file,)


def test_a_file_that_asks_for_code_is_refused_and_nothing_is_run(tmp_path, state):
    touched = tmp_path / "touched"
    file = saved(tmp_path / "hostile.pt", {"model": state, "more": Hostile(touched)})
    refused(file, "is refused", "nothing of it was run")
    assert not touched.exists()
    torch.load(file, weights_only=False)  # it is as hostile as it is meant to be
    assert touched.exists()


@pytest.mark.parametrize(
    ("asked", "argument"),
    [
        (b"builtins\nbytearray", b"\x8a\x05" + (10**11).to_bytes(5, "little")),
        (b"__builtin__\nbytearray", b"\x8a\x05" + (10**11).to_bytes(5, "little")),
        (b"torch._utils\n_rebuild_sparse_tensor", b"N"),
    ],
)
def test_a_small_file_that_asks_for_any_memory_is_refused(tmp_path, asked, argument):
    file = saved(tmp_path / "greedy.pt", 0)
    with zipfile.ZipFile(file) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("data.pkl"))
        old = archive.read(name)
    in_other_words(file, old, b"\x80\x02c" + asked + b"\n" + argument + b"\x85R.")
    assert file.stat().st_size < 2000
    refused(file, "asks for " + asked.decode().replace("\n", "."), "any memory")


def test_a_number_of_numpy_takes_no_memory_however_long_it_is_said_to_be(tmp_path, state):
    file = saved(tmp_path / "greedy.pt", {"model": state, "best": np.float64(0.5)})
    old, new = b"X\x02\x00\x00\x00f8", b"X\x0b\x00\x00\x00V2000000000"
    in_other_words(file, old, new)
    with zipfile.ZipFile(file) as archive:
        assert any(new in archive.read(n) for n in archive.namelist() if n.endswith("data.pkl"))
    assert set(read_checkpoint(file).state) == set(state)


def test_a_pickle_that_is_too_long_is_refused(tmp_path, state):
    file = saved(tmp_path / "long.pt", {"model": state, "more": "x" * 1_000_000})
    refused(file, "bytes; at most 1000000 are read")


def test_a_variance_below_0_is_none(tmp_path, state):
    key = "sa1.bn_blocks.0.0.running_var"
    refused(saved(tmp_path / "w.pt", {**state, key: -state[key]}), key, "below 0")


@pytest.mark.parametrize("content", [[1, 2], {"model": 3}, torch.zeros(3)])
def test_other_content_than_a_state_dict_is_told(tmp_path, content):
    refused(saved(tmp_path / "other.pt", content), "state dict")


def test_wrong_keys_are_named_the_first_few(tmp_path, state):
    renamed = {f"module.{key}": tensor for key, tensor in state.items()}
    refused(
        saved(tmp_path / "renamed.pt", {"model": renamed}),
        "295 missing (sa1.conv_blocks.0.0.weight,",
        "295 not among them (module.sa1.conv_blocks.0.0.weight,",
    )
    one_less = {key: tensor for key, tensor in state.items() if key != KEY}
    refused(saved(tmp_path / "less.pt", one_less), f"1 missing ({KEY}); 0 not among them")


def test_a_wrong_shape_is_told_with_the_right_one(tmp_path, state):
    wrong = {**state, KEY: torch.zeros(32, 3, 1, 1)}
    refused(saved(tmp_path / "w.pt", wrong), KEY, "[32, 3, 1, 1]", "expected: [32, 6, 1, 1]")


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (torch.full((32, 6, 1, 1), float("nan")), "not finite"),
        (torch.full((32, 6, 1, 1), float("inf")), "not finite"),
        (torch.zeros((32, 6, 1, 1), dtype=torch.complex64), "no dense real tensor"),
        (torch.full((32, 6, 1, 1), 1e300, dtype=torch.float64), "not finite as torch.float32"),
        (3.0, "no dense real tensor"),
    ],
)
def test_what_is_no_number_is_no_weight(tmp_path, state, value, says):
    refused(saved(tmp_path / "w.pt", {**state, KEY: value}), KEY, says)


def test_a_torch_that_can_be_made_to_run_code_is_not_trusted(good, monkeypatch):
    monkeypatch.setattr(torch, "__version__", "2.5.1+cpu")
    with pytest.raises(InputError, match=r"torch 2\.5\.1.*pip install 'tog_drake\[cgn\]'"):
        read_checkpoint(good)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_without_a_gpu_auto_is_the_cpu_and_cuda_an_error(good):
    network, _ = load_network(good, device="auto", batch_norm="running")
    assert next(network.parameters()).device.type == "cpu"
    with pytest.raises(InputError, match="no GPU here; valid: cpu, auto"):
        load_network(good, device="cuda", batch_norm="running")


def test_any_damage_to_the_pickle_ends_in_one_kind_of_error_or_in_good_weights(tmp_path, good):
    with zipfile.ZipFile(good) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("data.pkl"))
        entries = {n: archive.read(n) for n in archive.namelist()}
    rng = np.random.default_rng(0)
    for _ in range(6):
        data = bytearray(entries[name])
        for at in rng.integers(len(data), size=4):
            data[at] = rng.integers(256)
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for n, original in entries.items():
                archive.writestr(n, bytes(data) if n == name else original)
        file = tmp_path / "damaged.pt"
        file.write_bytes(buffer.getvalue())
        try:
            read_checkpoint(file)
        except InputError as error:
            assert str(file) in str(error)
