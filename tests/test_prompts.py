"""The texts that a model is sent."""

import hashlib
import json
import re

import jinja2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.selectors import prompts
from tog_drake.selectors.vlm.answers import VERSION, instruction, schema
from tog_drake.selectors.vlm.profiles import PROFILES
from tog_drake.selectors.vlm.question import Options, Points

VALUES = {
    "task": "hand me the hammer",
    "target": "red mug",
    "labels": ("1", "2", "3"),
    "count": 3,
    "round": 1,
    "rounds": 3,
    "problem": "no number in it",
    "answer": "well ...",
    "question": "point",
    "color": "red",
}
ASKING = [name for name in prompts.names() if name not in ("canary", "repair")]
# Of everything that a model is told: a text that changes needs a new version, and a new line here.
HASHES = {
    "avoid/1": "bce9b0a5642247b7",
    "canary/1": "93ceae4afb97fe6f",
    "cpg/1": "6fa7953f8ee43877",
    "cpmi/1": "9033412b42363049",
    "cpsi/1": "f77c23799fb44a80",
    "gmi/1": "e5a845d66bcd3737",
    "gsi/1": "c2be41742b5e4196",
    "judge/1": "96c1578ec65111b9",
    "pivot/1": "871388c2a44f41c2",
    "repair/1": "f98a9ab7570486d2",
    "view/1": "9094662dd68702f9",
    "answer/1": "c0483dd76b0c1803",
}


def rendered(name, rendering="marked", **values):
    return prompts.load(name).render(**{**VALUES, "rendering": rendering, **values})


def _hash(text):
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def test_no_text_changes_without_a_new_version():
    asked = [Options(("1", "2")), Points(("grasp",), (640, 480)), Points(("a", "b"), (64, 48))]
    told = [
        [name, instruction(profile, expects), schema(profile, expects)]
        for name, profile in sorted(PROFILES.items())
        for expects in asked
    ]
    loaded = [prompts.load(name) for name in prompts.names()]
    comment = r"\{#.*#\}\n"  # is not sent
    hashes = {prompt.version: _hash(re.sub(comment, "", prompt.source)) for prompt in loaded}
    assert {**hashes, VERSION: _hash(json.dumps(told))} == HASHES


@pytest.mark.parametrize("question", ["number", "colour", "point"])
def test_the_canary_asks_one_thing_at_a_time(question):
    text = rendered("canary", question=question)
    assert len(text.splitlines()) == 1
    assert ("the red disc" in text) == (question == "point")


@pytest.mark.parametrize("name", prompts.names())
def test_every_prompt_has_its_name_and_version_in_its_first_line(name):
    prompt = prompts.load(name)
    assert prompt.source.splitlines()[0] == f"{{# {prompt.version} #}}"
    assert prompt.version.split("/")[0] == name
    assert int(prompt.version.split("/")[1]) >= 1


@pytest.mark.parametrize("rendering", ["marked", "paper"])
@pytest.mark.parametrize("name", prompts.names())
def test_a_rendered_prompt_is_plain_text_without_anything_of_the_template(name, rendering):
    text = rendered(name, rendering)
    assert text == text.strip()
    assert not set("{}") & set(text), text
    assert "#" not in text


@pytest.mark.parametrize("name", ASKING)
@settings(max_examples=30)
@given(task=st.text(min_size=1, max_size=200))
def test_whatever_the_task_contains_it_is_one_string_in_quotes(name, task):
    (line,) = (line for line in rendered(name, task=task).split("\n") if line.startswith('Task: "'))
    assert json.loads(line.removeprefix("Task: ")) == task


@pytest.mark.parametrize("name", ["gsi", "cpsi", "pivot"])
def test_marked_asks_for_a_number_and_paper_for_a_colour(name):
    assert "answer with the number" in rendered(name, labels=("1", "2"))
    paper = rendered(name, "paper", labels=("red", "green"))
    assert "answer with the colour" in paper
    assert "red, green" in paper
    assert "number" not in paper


@pytest.mark.parametrize("name", ["gmi", "cpmi"])
@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_with_a_picture_for_each_the_number_of_the_picture_is_asked_for(name, rendering):
    text = rendered(name, rendering)
    assert "the number of the image" in text
    assert "image 1, 2, 3" in text


def test_a_value_that_is_missing_is_an_error_and_not_a_gap():
    with pytest.raises(jinja2.UndefinedError, match="labels"):
        prompts.load("gsi").render(task="use it", rendering="paper", count=3)


def test_an_unknown_prompt_is_refused_with_the_names_that_there_are():
    with pytest.raises(InputError, match=r"'gpt'; valid: avoid, .*gsi"):
        prompts.load("gpt")
