"""The detector that runs here: tiny random networks of the real classes, no download."""

import json
import shutil
import socket
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.perception import PointCloud
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake.errors import InputError
from tog_drake.pipeline import make_view_scorer
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import CameraView, Candidates
from tog_drake.view_scorers import detector
from tog_drake.view_scorers.detector import (
    MODEL,
    REVISION,
    Detector,
    DetectorScorer,
    Network,
    download_command,
    find_weights,
    load,
)

LETTERS = "abcdefghijklmnopqrstuvwxyz"
MOST_TOKENS = 16  # of OWLv2
SIZE = 64  # [pixel] of the tiny network's image; a patch is a quarter of it
# What google/owlv2-base-patch16-ensemble finds in a photograph of two cats (640 × 480 pixels, "a
# photo of a cat"), as the documentation of transformers prints it: score and box.
PUBLISHED = [
    (0.614, (341.67, 23.39, 642.32, 371.35)),
    (0.665, (6.75, 51.96, 326.62, 473.13)),
]


@cache
def views():
    scene = [TABLE, HAMMER_SIZED]
    return tuple(
        CameraView(name, look(scene, eye=eye, width=128, height=72))
        for name, eye in (("wrist", (0.25, 0.0, 0.45)), ("side", (0.75, 0.3, 0.45)))
    )


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A folder with the files that a released OWLv2 has; its network is tiny and untrained."""
    pytest.importorskip("transformers")
    return write_tiny(tmp_path_factory.mktemp("owlv2"))


def write_tiny(folder, seed=0):
    import torch
    from transformers import Owlv2Config, Owlv2ForObjectDetection

    tokens = [*LETTERS, *(f"{c}</w>" for c in LETTERS), "<|startoftext|>", "<|endoftext|>", "!"]
    ids = {token: i for i, token in enumerate(tokens)}
    few = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1}
    few["num_attention_heads"] = 2
    ends = ("bos", "<|startoftext|>"), ("eos", "<|endoftext|>"), ("pad", "!")
    text = {"vocab_size": len(ids), "max_position_embeddings": MOST_TOKENS, **few}
    text |= {f"{name}_token_id": ids[token] for name, token in ends}
    vision = {"image_size": SIZE, "patch_size": SIZE // 4, **few}
    torch.manual_seed(seed)
    config = Owlv2Config(text_config=text, vision_config=vision, projection_dim=16)
    Owlv2ForObjectDetection(config).save_pretrained(folder)
    for name, content in {
        "vocab.json": ids,
        "tokenizer_config.json": {
            "tokenizer_class": "CLIPTokenizer",
            "model_max_length": MOST_TOKENS,
            **{f"{name}_token": token for name, token in (*ends, ("unk", "<|endoftext|>"))},
        },
        "preprocessor_config.json": {
            "image_processor_type": "Owlv2ImageProcessor",
            "processor_class": "Owlv2Processor",
            "size": {"height": SIZE, "width": SIZE},
        },
    }.items():
        (folder / name).write_text(json.dumps(content))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    return folder


def score(model, target="axe", **settings):
    scorer = DetectorScorer(Detector(model=str(model), **settings))
    return scorer.score(views(), PointCloud(0), Candidates.empty(), target, "use the hammer")


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*arguments):
        pytest.fail("something on the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def test_a_folder_is_loaded_by_the_real_classes_and_scores_every_view(tiny, no_network, capfd):
    load.cache_clear()
    scores = score(tiny, threshold=0.0)
    assert type(load(tiny, "cpu").model).__name__ == "Owlv2ForObjectDetection"
    assert type(load(tiny, "cpu").processor).__name__ == "Owlv2Processor"
    assert len(scores.values) == 2
    assert all(0.0 < value <= 1.0 for value in scores.values)
    assert "'axe'" in scores.reason
    assert capfd.readouterr() == ("", "")  # no progress bar, no advice


def test_the_score_is_the_greatest_confidence_that_the_network_gives_the_words(tiny):
    import torch

    network, seen = load(tiny, "cpu"), views()[0].view.rgb
    inputs = network.processor(text=[["a photo of a mug"]], images=seen, return_tensors="pt")
    with torch.inference_mode():
        outputs = network.model(**inputs)
    confidence = torch.sigmoid(outputs.logits[0, :, 0])
    height, width = seen.shape[:2]
    u, v, across, down = outputs.pred_boxes[0].T * max(height, width)  # of the padded square
    beside = (u - across / 2 >= width) | (v - down / 2 >= height) | (u + across / 2 <= 0)
    expected = confidence[~(beside | (v + down / 2 <= 0))].max()
    assert score(tiny, "mug", threshold=0.0).values[0] == pytest.approx(float(expected))
    assert score(tiny, "mug").values == score(tiny, "mug").values


def test_a_scenario_names_the_network_by_a_tag(tiny):
    text = f"pipeline: {{view_selection: {{scorer: !Detector {{model: {tiny}, threshold: 0}}}}}}"
    pipeline = parse_scenario(text, "text", Scenario()).pipeline
    scorer = make_view_scorer(pipeline, seed=0)
    found = scorer.score(views(), PointCloud(0), Candidates.empty(), "axe", "use the axe")
    assert found == score(tiny, "axe", threshold=0.0)


def test_the_words_matter(tiny):
    assert score(tiny, "mug", threshold=0.0) != score(tiny, "spoon", threshold=0.0)


def test_what_is_less_sure_than_the_threshold_was_not_found(tiny):
    most = max(score(tiny, threshold=0.0).values)
    assert most < 1.0 or pytest.skip("the random network is too sure")
    scores = score(tiny, threshold=(1.0 + most) / 2)
    assert scores.values == (0.0, 0.0)
    assert "in none of 2 views" in scores.reason


class Answering:
    """A network that gives the same answer to whatever it is shown."""

    device = "cpu"

    def __init__(self, logits, pred_boxes):
        self.outputs = SimpleNamespace(logits=logits, pred_boxes=pred_boxes)

    def __call__(self, **inputs):
        assert set(inputs) == {"input_ids", "attention_mask", "pixel_values"}
        return self.outputs


def test_a_published_answer_is_read_as_it_was_published(tiny):
    import torch

    confidence = torch.tensor([score for score, _ in PUBLISHED] + [0.05])
    corners = torch.tensor([box for _, box in PUBLISHED] + [(0.0, 0.0, 640.0, 480.0)])
    middle, extent = (corners[:, :2] + corners[:, 2:]) / 2, corners[:, 2:] - corners[:, :2]
    boxes = torch.cat([middle, extent], 1) / 640  # the image is padded to a square
    answering = Answering(torch.logit(confidence)[None, :, None], boxes[None])
    network = Network(load(tiny, "cpu").processor, answering, MOST_TOKENS)
    found = network.detect(np.zeros((480, 640, 3), np.uint8), "cat", 0.1)
    assert [d.score for d in found] == pytest.approx([score for score, _ in PUBLISHED], abs=1e-6)
    for detection, (_, box) in zip(found, PUBLISHED, strict=True):
        assert detection.label == "cat"
        assert detection.box == pytest.approx(box, abs=1e-3)


def test_a_target_of_too_many_words_is_refused_not_cut_off(tiny):
    with pytest.raises(InputError, match=r"is \d+ tokens long .* reads 16: name it in fewer words"):
        score(tiny, "heavy old rusty claw hammer with a wooden handle")


def test_a_network_is_loaded_once_for_all_episodes(tiny):
    score(tiny)
    before = load.cache_info().misses
    score(tiny)
    assert load.cache_info().misses == before


# --- what is missing, or is not what it should be -----------------------------------------------


@pytest.mark.parametrize("module", ["transformers", "torch"])
def test_without_the_extra_the_command_that_installs_it_is_given(module, monkeypatch, tmp_path):
    monkeypatch.setattr(detector, "find_spec", lambda name: None if name == module else name)
    with pytest.raises(InputError, match=rf"needs {module}.* pip install 'tog_drake\[views\]'"):
        DetectorScorer(Detector(model=str(tmp_path)))


def test_without_weights_the_command_that_gets_them_is_given_and_nothing_is_downloaded(
    tmp_path, no_network, monkeypatch
):
    pytest.importorskip("huggingface_hub")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(InputError) as caught:
        find_weights(MODEL, None)
    message = str(caught.value)
    assert f"`hf download {MODEL} --revision {REVISION} --exclude '*.bin'`" in message
    assert str(tmp_path) in message
    assert "Apache-2.0" in message


def test_the_command_that_gets_weights_is_one_that_hf_understands():
    pytest.importorskip("huggingface_hub")
    hf = shutil.which("hf", path=Path(sys.executable).parent)
    done = subprocess.run([hf, "download", "--help"], capture_output=True, text=True, timeout=60)
    assert all(option in done.stdout for option in ("--revision", "--exclude", "REPO_ID"))
    assert download_command().split()[:3] == ["hf", "download", MODEL]


def test_what_was_downloaded_is_found_in_the_cache_by_its_revision(
    tiny, tmp_path, no_network, monkeypatch
):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    kept = tmp_path / f"models--{MODEL.replace('/', '--')}" / "snapshots"
    shutil.copytree(tiny, kept / REVISION)
    assert find_weights(MODEL, None) == kept / REVISION
    assert max(score(MODEL, threshold=0.0).values) > 0
    with pytest.raises(InputError, match="revision another"):
        find_weights(MODEL, "another")


@pytest.mark.parametrize("model", ["owlv2", "no/such/folder", "../x", "a b/c", "\x1b/x", ""])
def test_what_is_neither_a_folder_nor_a_name_is_refused(model):
    with pytest.raises(InputError, match="no name on Hugging Face") as caught:
        find_weights(model, None)
    assert "\x1b" not in str(caught.value)


def broken(tiny, folder, **files):
    """A copy of the tiny network with other files in it; None: without."""
    shutil.copytree(tiny, folder)
    for name, content in files.items():
        name = name.replace("_json", ".json").replace("_safetensors", ".safetensors")
        if content is None:
            (folder / name).unlink()
        else:
            (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", ["config_json", "model_safetensors"])
def test_a_folder_without_what_it_needs_says_what_that_is(name, tiny, tmp_path):
    folder = broken(tiny, tmp_path / "f", **{name: None})
    with pytest.raises(InputError, match=f"has no {name.replace('_', '.')}"):
        score(folder)


@pytest.mark.parametrize(
    "files",
    [
        {"config_json": b"{"},
        {"config_json": b'{"model_type": "gpt2"}'},
        {"config_json": b'{"model_type": "owlv2", "auto_map": {"AutoConfig": "evil.C"}}'},
        {"model_safetensors": b"not this"},
        {"model_safetensors": b"\xff" * 100},
        {"vocab_json": b"[]"},
        {"preprocessor_config_json": b"no"},
    ],
    ids=str,
)
def test_files_that_are_no_detector_are_refused_with_what_is_wrong(files, tiny, tmp_path):
    folder = broken(tiny, tmp_path / "f", **files)
    (folder / "evil.py").write_text("raise SystemExit('it ran')")
    with pytest.raises(InputError, match="holds no detector that can be loaded"):
        score(folder)


def test_weights_that_leave_a_parameter_to_chance_are_refused(tiny, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = broken(tiny, tmp_path / "f")
    weights = load_file(folder / "model.safetensors")
    weights.pop("class_head.dense0.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    with pytest.raises(InputError, match="1 of its parameters are not among the weights"):
        score(folder)


def test_pickled_weights_are_not_read(tiny, tmp_path):
    folder = broken(tiny, tmp_path / "f", model_safetensors=None)
    (folder / "pytorch_model.bin").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(InputError, match=r"has no model\.safetensors"):
        score(folder)


@pytest.mark.parametrize("device", ["cuda:99", "warp", "meta:x"])
def test_a_device_that_is_not_there_is_refused_with_one_that_is(device, tiny):
    with pytest.raises(InputError, match=f"device '{device}' cannot be used .*valid: cpu"):
        score(tiny, device=device)


@pytest.mark.parametrize("threshold", [-0.1, 1.0, float("nan")])
def test_a_threshold_that_is_no_share_is_refused(threshold, tiny):
    with pytest.raises(InputError, match=r"threshold: .*; valid: from 0 to below 1"):
        score(tiny, threshold=threshold)
