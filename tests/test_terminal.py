"""What the command prints of an episode."""

import re
import unicodedata
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from tog_drake.benchmark.tables import RATES
from tog_drake.selectors.geometric import Geometric
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.terminal import (
    console_for,
    deciding,
    print_answers,
    print_looks,
    print_rates,
    print_stages,
    print_weights,
    say,
)

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(("no_color", "coloured"), [("", True), ("1", False)])
def test_no_color_is_obeyed_on_a_terminal(no_color, coloured, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes this for a terminal
    monkeypatch.setenv("NO_COLOR", no_color)
    console = console_for(as_json=False)
    with console.status("deciding ..."):
        say(console, "chosen")
    colours = re.findall(r"\x1b\[(?:\d+;)*[349]\d(?:;\d+)*m", capsys.readouterr().out)
    assert bool(colours) == coloured


def test_nothing_is_coloured_but_by_the_one_console_that_obeys():
    for path in (ROOT / "tog_drake").rglob("*.py"):
        if path.name != "terminal.py":
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"\bConsole\(|\\x1b|\\033|secho|\bstyle\(", text), path


def printed(record):
    out = StringIO()
    print_answers(Console(file=out, width=80), record)
    return out.getvalue()


def exchange(**changes):
    return {
        "answer": "2", "status": "ok", "message": "", "model": "gpt-9", "seconds": 0.81,
        "tokens": {"input": 1200, "output": 34}, "cost": 0.00123, "replayed": None, **changes,
    }  # fmt: skip


def vlm(*exchanges, fallback=None):
    return {"vlm": {"model": "openai:gpt", "fallback": fallback, "exchanges": list(exchanges)}}


def test_one_line_says_what_a_model_answered_and_what_it_took():
    assert printed(vlm(exchange())) == (
        'model: gpt-9 answered "2" in 0.8 s, 1,234 tokens, $0.0012\n'
    )
    assert printed({"vlm": None}) == ""


def test_it_says_what_is_wrong_with_an_answer_and_who_chose_instead():
    useless = exchange(answer="nine", status="unreadable", message="no label", cost=None)
    silent = exchange(answer=None, status="timed_out", message="60 s", model=None, tokens=None)
    assert printed(vlm(useless, silent, fallback="geometric")).splitlines() == [
        'model: gpt-9 answered "nine" (unreadable: no label) in 0.8 s, 1,234 tokens, price unknown',
        "model: openai:gpt did not answer (timed_out: 60 s) in 0.8 s, $0.0012",
        "fallback: geometric chose, because the model's answer was no use",
    ]


def test_of_a_failure_that_is_replayed_nothing_more_is_known():
    lost = exchange(answer=None, replayed="c.jsonl", seconds=0, tokens=None, cost=None)
    assert printed(vlm(lost)) == "model: gpt-9 did not answer (replayed from c.jsonl)\n"


def test_a_replayed_answer_is_not_told_as_if_it_were_live():
    assert printed(vlm(exchange(replayed="c.jsonl"), exchange(replayed="c.jsonl", seconds=0))) == (
        'model: gpt-9 answered "2" '
        "(replayed from c.jsonl; when asked 0.8 s, 1,234 tokens, $0.0012)\n"
        'model: gpt-9 answered "2" (replayed from c.jsonl; when asked 1,234 tokens, $0.0012)\n'
    )


@pytest.mark.parametrize(
    ("asked", "line"), [(vlm(), "the model: rejected"), ({"vlm": None}, "status: rejected")]
)
def test_what_became_of_the_question_is_not_taken_for_the_outcome(asked, line):
    choice = {"part": None, "index": 7, "reason": "So it is.", "status": "rejected"}
    record = {
        "task": "lift it", "proposer": {"kind": "antipodal"}, "counts": {}, "seconds": {},
        "attempts": [{"looks": []}],
        "view_selection": None,
        "alignment": None,
        "choice": choice, "held": {},
        "outcome": "lifted", "turned": None, "message": None, "collisions": None, **asked,
    }  # fmt: skip
    out = StringIO()
    print_stages(Console(file=out, width=80), record)
    assert out.getvalue().splitlines()[-3:] == [
        "choice: grasp 7. So it is.",
        line,
        "outcome: lifted",
    ]


def test_one_is_told_whom_one_waits_for():
    model = OpenAi(model="llava\x1b", base_url="http://gpu:8000/v1")
    assert deciding(Vlm(model=model, deadline=30)) == (
        "asking llava\\u001b at gpu:8000 (at most 30 s)"
    )
    assert deciding(Vlm(model=model, replay="c.jsonl")) == "deciding"
    assert deciding(Geometric()) == "deciding"


def test_of_a_long_answer_the_end_is_shown_where_the_choice_is():
    line = printed(vlm(exchange(answer="I think.\n" * 10_000 + '"choice": "2"')))
    assert len(line) < 250
    assert '"choice": "2"" in' in line


@pytest.mark.parametrize("hostile", ["\x1b[2J\x1b]0;gone\x07", "\u202etxet", "\r\x08\x7f\x9b1m"])
def test_control_characters_are_shown_and_not_obeyed(hostile):
    line = printed(vlm(exchange(answer=hostile, model=hostile, status="refused", message=hostile)))
    assert line.count("\n") == 1
    assert not [c for c in line[:-1] if unicodedata.category(c).startswith("C")]


def test_a_line_is_one_line_and_markup_is_none():
    out = StringIO()
    say(Console(file=out, width=20, markup=False), "[red]a\nb " + "long " * 10)
    assert out.getvalue() == "[red]a\\u000ab " + "long " * 10 + "\n"


def test_the_weights_of_a_network_are_named_and_what_they_are_worth():
    out = StringIO()
    weights = {"file": "\x1b[2J.pt", "note": "not the released checkpoint"}
    print_weights(Console(file=out, width=80), weights)
    print_weights(Console(file=out, width=80), None)
    (line,) = out.getvalue().splitlines()
    assert line.startswith("weights: ") and line.endswith(".pt, not the released checkpoint")
    assert "\x1b" not in line


def test_every_further_look_is_a_line_and_so_is_why_there_was_no_other():
    X_WC = [[1, 0, 0, 0.5], [0, 1, 0, -0.25], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    looks = [
        {"X_WC": X_WC, "duration": 1.9, "reason": "About 12% of it is shown."},
        {"X_WC": None, "duration": None, "reason": "No further look would add more than 15%."},
    ]
    out = StringIO()
    print_looks(Console(file=out, width=80), {"attempts": [{"looks": looks}]})
    first, second = out.getvalue().splitlines()
    assert first.startswith("looked again from (0.50, -0.25, 0.30) m, 1.9 s away: About 12%")
    assert second == "No further look would add more than 15%."


def test_on_a_narrow_terminal_nothing_of_a_table_is_lost():
    rates = {name + end: 0.25 for name in RATES for end in ("", "_low", "_high")}
    row = {"method": "contact-graspnet, geometric", "group": "handover", "n": 1, "tasks": 2}
    out = StringIO()
    print_rates(Console(file=out, width=80), [{**row, **rates, "collisions": 0, "failures": ""}])
    told = out.getvalue()
    assert "…" not in told
    assert max(map(len, told.splitlines())) <= 80
    assert told.count("0.25–") == len(RATES)
    head, below = told.split("─\n")
    wide = next(line.index("group") for line in head.splitlines() if "group" in line)
    method = "".join(line[:wide].strip() for line in below.splitlines())
    assert method.replace(" ", "") == "contact-graspnet,geometric"
