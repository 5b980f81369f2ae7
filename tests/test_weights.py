"""Weights of networks: fetched from a server that may be anything, added, listed and tried out."""

import hashlib
import json
import random
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from asset_server import AssetServer, cut, html, status
from command import refused, tog
from synthetic_weights import synthetic_state, write_checkpoint

from tog_drake import doctor, http_stream, weights
from tog_drake import download as downloading
from tog_drake.errors import InputError, NoGrasp
from tog_drake.proposers.contact_graspnet import trial as trial_module
from tog_drake.proposers.contact_graspnet.network import ContactGraspNet
from tog_drake.proposers.contact_graspnet.prediction import predict
from tog_drake.proposers.contact_graspnet.proposer import ContactGraspNet as ContactGraspNetConfig
from tog_drake.proposers.contact_graspnet.proposer import make_contact_graspnet
from tog_drake.proposers.contact_graspnet.trial import (
    BOX,
    CYLINDER,
    Trial,
    built_in_cloud,
    signs_of_no_training,
    try_out,
)
from tog_drake.weights import CONTACT_GRASPNET, MODELS, add, git_sha1, stored

NAME = "contact-graspnet"
DATA = b"PK\3\4" + random.Random(0).randbytes(100_000)  # like weights from outside
OTHER = b"PK\3\4" + random.Random(1).randbytes(50_000)
FETCH = ("weights", "fetch", NAME)
ACCEPT = (*FETCH, "--accept-licence")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The folder of weights, empty; and a download that fails fails fast."""
    monkeypatch.setenv("TOG_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr(downloading, "FIRST_DELAY", 0.001)
    monkeypatch.setattr(http_stream, "CHUNK", 4096)
    return tmp_path / "weights"


@pytest.fixture
def server(monkeypatch):
    """Hands out DATA, which is taken for the released file."""
    released = replace(CONTACT_GRASPNET, git_sha1=git_sha1(DATA))
    monkeypatch.setitem(MODELS, NAME, released)
    with AssetServer({"/mirror/model.pt": DATA}) as running:
        monkeypatch.setenv("TOG_CGN_URL", running.url + "/mirror/")
        yield running


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    file = tmp_path_factory.mktemp("files") / "synthetic.pt"
    write_checkpoint(file)
    return file


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


KEPT = ["contact_graspnet/model.pt", "contact_graspnet/model.pt.json"]


# -- fetching ------------------------------------------------------------------------------------


def test_nothing_is_downloaded_before_the_licence_is_accepted(server, folder):
    done = tog(*FETCH)
    assert done.status == 2
    assert "licence: NVIDIA Source Code License (non-commercial)" in done.out
    assert "not for commercial use" in done.out
    assert "its text: https://github.com/NVlabs/contact_graspnet/blob/" in done.out
    assert "/License.pdf" in done.out
    assert "nothing was downloaded" in done.err and "--accept-licence" in done.err
    assert server.asked == []
    assert not folder.exists()


def test_released_weights_are_stored_with_their_sha256_and_origin(server, folder):
    done = tog(*ACCEPT)
    assert (done.status, done.err) == (0, "")
    assert "licence: NVIDIA Source Code License" in done.out
    digest = hashlib.sha256(DATA).hexdigest()
    assert f"SHA-256: {digest}" in done.out
    assert "the released checkpoint" in done.out and "not the released" not in done.out
    assert files(folder) == KEPT
    assert (folder / KEPT[0]).read_bytes() == DATA
    record = json.loads((folder / KEPT[1]).read_text())
    assert record == {"sha256": digest, "origin": server.url + "/mirror/model.pt"}


def test_weights_that_are_there_are_not_asked_for_again_unless_forced(server, folder):
    for arguments, asked in ((ACCEPT, 1), (ACCEPT, 1), ((*ACCEPT, "--force"), 2)):
        assert tog(*arguments).status == 0
        assert len(server.asked) == asked
    assert files(folder) == KEPT


def test_another_file_than_the_released_one_is_kept_nowhere(server, folder):
    server.files["/mirror/model.pt"] = OTHER
    done = tog(*ACCEPT)
    assert done.status == 2
    for words in (git_sha1(OTHER), git_sha1(DATA), "nothing of it was kept", "tog weights add"):
        assert words in done.err
    assert files(folder) == []


def test_a_page_in_place_of_the_weights_is_quoted_and_kept_nowhere(server, folder):
    server.misbehave(html)
    done = tog(*ACCEPT)
    assert done.status == 2
    assert "something else than weights" in done.err and "Welcome to our hotel" in done.err
    assert files(folder) == []


def test_a_connection_that_is_cut_goes_on_where_it_ended(server, folder):
    server.misbehave(cut(60_000))
    assert tog(*ACCEPT).status == 0
    assert server.asked[1][1].startswith("bytes=")
    assert (folder / KEPT[0]).read_bytes() == DATA


def test_what_fails_leaves_the_weights_that_were_there(server, folder):
    tog(*ACCEPT)
    server.files["/mirror/model.pt"] = OTHER
    assert tog(*ACCEPT, "--force").status == 2
    assert (folder / KEPT[0]).read_bytes() == DATA
    assert stored(MODELS[NAME]).released


@pytest.mark.parametrize("gone", [True, False])
def test_without_network_or_file_it_says_how_to_go_on(server, folder, monkeypatch, gone):
    if gone:
        monkeypatch.setenv("TOG_CGN_URL", "http://127.0.0.1:9/x")
    else:
        server.misbehave(status(404))
    done = tog(*ACCEPT)
    assert done.status == 2
    assert ("there is no connection" if gone else "no such file") in done.err
    assert "downloaded by other means" in done.err and "`tog weights add FILE`" in done.err
    assert files(folder) == []


def test_weights_of_ones_own_are_replaced_by_force_alone(server, folder):
    (folder / KEPT[0]).parent.mkdir(parents=True)
    (folder / KEPT[0]).write_bytes(OTHER)
    done = tog(*ACCEPT)
    assert done.status == 2
    assert "holds other weights" in done.err and "--force" in done.err
    assert server.asked == []
    assert tog(*ACCEPT, "--force").status == 0
    assert (folder / KEPT[0]).read_bytes() == DATA


def test_the_official_address_and_the_licence_are_shown_where_no_mirror_is_named():
    shown = json.loads(tog("weights", "list", "--json").out)[NAME]
    assert shown["url"].startswith("https://raw.githubusercontent.com/elchun/contact_graspnet_")
    assert shown["url"].endswith("/checkpoints/contact_graspnet/checkpoints/model.pt")
    assert shown["git_sha1"] == "b52cf0c889511c17acdded2dde8062710299b73e"
    assert shown["stored"] is None


def test_a_mirror_that_is_no_url_and_an_unknown_model_are_refused(monkeypatch):
    refused(tog("weights", "fetch", "resnet"), "unknown model 'resnet'", NAME)
    monkeypatch.setenv("TOG_CGN_URL", "nonsense")
    refused(tog("weights", "list"), "TOG_CGN_URL", "is no URL of a folder")


def test_a_file_is_named_as_git_names_it():
    assert git_sha1(b"hello\n") == "ce013625030ba8dba906f756967f9e9ca394464a"


# -- adding and listing --------------------------------------------------------------------------


def test_a_file_of_ones_own_is_stored_and_used_and_not_taken_for_the_released_one(
    synthetic, folder
):
    done = tog("weights", "add", synthetic)
    assert (done.status, done.err) == (0, "")
    assert "not the released checkpoint" in done.out
    assert files(folder) == KEPT
    assert (folder / KEPT[0]).read_bytes() == synthetic.read_bytes()
    digest = hashlib.sha256(synthetic.read_bytes()).hexdigest()
    kept = json.loads(tog("weights", "list", "--json").out)[NAME]["stored"]
    assert kept == {
        "file": str(folder / KEPT[0]),
        "size": synthetic.stat().st_size,
        "sha256": digest,
        "git_sha1": git_sha1(synthetic.read_bytes()),
        "origin": f"file {synthetic}",
        "changed": False,
        "released": False,
    }
    used = make_contact_graspnet(ContactGraspNetConfig(), seed=0).weights
    assert (used["file"], used["sha256"], used["released"]) == (kept["file"], digest, False)


def test_a_file_that_does_not_fit_is_not_stored_and_replaces_nothing(synthetic, folder, tmp_path):
    wrong = tmp_path / "wrong.pt"
    torch.save({"model": {"a": torch.zeros(3)}}, wrong)
    refused(tog("weights", "add", wrong), str(wrong), "295 missing")
    assert not folder.exists()
    add(CONTACT_GRASPNET, synthetic)
    refused(tog("weights", "add", wrong), "295 missing")
    refused(tog("weights", "add", tmp_path / "none.pt"), "there is no checkpoint")
    assert stored(CONTACT_GRASPNET).origin == f"file {synthetic}"


def test_a_file_that_changes_while_it_is_read_is_not_stored(synthetic, folder, monkeypatch):
    read = Path.read_bytes
    contents = iter([read(synthetic), read(synthetic)[:-1]])
    monkeypatch.setattr(Path, "read_bytes", lambda path: next(contents))
    with pytest.raises(InputError, match="changed while it was read"):
        add(CONTACT_GRASPNET, synthetic)
    assert not folder.exists()


def test_a_full_disk_leaves_what_was_there(synthetic, folder, monkeypatch):
    (folder / KEPT[0]).parent.mkdir(parents=True)
    (folder / KEPT[0]).write_bytes(OTHER)

    def full(path, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(weights, "write_atomically", full)
    with pytest.raises(OSError, match="No space"):
        add(CONTACT_GRASPNET, synthetic)
    assert (folder / KEPT[0]).read_bytes() == OTHER


def put(folder, data, record=None):
    (folder / KEPT[0]).parent.mkdir(parents=True, exist_ok=True)
    (folder / KEPT[0]).write_bytes(data)
    if record is not None:
        (folder / KEPT[1]).write_text(record)


def test_stored_weights_that_have_changed_are_told(folder):
    put(folder, DATA, json.dumps({"sha256": hashlib.sha256(OTHER).hexdigest(), "origin": "x"}))
    assert stored(CONTACT_GRASPNET).changed
    assert "no longer what was stored" in tog("weights", "list").out


@pytest.mark.parametrize("record", [None, "", "[]", "{}", "3", "[" * 9_000, "\x00", '{"sha256": 1'])
def test_weights_without_a_readable_record_came_from_nobody_knows_where(folder, record):
    put(folder, DATA, record)
    kept = stored(CONTACT_GRASPNET)
    assert (kept.origin, kept.changed, kept.size) == (None, False, len(DATA))
    assert "nobody knows where" in tog("weights", "list").out


def test_what_is_too_large_for_weights_is_not_read(folder, monkeypatch):
    put(folder, DATA)
    monkeypatch.setattr(weights, "MAX_BYTES", len(DATA) - 1)
    refused(tog("weights", "list"), str(folder / KEPT[0]), "delete it")


def test_listing_and_fetching_need_no_torch_and_adding_and_checking_say_how_to_install_it(
    server, synthetic, monkeypatch
):
    monkeypatch.setitem(sys.modules, "torch", None)  # as if it were not installed
    package = "tog_drake.proposers.contact_graspnet"
    for module in [name for name in sys.modules if name.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, module)
    assert tog(*ACCEPT).status == 0
    assert tog("weights", "list").status == 0
    for arguments in (("add", synthetic), ("check", "--checkpoint", synthetic)):
        refused(tog("weights", *arguments), "torch", "pip install 'tog_drake[cgn]'")


def test_the_doctor_says_whether_there_are_weights(folder):
    def found():
        check = doctor._check("weights", lambda: doctor._weights(NAME), required=False)
        return check.ok, check.found

    assert found() == (False, f"get them with: tog weights fetch {NAME} --accept-licence")
    put(folder, DATA)
    assert found() == (True, f"not the released checkpoint, {folder / KEPT[0]}")


# -- trying out ----------------------------------------------------------------------------------


def test_the_built_in_cloud_is_a_box_and_a_cylinder_on_a_table_one_metre_away():
    points, thing = built_in_cloud()
    assert points.shape == (20000, 3) and len(np.unique(points, axis=0)) == 20000
    np.testing.assert_array_equal(points, built_in_cloud()[0])
    tilt = np.deg2rad(50)  # W by turning C about x, by hand
    y, z = -points[:, 1], 1.0 - points[:, 2]
    p_W = np.column_stack([
        points[:, 0],
        y * np.sin(tilt) - z * np.cos(tilt),
        y * np.cos(tilt) + z * np.sin(tilt),
    ])  # fmt: skip
    np.testing.assert_allclose(p_W[~thing, 2], 0, atol=1e-12)
    to_box = np.maximum(BOX[0] - p_W, p_W - BOX[1]).max(axis=1)  # 0 on its surface
    x, y, radius, height = CYLINDER
    from_axis = np.hypot(p_W[:, 0] - x, p_W[:, 1] - y)
    to_cylinder = np.maximum(from_axis - radius, np.maximum(p_W[:, 2] - height, -p_W[:, 2]))
    on_box, on_cylinder = np.abs(to_box) < 1e-9, np.abs(to_cylinder) < 1e-9
    assert (on_box | on_cylinder)[thing].all()
    assert (on_box & thing).sum() > 500 and (on_cylinder & thing).sum() > 500
    assert np.minimum(to_box, to_cylinder).min() > -1e-9  # nobody sees what is inside


class Scripted:
    """A network with contacts at the first 500 points, and these scores."""

    def __init__(self, scores):
        self.scores = scores

    def __call__(self, points):
        return {
            "pred_grasps_cam": torch.eye(4).expand(1, 500, 4, 4).clone(),
            "pred_scores": torch.from_numpy(self.scores).float()[None, :, None],
            "pred_points": points[:, :500],
            "offset_pred": torch.full((1, 1, 500), 0.03),
        }


def test_contacts_are_counted_where_they_are():
    thing = built_in_cloud()[1][:500]
    said = try_out(Scripted(np.where(thing, 0.9, 0.1)))
    assert (said.contacts, said.confident, said.on_things) == (500, thing.sum(), thing.sum())
    assert said.things == thing.mean()
    assert f"500 contacts, {thing.sum()} above 0.23 (lowest 0.10, highest 0.90); 100%" in str(said)
    assert try_out(Scripted(np.where(thing, 0.1, 0.9))).on_things == 0
    assert str(try_out(Scripted(np.full(500, 0.2)))).startswith("500 contacts, 0 above 0.23 (")


def test_a_network_that_says_no_numbers_has_no_grasp_and_that_is_a_problem():
    silent = Scripted(np.full(500, np.nan))
    with pytest.raises(NoGrasp, match=r"of its 500 answers none is finite.*tog weights check"):
        predict(silent, built_in_cloud()[0], 1, np.random.default_rng(0))
    said = try_out(silent)
    assert said.contacts == 0
    assert any("no grasp at all" in sign for sign in signs_of_no_training({}, said))


def test_each_sign_of_weights_without_training_is_told_by_itself():
    varied, equal = (Trial(2048, 300, 0.5 - by, 0.5 + by, 200, 0.1) for by in (0.4, 0.004))
    trained = {"a.num_batches_tracked": torch.tensor(7), "a.running_mean": torch.ones(2),
               "a.running_var": torch.ones(2)}  # fmt: skip
    assert signs_of_no_training(trained, varied) == []
    (sign,) = signs_of_no_training(trained, Trial(0, 0, 0.0, 0.0, 0, 0.0))
    assert "no grasp at all" in sign
    (sign,) = signs_of_no_training(trained, equal)
    assert "the same everywhere" in sign
    (sign,) = signs_of_no_training({**trained, "a.num_batches_tracked": torch.tensor(0)}, varied)
    assert "no step of training" in sign
    (sign,) = signs_of_no_training({**trained, "a.running_mean": torch.zeros(2)}, varied)
    assert "before training" in sign


def checked(state, tmp_path):
    file = tmp_path / "state.pt"
    torch.save(state, file)
    return tog("weights", "check", "--checkpoint", file, "--json")


def test_weights_that_were_never_loaded_are_found_out(tmp_path):
    with torch.random.fork_rng():
        torch.manual_seed(5)
        done = checked(ContactGraspNet().state_dict(), tmp_path)
    assert done.status == 1
    said = json.loads(done.out)
    assert len(said["problems"]) == 3
    assert said["said"]["contacts"] == said["said"]["confident"] == 2048  # and yet so sure
    assert done.err.count("PROBLEM: ") == 3


def test_weights_that_look_trained_pass_and_are_not_taken_for_the_released_ones(tmp_path):
    state = synthetic_state()
    for name in state:
        if name.endswith("num_batches_tracked"):
            state[name] = torch.tensor(1000)
    done = checked(state, tmp_path)
    assert done.status == 0
    said = json.loads(done.out)
    assert (said["problems"], said["released"]) == ([], False)
    assert said["said"]["highest"] - said["said"]["lowest"] > 0.5
    trial = Trial(**said["said"])
    assert f"the network says: 2048 contacts, {trial.confident} above 0.23" in done.err
    assert "not the released checkpoint" in done.err and "an untrained one: 2048" in done.err


def test_stored_weights_that_have_changed_do_not_pass(synthetic, folder, monkeypatch):
    asked = []

    def canned(network):
        asked.append(network.batch_norm)
        return Trial(2048, 300, 0.0, 0.9, 200, 0.1)

    monkeypatch.setattr(trial_module, "try_out", canned)
    refused(tog("weights", "check"), str(folder / KEPT[0]), "tog weights fetch", "weights add")
    refused(tog("weights", "check", "--batch-norm", "x"), "unknown --batch-norm 'x'", "batch")
    put(folder, synthetic.read_bytes(), '{"sha256": "0", "origin": "elsewhere"}')
    done = tog("weights", "check", "--batch-norm", "batch")
    assert done.status == 1
    assert asked == ["batch", "running"]  # the network itself, then the untrained one
    assert "PROBLEM: the file is no longer what was stored" in done.out
