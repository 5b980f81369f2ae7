"""What a run is: what was asked for, and the digests of all that was there."""

import json
from dataclasses import replace

import pytest

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.identity import run_config
from tog_drake.benchmark.journal import differences
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.suite import load_suite
from tog_drake.errors import InputError
from tog_drake.options import SelectorOptions
from tog_drake.sharing import program_digest
from tog_drake.weights import CONTACT_GRASPNET

GRASPS = {
    "poses": [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]],
    "scores": [1.0],
    "frame": "camera",
    "gripper": "G",
}
MODEL = "openai:any@http://127.0.0.1:9/v1"


def config_of(tmp_path, method=None, text=None, **work):
    suite = load_suite("Mug", text)
    methods = [method or Method("top-score")]
    cells = make_cells(suite, methods, [0], text=text)
    return run_config(suite, methods, cells, EpisodeWork(tmp_path, **work), seeds=1)


def test_a_run_is_told_by_its_program_and_not_by_the_version_alone(tmp_path):
    was = config_of(tmp_path)
    assert was["program"] == program_digest()
    assert len(was["program"]) == 64
    edited = config_of(tmp_path, program="f" * 64)
    assert differences(was, edited) == [f'program was "{program_digest()}", asked is "{"f" * 64}"']
    assert was["files"] == {}


def weights(folder, monkeypatch):
    monkeypatch.setenv("TOG_WEIGHTS", str(folder))
    file = folder / CONTACT_GRASPNET.path
    file.parent.mkdir()
    return file, {"text": "pipeline: {proposer: !ContactGraspNet {}}"}


def proposals(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder / "grasps.json", {"method": Method("top-score", proposer="file:grasps.json")}


def cassette(folder, monkeypatch):
    monkeypatch.chdir(folder)
    options = SelectorOptions(replay=folder / "tape.jsonl")
    return folder / "tape.jsonl", {"method": Method("vlm", vlm=MODEL), "options": options}


@pytest.mark.parametrize("kind", [weights, proposals, cassette])
def test_another_content_of_a_file_that_decides_is_another_run(tmp_path, monkeypatch, kind):
    file, asked = kind(tmp_path, monkeypatch)
    contents = [json.dumps(GRASPS), json.dumps({**GRASPS, "scores": [0.5]})]
    if kind is cassette:
        contents = ["", "\n"]
    file.write_text(contents[0])
    was = config_of(tmp_path, **asked)
    assert config_of(tmp_path, **asked) == was
    file.write_text(contents[1])
    (changed,) = differences(was, config_of(tmp_path, **asked))
    name = "weights of contact-graspnet" if kind is weights else file.name
    assert changed.startswith("files.")
    assert name in changed


def test_weights_that_are_not_there_are_told_before_anything_runs(tmp_path, monkeypatch):
    file, asked = weights(tmp_path, monkeypatch)
    with pytest.raises(InputError, match="tog weights fetch"):
        config_of(tmp_path, **asked)
    assert not file.exists()


def test_a_machine_says_what_it_has_other_than_where_the_run_began(tmp_path):
    config = config_of(tmp_path)
    (cell, *_) = make_cells(load_suite("Mug"), [Method("top-score")], [0])
    work = EpisodeWork(tmp_path, asked=config)
    assert work.others(cell) == []
    other = {**config, "objects": {"mug": "0" * 64}}
    assert replace(work, asked=other).others(cell) == ["objects.mug"]
    assert replace(work, program="0" * 64).others(cell) == ["program"]
