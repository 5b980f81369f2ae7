"""What `tog prompts` and `tog vlm ...` say."""

import json

import pytest
from command import refused, tog

from tog_drake.selectors import prompts
from tog_drake.selectors.prompts import names
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.profiles import PROFILES


def test_all_prompts_are_listed_with_their_versions():
    done = tog("prompts")
    assert done.status == 0
    told = dict(line.split(maxsplit=1) for line in done.out.splitlines())
    assert list(told) == [prompts.load(name).version for name in names()]
    for strategy in STRATEGIES:
        assert "question" in told[prompts.load(strategy).version]
    listed = json.loads(tog("prompts", "--json").out)
    assert listed == {name: prompts.load(name).version for name in names()}


@pytest.mark.parametrize("rendering", ["marked", "paper"])
@pytest.mark.parametrize("name", names())
def test_a_prompt_is_shown_with_every_place_filled(name, rendering):
    done = tog("prompts", name, "--rendering", rendering)
    assert done.status == 0, done.err
    assert "{" not in done.out
    assert name in ("repair", "canary") or '"hand me the hammer"' in done.out
    shown = json.loads(tog("prompts", name, "--rendering", rendering, "--json").out)
    assert shown["version"] == prompts.load(name).version
    assert shown["text"] == done.out.rstrip("\n")


def test_labels_are_those_of_the_rendering():
    assert "1, 2, 3" in tog("prompts", "gsi").out
    assert "red, green, blue" in tog("prompts", "gsi", "--rendering", "paper").out
    assert "1, 2, 3" in tog("prompts", "gmi", "--rendering", "paper").out


def test_how_to_answer_is_shown_as_the_profile_has_it():
    assert "[y, x] format normalized to 0-1000" in tog("prompts", "cpg", "--profile", "gemini").out
    assert '"avoid"' in tog("prompts", "avoid", "--profile", "gemini").out
    assert "exactly one of: 1, 2, 3" in tog("prompts", "gsi", "--profile", "gemini").out
    refused(tog("prompts", "gsi", "--profile", "mars"), "'mars'", *PROFILES)


def test_an_unknown_prompt_or_rendering_is_said_with_those_there_are():
    refused(tog("prompts", "gsj"), "'gsj'", *names())
    refused(tog("prompts", "gsi", "--rendering", "bright"), "'bright'", "marked, paper")


def test_a_text_of_ones_own_begins_as_a_copy_and_is_shown_as_it_is_sent(tmp_path):
    source = tog("prompts", "cpg", "--source").out
    assert source.rstrip() == prompts.load("cpg").source.rstrip()
    mine = tmp_path / "mine.j2"
    mine.write_text(source.replace("exactly one point", "one point, never near a blade"))
    shown = tog("prompts", "cpg", "--prompt", mine)
    assert shown.status == 0, shown.err
    assert 'Task: "hand me the hammer"' in shown.out
    assert "never near a blade" in shown.out
    told = json.loads(tog("prompts", "cpg", "--prompt", mine, "--json").out)
    assert told["version"].startswith("mine/")
    refused(tog("prompts", "--prompt", mine), "of which", *STRATEGIES)
    refused(tog("prompts", "judge", "--prompt", mine), "'judge'", *STRATEGIES)
    refused(tog("prompts", "avoid", "--prompt", tmp_path / "none.j2"), "none.j2", "cannot be read")


def test_a_text_of_ones_own_is_for_one_strategy_of_a_benchmark(tmp_path):
    mine = tmp_path / "mine.j2"
    mine.write_text("{{ task | quoted }}")
    asked = ("eval", "Mug", "--vlm", "openai:gpt-5@http://localhost:9/v1", "--prompt", mine)
    refused(tog(*asked, "--strategies", "cpg,gsi"), "--prompt", "one of --strategies")
