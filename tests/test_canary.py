"""The canary: an image whose answer is known tells what a model and its profile are good for."""

import json
import time

import numpy as np
import pytest
from canary_model import TOLD, seeing
from command import refused, tog
from vlm_server import KEY, KEY_VARIABLES, VlmServer, hang, html, says, status

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.selectors.vlm.canary import HEIGHT, WIDTH, draw_canary, right_profiles
from tog_drake.selectors.vlm.profiles import PROFILES
from tog_drake.selectors.vlm.question import Points


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)


def check(server, *arguments, provider="openai"):
    """Runs ``tog vlm check``; returns what a shell shows, and the findings."""
    done = tog("vlm", "check", "--vlm", server.specification(provider), *arguments, "--json")
    said = json.loads(done.out) if done.out else {"findings": {}}
    return done, {name: (f["ok"], f["found"]) for name, f in said["findings"].items()}


@pytest.mark.parametrize("seed", range(6))
def test_the_canary_shows_what_is_true_of_it(seed):
    truth = draw_canary(seed)
    colors = dict(CANDIDATE_COLORS)
    u, v = map(round, truth.pixel)
    assert truth.image.shape == (HEIGHT, WIDTH, 3)
    assert tuple(truth.image[v, u]) == colors[truth.target]
    rows, columns = np.nonzero((truth.image == colors[truth.target]).all(axis=2))
    if truth.target != "white":  # the plate of the number is white, too
        assert (columns.mean(), rows.mean()) == pytest.approx(truth.pixel, abs=0.5)
    assert truth.number in truth.numbers and truth.numbered != truth.target
    assert np.array_equal(draw_canary(seed).image, truth.image)
    assert not np.array_equal(draw_canary(seed + 1).image, truth.image)


@pytest.mark.parametrize("provider", KEY_VARIABLES)
def test_a_model_that_sees_and_points_is_well_by_every_protocol(provider):
    with VlmServer(seeing()) as server:
        done, found = check(server, provider=provider)
    assert done.status == 0, done
    assert list(found) == [
        "reachable", "sees the number", "structured output", "sees the colour",
        "points within 20 pixels",
    ]  # fmt: skip
    assert found["reachable"] == (True, "served-model-1 answers")
    assert found["structured output"] == (True, "honoured")
    assert "0.0 pixels from the centre, read as pixels" in found["points within 20 pixels"][1]
    assert KEY not in done.out + done.err
    assert " tokens, " in done.err


@pytest.mark.parametrize("used", TOLD)
@pytest.mark.parametrize("told", TOLD)
def test_an_answer_is_right_in_its_own_convention_alone(told, used):
    point = Points(("disc",), (WIDTH, HEIGHT))
    pixels = {"qwen2.5-vl", "gpt", "claude", "pixels"}  # the same for an image of this size
    for seed in range(2):
        truth = draw_canary(seed)
        text = TOLD[told](*truth.pixel).replace("%", "")
        right = right_profiles(text, point, truth.pixel, "")
        assert told in right
        assert (used in right) == (used == told or {used, told} <= pixels), (right, text)


@pytest.mark.parametrize(
    ("told", "used", "right"),
    [
        ("gemini", "qwen3-vl", "gemini (gemma"),  # transposed
        ("qwen3-vl", "gemini", "qwen2-vl (qwen3-vl"),
        ("qwen3-vl", "pixels", "qwen2-vl (qwen3-vl"),  # another scale
        ("gpt", "qwen3-vl", "pixels (robobrain-2.0, qwen2.5-vl"),
        ("molmo2", "molmo", "molmo2"),
    ],
)
def test_a_wrong_profile_is_found_and_the_right_ones_named(told, used, right):
    with VlmServer(seeing(told)) as server:
        done, found = check(server, "--profile", used)
    assert done.status == 1
    assert found["sees the number"][0] is found["sees the colour"][0] is True
    ok, said = found["points within 20 pixels"]
    assert not ok
    assert f"the same answer is right if it is read as {right.split()[0]}" in said
    assert f"try --profile {right}" in said
    assert ("equal for pointing)" in said) == ("(" in right)


def test_a_relative_of_the_model_is_proposed_first():
    text = '{"points": [{"point": [250, 500], "label": "disc"}]}'
    sought = Points(("disc",), (1000, 1000)), (250.0, 500.0)
    named = {
        model: right_profiles(text, *sought, model)[0] for model in ("my-qwen", "gpt-x", "llava")
    }
    assert named == {"my-qwen": "qwen2.5-vl", "gpt-x": "gpt-4", "llava": "pixels"}


def test_after_a_refusal_nothing_is_said_of_what_was_not_tested():
    with VlmServer(seeing()) as server:
        server.misbehave(says(text=None, refusal="No."), always=True)
        done, found = check(server)
    assert done.status == 1
    assert found["structured output"] == (False, "not tested: refused")
    assert found["points within 20 pixels"][1].startswith("refused: ")
    assert "profile reads" not in found["points within 20 pixels"][1]


def test_a_transposed_point_that_fits_no_profile_is_said_so():
    u, v = draw_canary(0).pixel
    with VlmServer(seeing(pixel=(u + 60, v))) as server:
        done, found = check(server)
    assert done.status == 1
    assert found["points within 20 pixels"] == (
        False, "60.0 pixels from the centre, read as pixels; no other profile reads it right"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "finding", "said"),
    [
        ({"number": "58"}, "sees the number", "said 58, it is 11"),
        ({"colour": "red"}, "sees the colour", "said red, it is yellow"),
        ({"colour": "mauve"}, "sees the colour", "unreadable: "),
    ],
)
def test_a_model_that_does_not_see_is_found_out(wrong, finding, said):
    with VlmServer(seeing(**wrong)) as server:
        done, found = check(server)
    assert done.status == 1
    assert found[finding][0] is False
    assert found[finding][1].startswith(said)
    assert found["points within 20 pixels"][0] is True


def test_text_around_an_answer_is_told_but_no_problem():
    answer = seeing()
    with VlmServer(lambda text, images: "I see.\n" + answer(text, images)) as server:
        done, found = check(server)
    assert done.status == 0
    assert found["structured output"][0] is False
    assert "missing  structured output: not honoured" in done.err


@pytest.mark.parametrize(
    ("mishap", "said", "deadline"),
    [
        (status(401), "rejected: ", "10"),
        (status(404), "rejected: ", "10"),
        (html(200), "unreachable: ", "10"),
        (hang, "timed_out: ", "0.3"),
    ],
)
def test_a_server_that_does_not_answer_is_said_once_and_in_time(mishap, said, deadline):
    with VlmServer(seeing()) as server:
        server.misbehave(mishap, always=True)
        start = time.monotonic()
        done, found = check(server, "--deadline", deadline)
        assert time.monotonic() - start < 20.0  # no measure of speed: it hangs for good otherwise
    assert done.status == 1
    assert list(found) == ["reachable"]
    assert found["reachable"][0] is False
    assert found["reachable"][1].startswith(said)


def test_what_a_model_says_cannot_steer_the_terminal():
    hostile = "\x1b[2J\x07 \u202e" + 3 * "</script>"
    with VlmServer(lambda text, images: hostile, model="\x1b]0;x\x07") as server:
        done = tog("vlm", "check", "--vlm", server.specification("openai"))
    assert done.status == 1
    assert not {"\x1b", "\x07", "\u202e"} & set(done.out + done.err)


def test_no_key_and_an_unknown_model_are_said_before_anything_is_sent(monkeypatch):
    monkeypatch.delenv("ANTHROPIC_API_KEY")
    refused(tog("vlm", "check", "--vlm", "anthropic:claude-sonnet-5-5"), "ANTHROPIC_API_KEY")
    refused(tog("vlm", "check", "--vlm", "openai:m@http://127.0.0.1:9/v1"), "'m'", *PROFILES)
    replayed = tog("vlm", "check", "--vlm", "replay:x.jsonl")
    refused(replayed, "replay:x.jsonl", "openai:MODEL")
    assert "replay" not in replayed.err.split("valid:")[1]
