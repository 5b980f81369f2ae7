"""The texts that a model is sent."""

import hashlib
import json
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.selectors import prompts
from tog_drake.selectors.strategies import STRATEGIES, own_prompt
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
    with pytest.raises(InputError, match=r"gsi/1 .*'labels' is undefined.*count, rendering, task"):
        prompts.load("gsi").render(task="use it", rendering="paper", count=3)


def test_an_unknown_prompt_is_refused_with_the_names_that_there_are():
    with pytest.raises(InputError, match=r"'gpt'; valid: avoid, .*gsi"):
        prompts.load("gpt")


# --- a text of one's own ------------------------------------------------------------------------


def mine(folder, text, name="mine.j2"):
    file = folder / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return file


@pytest.mark.parametrize("rendering", ["marked", "paper"])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_the_text_of_a_strategy_can_be_copied_and_changed(strategy, rendering, tmp_path):
    source = prompts.load(strategy).source
    same = own_prompt(mine(tmp_path, source), strategy, rendering)
    values = VALUES | {"rendering": rendering}
    assert same.render(**values) == rendered(strategy, rendering)
    changed = own_prompt(mine(tmp_path, source + "Hurry."), strategy, rendering)
    assert changed.render(**values) == rendered(strategy, rendering) + "\nHurry."
    assert changed.version.startswith("mine/")
    assert changed.version != same.version


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Point at it.", "leaves the task out.*task | quoted"),
        ("Task: {{ task }}", "leaves the task out"),  # as data, in quotes
        ("{{ task | quoted }} {{ labels }}", "'labels' is undefined; its places may be: task$"),
        ("{{ task | quoted }} {% if", "line 1: "),
        ("{{ task | quoted }}\n{{ task | shouted }}", "line 2: No filter named 'shouted'"),
        ("{% include '/etc/passwd' %} {{ task | quoted }}", "no loader"),
        ("{{ task.__class__.__mro__ }} {{ task | quoted }}", "unsafe"),
        ("{% for i in range(10**9) %}{% endfor %}{{ task | quoted }}", "Range too big"),
        ("{{ task | quoted }} {{ 1 // 0 }}", "division"),
        (b"\xff\xfe", "UTF-8"),
        (b" " * 50_001, "more than 50000 bytes"),
    ],
)
def test_a_text_that_cannot_be_asked_by_is_refused_with_what_to_write(text, said, tmp_path):
    with pytest.raises(InputError, match=said):
        own_prompt(mine(tmp_path, text), "cpg", "marked")


def test_a_text_that_is_not_there_is_refused_by_its_name(tmp_path):
    with pytest.raises(InputError, match=r"none\.j2 cannot be read: No such file"):
        own_prompt(tmp_path / "none.j2", "cpg", "marked")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        own_prompt(tmp_path, "cpg", "marked")


@settings(max_examples=50)
@given(text=st.text(max_size=200))
def test_whatever_a_file_holds_it_is_a_prompt_or_refused(text, tmp_path_factory):
    file = mine(tmp_path_factory.mktemp("own"), text + "{{ task | quoted }}")
    try:
        prompt = own_prompt(file, "cpg", "marked")
    except InputError:
        return
    assert '"hand me the hammer"' in prompt.render(task="hand me the hammer")
