from pathlib import Path

import pytest
import yaml

import tog_drake
from tog_drake.errors import InputError
from tog_drake.lexicon import LEXICON, load_lexicon
from tog_drake.object_parts import load_parts
from tog_drake.resources import resource_dir
from tog_drake.task import read_task

FILE = Path(tog_drake.__file__).with_name("lexicon.yaml")
OBJECTS = sorted((resource_dir("models") / "objects").glob("*/parts.yaml"))


@pytest.mark.parametrize("path", OBJECTS, ids=[path.parent.name for path in OBJECTS])
def test_every_part_of_every_object_can_be_asked_for_by_each_of_its_words(path):
    labels = load_parts(path)
    for part, words in labels.part_words.items():
        for word in words:
            task = f"pick up the {labels.words[0]} by its {word}"
            assert labels.allowed(task) == {part}, task


@pytest.mark.parametrize("path", OBJECTS, ids=[path.parent.name for path in OBJECTS])
def test_every_object_is_known_by_each_of_its_words(path):
    for name in load_parts(path).words:
        assert read_task(f"pick up the {name}").objects[0] in LEXICON.rules, name


def _edited(tmp_path, edit):
    content = yaml.safe_load(FILE.read_text())
    edit(content)
    path = tmp_path / "lexicon.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_noun_is_taught_by_a_line_in_the_file(tmp_path):
    path = _edited(
        tmp_path, lambda c: c["objects"].update(tongs={"kind": "tool", "words": ["bbq tongs"]})
    )
    lexicon = load_lexicon(path)
    assert lexicon.rules["tongs"].kind == "tool"
    assert lexicon.phrases["bbq", "tongs"] == "bbq tongs"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda c: c.pop("colours"), r"missing: \['colours'\]"),
        (lambda c: c.update(color={}), r"unknown: \['color'\]"),
        (lambda c: c["objects"].update(tongs={"kind": "gadget"}), "tongs: kind 'gadget'.*vessel"),
        (lambda c: c["objects"].update(tongs={"sort": "tool"}), r"tongs must have \['kind'\]"),
        (lambda c: c["objects"].update(tongs={"kind": "tool", "words": ["mug"]}), "'mug'.*twice"),
        (lambda c: c["parts"]["tail"].append("handle"), "'handle' stands for both"),
        (lambda c: c["parts"].update(tail=[False]), "quote 'no'"),
        (lambda c: c["parts"]["head"].append("face"), "parts: head: 'face' stands twice"),
        (lambda c: c["fillers"].append("both"), "fillers: 'both' stands twice"),
    ],
)
def test_a_lexicon_that_is_wrong_is_refused_with_where_and_why(tmp_path, edit, message):
    with pytest.raises(InputError, match=message):
        load_lexicon(_edited(tmp_path, edit))


def test_a_lexicon_that_is_not_there_or_no_yaml_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot read the lexicon"):
        load_lexicon(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("{")
    with pytest.raises(InputError, match="cannot read the lexicon"):
        load_lexicon(tmp_path / "bad.yaml")
