"""Text from outside can neither steer a terminal nor turn a page around."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tog_drake.visible_text import quoted, visible

ANY_TEXT = st.text(st.characters())  # lone surrogates, controls and overrides among them


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("hand me the hammer", "hand me the hammer"),
        ("größer 锤子 🔨", "größer 锤子 🔨"),
        ("\x1b[2J", "\\u001b[2J"),
        ("a\u202eb\u2066", "a\\u202eb\\u2066"),
        ("two\nlines\r", "two\\u000alines\\u000d"),
        ("\ud800", "\\ud800"),
        ("\U000e0041", "\\U000e0041"),  # a tag: an invisible letter
        ("\u2028", "\\u2028"),
    ],
)
def test_what_would_be_obeyed_is_shown(text, shown):
    assert visible(text) == shown


def test_line_breaks_stay_where_they_are_wanted():
    assert visible("a\n\tb\r\x0b", lines=True) == "a\n\tb\\u000d\\u000b"


def test_long_text_is_cut_and_what_is_missing_is_counted():
    assert visible("x" * 100_000, limit=10) == "x" * 10 + " … (99,990 more characters)"
    assert visible("x" * 10, limit=10) == "x" * 10


@given(ANY_TEXT)
def test_no_text_keeps_a_hidden_character_and_all_can_be_written(text):
    shown = visible(text)
    shown.encode()
    assert not any(unicodedata.category(c)[0] == "C" for c in shown)
    assert visible(shown) == shown


@given(ANY_TEXT)
def test_what_is_quoted_is_one_printable_line(text):
    line = quoted(text)
    assert line.isprintable()
    assert len(line) < 12 * 200 + 50
    line.encode()
