import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tog_drake.selectors.vlm.json_in_text import MAX_DEPTH, MAX_PYTHON, find_values, is_cut_off

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=12,
).filter(lambda value: isinstance(value, (dict, list)))


@given(value=JSON, indent=st.none() | st.just(2))
def test_any_json_is_found_alone_in_a_fence_and_after_prose(value, indent):
    text = json.dumps(value, indent=indent)
    for around in ("{}", "```json\n{}\n```", "```\n{}\n```\nDone.", 'He said "so [1" here:\n{}'):
        assert find_values(around.replace("{}", text))[0] == value
        assert not is_cut_off(around.replace("{}", text))


@given(value=JSON.filter(bool), share=st.floats(0.01, 0.99))
def test_json_without_its_end_is_cut_off(value, share):
    text = json.dumps(value)
    assert is_cut_off(text[: max(1, int(share * len(text)))])


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("nothing", []),
        ('{"a": 1} then {"a": 2}', [{"a": 2}, {"a": 1}]),
        ('{"a": 1}, {"a": 2}', [[{"a": 1}, {"a": 2}]]),
        ('{"a": 1}\n\n{"a": 2}', [[{"a": 1}, {"a": 2}]]),
        ('{"a": [1, 2,], }', [{"a": [1, 2]}]),
        ("{'a': (1, 2), 'b': None}", [{"a": (1, 2), "b": None}]),
        ('{"a": "}"}', [{"a": "}"}]),
        ('it is 5" wide: {"a": 1}', [{"a": 1}]),
        ('{"a": "\\"}"}', [{"a": '"}'}]),
        ('[unclosed, {"a": 1}', [{"a": 1}]),
        ('closed) ] {"a": 1}', [{"a": 1}]),
        ('{"a": 1] {"a": 2}', [{"a": 2}]),
        ("{1, 2}", []),
        ('{"a": NaN}', []),
        ('{"a": Infinity}', []),
        ('{"a": open("x")}', []),
        ('{"a": 1}\n```json\n{"a": 2}\n```\n{"a": 3}', [{"a": 2}]),
        ('```json\n{"a": 1}\n```\nbetter:\n```json\n{"a": 2}\n```', [{"a": 2}]),
        ('```json\n{"a": 1}\n```\n```\nno JSON\n```', [{"a": 1}]),
        ('```json\n{"a": 1}', [{"a": 1}]),
        ("[" * MAX_DEPTH + "]" * MAX_DEPTH, [json.loads("[" * MAX_DEPTH + "]" * MAX_DEPTH)]),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), []),
        ("['" + "x" * MAX_PYTHON + "']", []),
    ],
)
def test_what_is_found_comes_last_first(text, values):
    assert find_values(text) == values


@pytest.mark.parametrize(
    "text", ['{"a": 1', "[", '```json\n{"a": 1', 'Here:\n```\n[{"a": 1}', '{"a": 1}]['[:6]]
)
def test_json_that_begins_an_answer_and_does_not_end_is_cut_off(text):
    assert is_cut_off(text)


@pytest.mark.parametrize("text", ["", "text [", '{"a": 1} [', "```json\n[1]\n```\n{", "```\nx {"])
def test_other_brackets_that_are_left_open_are_prose(text):
    assert not is_cut_off(text)
