import contextlib
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.selectors.vlm import profiles
from tog_drake.selectors.vlm.profiles import PROFILES, find_profile, load_profiles

FILE = Path(profiles.__file__).with_name("profiles.yaml")

NAMES = {
    "gemini": ["gemini-3.8-flash", "models/gemini-2.5-pro", "gemini-robotics-er-2-preview",
               "google/gemini-3.1-pro-preview"],
    "gemma": ["gemma3:27b", "google/gemma-3-12b-it", "gemma-4-27b"],
    "qwen2-vl": ["Qwen/Qwen2-VL-7B-Instruct", "qwen2-vl-72b-instruct-awq"],
    "qwen2.5-vl": ["Qwen/Qwen2.5-VL-7B-Instruct", "qwen2.5vl:7b", "Qwen2_5-VL-3B-GGUF:Q4_K_M",
                   "accounts/fireworks/models/qwen2p5-vl-32b-instruct", "Qwen2.5-Omni-7B"],
    "qwen3-vl": ["qwen/qwen3-vl-8b", "qwen3-vl:8b-instruct-q4_K_M", "Qwen3-VL-235B-A22B-FP8",
                 "hf.co/unsloth/Qwen3-VL-8B-Instruct-GGUF:Q4_K_M", "qwen3.5-plus", "Qwen3.8-Flash"],
    "molmo": ["allenai/Molmo-7B-D-0924", "GraspMolmo", "molmo"],
    "molmo2": ["allenai/Molmo2-8B", "molmo-2-4b"],
    "glm-v": ["glm-4.5v", "zai-org/GLM-4.6V-Flash", "THUDM/GLM-4.1V-9B-Thinking"],
    "internvl": ["OpenGVLab/InternVL3-8B", "InternVL2_5-26B", "internvl3.5:14b"],
    "robopoint": ["wentao-yuan/robopoint-v1-vicuna-v1.5-13b"],
    "robobrain-2.0": ["BAAI/RoboBrain2.0-7B"],
    "grok": ["grok-4", "x-ai/grok-4-fast"],
    "muse": ["meta/muse-spark"],
    "gpt-4": ["gpt-4o", "openai/gpt-4o-mini-2024-07-18", "chatgpt-4o-latest", "gpt-4.1-nano"],
    "gpt-5": ["gpt-5", "gpt-5-mini-2025-08-07", "gpt-5.1", "openai/gpt-5.1-chat"],
    "gpt": ["gpt-5.2", "gpt-5.4-mini", "gpt-5.6-sol", "gpt-6-luna", "openai/gpt-6.1-terra"],
    "claude": ["claude-opus-4-6", "claude-sonnet-4-20250514", "claude-haiku-4-5",
               "claude-3-7-sonnet-latest", "anthropic/claude-opus-4.1"],
    "claude-high": ["claude-opus-4-7", "claude-opus-4.8", "claude-sonnet-5", "claude-opus-5-5",
                    "us.anthropic.claude-sonnet-5-5-v1:0", "claude-haiku-5-5", "claude-fable-5-2"],
    "pixels": ["any", "ANY"],
}  # fmt: skip


def test_every_profile_has_names_to_be_found_by():
    assert set(NAMES) == set(PROFILES)


@pytest.mark.parametrize(("model", "name"), [(m, name) for name in NAMES for m in NAMES[name]])
def test_a_model_has_the_profile_of_its_family(model, name):
    assert find_profile(model).name == name
    assert find_profile(model.upper()).name == name
    if name != "pixels":  # `any` is no part of a name
        assert find_profile(f"some-vendor/{model}").name == name
        assert find_profile(f"{model}-int4").name == name


@pytest.mark.parametrize(
    "model",
    ["", "my-model", "allenai/MolmoPoint-8B", "paligemma2-3b", "qwen-vl-max", "qwen3-8b", "o4-mini",
     "RoboBrain2.5-8B", "llava-1.6", "anything", "any-model", "gpt-oss-120b", "gpt-4-turbo",
     "company", "glm-4.6", "notgemini"],
)  # fmt: skip
def test_an_unknown_model_must_have_its_profile_named(model):
    with pytest.raises(InputError, match="--profile") as failure:
        find_profile(model)
    assert all(name in str(failure.value) for name in PROFILES)
    assert find_profile(model, "Gemini").name == "gemini"


def test_a_named_profile_is_taken_whatever_the_model():
    assert find_profile("gpt-6-sol", "qwen3-vl").name == "qwen3-vl"


@pytest.mark.parametrize("named", ["", "gemini-2", "GPT 5"])
def test_a_profile_that_is_not_there_is_refused_with_those_that_are(named):
    with pytest.raises(InputError, match="claude-high") as failure:
        find_profile("gemini-3.8-flash", named)
    assert repr(named) in str(failure.value)


@given(model=st.text(max_size=60))
def test_any_name_has_a_profile_or_an_input_error(model):
    with contextlib.suppress(InputError):
        assert find_profile(model).name in PROFILES


def test_every_entry_says_how_sure_it_is():
    text = FILE.read_text(encoding="utf-8")
    entries = re.split(r"^(?=[a-z0-9.-]+:)", text, flags=re.MULTILINE)[1:]
    assert len(entries) == len(PROFILES)
    for entry in entries:
        name = entry.partition(":")[0]
        assert re.search(r"#.*\[[PDISU]\b|#.*the same|#.*no family", entry), name


GOOD = """
mine:
  models: [mine]
  order: xy
  scale: 1000
  formats: [json]
  key: point
  structured: true
  prompt: Coordinates are from 0 to 1000.
"""


@pytest.mark.parametrize(
    ("given_", "wrong", "message"),
    [
        (GOOD, "- a list", "maps names to profiles"),
        (GOOD, "", "no profiles"),
        (GOOD, "mine: [", "cannot read"),
        (GOOD, "mine: text", "mine: unknown text"),
        ("  order: xy\n", "  axes: xy\n", "unknown axes"),
        ("  order: xy\n", "", "order missing"),
        ("order: xy", "order: yz", "order: 'yz'; use xy or yx"),
        ("scale: 1000", "scale: many", "scale: 'many'"),
        ("scale: 1000", "scale: 0", "scale: 0"),
        ("scale: 1000", "scale: true", "scale: True"),
        ("scale: 1000", "scale: .nan", "scale: nan"),
        ("formats: [json]", "formats: [xml]", "formats: 'xml'; use json or"),
        ("formats: [json]", "formats: []", "formats: "),
        ("key: point\n", "key: spot\n", "key: 'spot'"),
        ("  key: point\n", "", "key missing"),
        ("structured: true", "structured: yes please", "structured"),
        ("models: [mine]", "models: ['(']", "no regular expression"),
        ("models: [mine]", "models: mine", "models: 'mine'; give text"),
        ("prompt: Coordinates are from 0 to 1000.", "prompt: 7", "prompt"),
        (
            "  key:",
            "  resize: {rule: fit, patch: 28, edge: 56, tokens: 4}\n  key:",
            "it matters only where pixels are told",
        ),
        ("scale: 1000", "scale: pixel\n  resize: {rule: crop}", "rule: 'crop'; use smart or fit"),
        ("scale: 1000", "scale: pixel\n  resize: 7", "rule: None"),
        ("scale: 1000", "scale: pixel\n  max_side: 0", "max_side: 0"),
        (
            "scale: 1000",
            "scale: 1000\n  max_side: 2048",
            "max_side: 2048; a whole number, where pixels are told",
        ),
        (
            "scale: 1000",
            "scale: pixel\n  resize: {rule: fit, patch: 28, edge: 0, tokens: 5}",
            "whole numbers above 0",
        ),
        (
            "scale: 1000",
            "scale: pixel\n  resize: {rule: fit, patch: 28}",
            "give patch, edge, tokens",
        ),
    ],
)
def test_a_wrong_entry_is_refused_with_the_place_and_what_is_valid(
    tmp_path, given_, wrong, message
):
    path = tmp_path / "profiles.yaml"
    path.write_text(GOOD, encoding="utf-8")
    assert load_profiles(path)["mine"].scale == 1000
    path.write_text(GOOD.replace(given_, wrong), encoding="utf-8")
    with pytest.raises(InputError, match=re.escape(message)) as failure:
        load_profiles(path)
    assert str(path) in str(failure.value)


def test_a_file_that_is_not_there_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot read the profiles"):
        load_profiles(tmp_path / "none.yaml")
