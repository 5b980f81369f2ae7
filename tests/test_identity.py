"""What a run is: what was asked for, and the digests of all that was there."""

import json
from dataclasses import replace

import pytest
from command import refused, tog

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.identity import run_config
from tog_drake.benchmark.journal import differences
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.suite import load_suite
from tog_drake.errors import InputError
from tog_drake.options import SelectorOptions
from tog_drake.sharing import program_digest
from tog_drake.view_options import ViewOptions
from tog_drake.view_scorers import detector
from tog_drake.weights import CONTACT_GRASPNET

GRASPS = {
    "poses": [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]],
    "scores": [1.0],
    "frame": "camera",
    "gripper": "G",
}
MODEL = "openai:any@http://127.0.0.1:9/v1"


def config_of(tmp_path, method=None, text=None, views=None, **work):
    suite = load_suite("Mug", text)
    methods = [method or Method("top-score")]
    cells = make_cells(suite, methods, [0], text=text, views=views)
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


def compared(scorer):
    """What asks for the views of five cameras, compared by this scorer."""
    text = f"pipeline: {{view_selection: {{scorer: {scorer}}}}}"
    return {"text": text, "views": ViewOptions(side_cameras=True)}


def compared_cassette(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return folder / "compare.jsonl", compared("!VlmCompare {replay: compare.jsonl}")


def detector_weights(folder, monkeypatch):
    pytest.importorskip("transformers")
    for name in ("config.json", "vocab.json", "merges.txt", "pytorch_model.bin", "README.md"):
        (folder / name).write_text("")
    return folder / "model.safetensors", compared(f"!Detector {{model: {folder}}}")


def prompt(folder, monkeypatch):
    monkeypatch.chdir(folder)
    options = SelectorOptions(prompt=folder / "mine.j2")
    return folder / "mine.j2", {"method": Method("vlm", vlm=MODEL), "options": options}


KINDS = [weights, proposals, cassette, prompt, compared_cassette, detector_weights]


@pytest.mark.parametrize("kind", KINDS)
def test_another_content_of_a_file_that_decides_is_another_run(tmp_path, monkeypatch, kind):
    file, asked = kind(tmp_path, monkeypatch)
    contents = [json.dumps(GRASPS), json.dumps({**GRASPS, "scores": [0.5]})]
    if kind in (cassette, compared_cassette):
        contents = ["", "\n"]
    if kind is prompt:
        contents = ["{{ task | quoted }}", "Say: {{ task | quoted }}"]
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


def test_of_a_detector_every_file_decides_that_is_read_and_no_other(tmp_path, monkeypatch):
    file, asked = detector_weights(tmp_path, monkeypatch)
    file.write_text("weights")
    named = config_of(tmp_path, **asked)["files"]
    read = ("config.json", "merges.txt", "model.safetensors", "vocab.json")
    assert list(named) == [f"{tmp_path}/{name}" for name in read]


@pytest.mark.parametrize("lacks", ["transformers", "weights"])
def test_a_detector_that_cannot_be_asked_is_told_before_anything_runs(lacks, tmp_path, monkeypatch):
    if lacks == "transformers":
        monkeypatch.setattr(detector, "find_spec", lambda name: None)
        command = "pip install 'tog_drake[views]'"
    else:
        pytest.importorskip("transformers")
        monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "empty"))
        command = detector.download_command()
    out = tmp_path / "run"
    words = ("--views", "hand,detector", "--side-cameras", "--selectors", "top-score")
    refused(tog("eval", "Mug", *words, "--seeds", 1, "--out", out), command)
    assert not out.exists()


def test_a_machine_says_what_it_has_other_than_where_the_run_began(tmp_path):
    config = config_of(tmp_path)
    (cell, *_) = make_cells(load_suite("Mug"), [Method("top-score")], [0])
    work = EpisodeWork(tmp_path, asked=config)
    assert work.others(cell) == []
    other = {**config, "objects": {"mug": "0" * 64}}
    assert replace(work, asked=other).others(cell) == ["objects.mug"]
    assert replace(work, program="0" * 64).others(cell) == ["program"]
