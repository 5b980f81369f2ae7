import json
import re
from copy import deepcopy

import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_folder import make_exchange, make_line, write_run

from tog_drake.benchmark import journal as journal_module
from tog_drake.benchmark.detail_sheets import detail_sheets
from tog_drake.benchmark.gallery import Pictures, Replays, cards
from tog_drake.benchmark.journal import (
    EPISODES,
    REJECTED,
    RUN,
    SCHEMA,
    Journal,
    Result,
    differences,
    read_run,
)
from tog_drake.benchmark.report import command
from tog_drake.benchmark.success_sheets import success_sheets
from tog_drake.benchmark.view_sheets import view_sheets
from tog_drake.errors import InputError

CONFIG = {"schema": SCHEMA, "suite": "builtin", "seeds": 2, "objects": {"hammer": "ab"}}


def lines_of(number, tasks=("use it",), **record):
    """The lines of an episode."""
    of_all = {"name": f"cell-{number}", "tasks": len(tasks), **record}
    return [make_line(number, task=task, **of_all) for task in tasks]


def test_a_run_is_read_in_its_order_whatever_the_order_in_which_episodes_ended(tmp_path):
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(lines_of(2)))
        journal.append(Result(lines_of(0, ("use it", "hand it over"))))
        assert [line["cell"]["number"] for line in journal.lines] == [0, 0, 2]
    run = read_run(tmp_path)
    assert run.config == CONFIG
    assert [line["cell"]["task"] for line in run.lines] == ["use it", "hand it over", "use it"]
    assert [line["cell"]["number"] for line in run.lines] == [0, 0, 2]


def test_a_run_is_taken_up_wherever_its_file_was_cut(tmp_path):
    both = [lines_of(0), lines_of(1, ("use it", "hand it over"), message="naïve")]
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(both[0]))
        journal.append(Result(both[1]))
    path = tmp_path / EPISODES
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for length in sorted({*range(0, len(whole), 97), first - 1, first, len(whole) - 1, len(whole)}):
        path.write_bytes(whole[:length])
        seen = read_run(tmp_path).lines
        assert path.read_bytes() == whole[:length]  # who reads changes nothing
        with Journal(tmp_path, CONFIG) as journal:
            assert journal.lines == seen
            done = {line["cell"]["number"] for line in journal.lines}
            for number, lines in (
                (0, lines_of(0)),
                (1, lines_of(1, ("use it", "hand it over"), message="naïve")),
            ):
                if number not in done:
                    journal.append(Result(lines))
        assert done == ({0, 1} if length == len(whole) else {0} if length >= first else set())
        assert path.read_bytes() == whole


def test_a_last_line_that_is_no_json_is_cut_off(tmp_path):
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(lines_of(0)))
    with (tmp_path / EPISODES).open("ab") as file:
        file.write(b"\0\0\0\0\n")
    with Journal(tmp_path, CONFIG) as journal:
        assert len(journal.lines) == 1
    assert (tmp_path / EPISODES).read_bytes().count(b"\n") == 1


@pytest.mark.parametrize("damage", [b"{}\n", b"[1]\n", b"nonsense\n", b'{"cell": {"tasks": 1}}\n'])
def test_damage_before_the_end_is_told_and_nothing_is_cut(tmp_path, damage):
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(lines_of(0)))
    path = tmp_path / EPISODES
    path.write_bytes(damaged := damage + path.read_bytes())
    for read in (read_run, lambda folder: Journal(folder, CONFIG)):
        with pytest.raises(InputError, match=rf"{EPISODES}, line 1: .*--fresh"):
            read(tmp_path)
    assert path.read_bytes() == damaged


def test_another_configuration_is_refused_with_what_differs(tmp_path):
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(lines_of(0)))
    asked = {**CONFIG, "seeds": 3, "objects": {"hammer": "cd"}, "noise": True}
    with pytest.raises(InputError) as refused:
        Journal(tmp_path, asked)
    for said in (
        "seeds was 2, asked is 3",
        'objects.hammer was "ab", asked is "cd"',
        "noise was not there, asked is true",
        "--out",
        "--fresh",
    ):
        assert said in str(refused.value)
    assert len(read_run(tmp_path).lines) == 1
    assert differences(CONFIG, CONFIG) == []


def test_many_differences_are_counted(tmp_path):
    with Journal(tmp_path, CONFIG):
        pass
    with pytest.raises(InputError, match="and 5 more"):
        Journal(tmp_path, {**CONFIG, **{f"field{n}": n for n in range(15)}})


def test_fresh_deletes_the_run_that_is_there_and_its_pictures_but_nothing_else(tmp_path):
    with Journal(tmp_path, CONFIG) as journal:
        journal.append(Result(lines_of(0)))
    (tmp_path / "episodes" / "cell-0").mkdir(parents=True)
    (tmp_path / "mine.txt").write_text("kept")
    with Journal(tmp_path, {**CONFIG, "seeds": 3}, fresh=True) as journal:
        assert journal.lines == []
    assert read_run(tmp_path).config["seeds"] == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == [EPISODES, "mine.txt", RUN]


@pytest.mark.parametrize("fresh", [False, True])
def test_files_of_something_else_are_left_alone(tmp_path, fresh):
    (tmp_path / EPISODES).write_text("somebody's\n")
    with pytest.raises(InputError, match=r"something else.*another --out"):
        Journal(tmp_path, CONFIG, fresh=fresh)
    assert (tmp_path / EPISODES).read_text() == "somebody's\n"


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema": "tog_drake/run/99"}'])
def test_a_configuration_that_is_none_is_refused(tmp_path, content):
    (tmp_path / RUN).write_text(content)
    with pytest.raises(InputError, match=re.escape(str(tmp_path / RUN))):
        read_run(tmp_path)
    with pytest.raises(InputError, match=re.escape(str(tmp_path / RUN))):
        Journal(tmp_path, CONFIG)


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no run.*tog eval"):
        read_run(tmp_path)


def test_two_cannot_write_the_same_run(tmp_path):
    with Journal(tmp_path, CONFIG), pytest.raises(InputError, match="another `tog eval`"):
        Journal(tmp_path, CONFIG)
    with Journal(tmp_path, CONFIG) as journal:
        assert journal.lines == []


def test_what_was_asked_for_is_kept_as_json_reads_it(tmp_path):
    with Journal(tmp_path, {**CONFIG, "methods": ("oracle", "random")}):
        pass
    assert json.loads((tmp_path / RUN).read_text())["methods"] == ["oracle", "random"]
    with Journal(tmp_path, {**CONFIG, "methods": ("oracle", "random")}):  # is the same
        pass


def test_another_state_of_the_program_is_refused_and_said_to_give_other_results(tmp_path):
    with Journal(tmp_path, {**CONFIG, "program": "ab", "files": {"tape.jsonl": "12"}}):
        pass
    edited = {**CONFIG, "program": "cd", "files": {"tape.jsonl": "12"}}
    with pytest.raises(InputError, match=r'program was "ab", asked is "cd".*results may differ'):
        Journal(tmp_path, edited)
    longer = {**CONFIG, "program": "ab", "files": {"tape.jsonl": "34"}}
    with pytest.raises(InputError, match=r'files.tape.jsonl was "12", asked is "34"') as refused:
        Journal(tmp_path, longer)
    assert "results may differ" not in str(refused.value)


def test_what_does_not_count_is_kept_aside_and_found_again(tmp_path):
    with Journal(tmp_path, CONFIG) as journal:
        journal.reject(Result(lines_of(3, ("use it", "hand it over"))))
        journal.append(Result(lines_of(0)))
        assert [line["cell"]["number"] for line in journal.rejected] == [3, 3]
    with (tmp_path / REJECTED).open("ab") as file:
        file.write(b'{"cell": {"name": "torn')
    with Journal(tmp_path, CONFIG) as journal:
        assert [line["cell"]["number"] for line in journal.rejected] == [3, 3]
        assert [line["cell"]["number"] for line in journal.lines] == [0]
    assert [line["cell"]["number"] for line in read_run(tmp_path).lines] == [0]
    with Journal(tmp_path, CONFIG, fresh=True) as journal:
        assert journal.rejected == []
    assert not (tmp_path / REJECTED).exists()


@pytest.mark.parametrize("name", [RUN, EPISODES])
def test_a_file_that_is_far_too_large_is_refused_and_not_read_as_a_whole(
    tmp_path, monkeypatch, name
):
    write_run(tmp_path, [make_line(0), make_line(1, message="x" * 5000)])
    monkeypatch.setattr(journal_module, "MAX_LINE", 4000)
    monkeypatch.setattr(journal_module, "MAX_RUN", 50 if name == RUN else 4000)
    where = {RUN: f"{RUN} has more than 50 bytes", EPISODES: f"{EPISODES}, line 2: .* 4000 bytes"}
    with pytest.raises(InputError, match=where[name]):
        read_run(tmp_path)


def test_no_line_is_written_that_would_not_be_read_again(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_module, "MAX_LINE", 4000)
    with Journal(tmp_path, CONFIG) as journal, pytest.raises(InputError, match="4000"):
        journal.append(Result(lines_of(0, message="x" * 5000)))
    assert (tmp_path / EPISODES).read_bytes() == b""


LINES = [
    make_line(
        0,
        exchanges=[make_exchange(points={"grasp": [10.0, 20.5]})],
        judge={"model": "m", "complies": None, "status": "ok", "cost": 0.1, "seconds": 1.0},
        collisions={"hand / table": 3.0},
        k="auto",
        vlm="openai:m",
        strategy="cpg",
        view="coverage",
        view_selection={"camera": "side", "candidates_visible": {"wrist": 2, "side": 5}},
    ),
    make_line(1, "no_choice", complies=False, k="3", choice=None, motion=None, closes_on=None),
    make_line(2, k="auto", vlm="openai:m", strategy="cpg", view="hand", method="other"),
]
ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


def places(value, path=()):
    """Every place in a JSON value, as the keys that lead there."""
    yield path
    if isinstance(value, dict | list):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(part, (*path, key))


PLACES = [(n, path) for n, line in enumerate(LINES) for path in places(line) if path]


def shown(run):
    """All that is made of a run."""
    sheets = success_sheets(run.lines), view_sheets(run.lines), detail_sheets(run.lines)
    return *sheets, cards(run, Pictures(), Replays())


@given(place=st.sampled_from(PLACES), value=ANY, left_out=st.booleans())
def test_whatever_stands_in_a_line_is_shown_or_refused_with_file_and_line(
    tmp_path_factory, place, value, left_out
):
    number, path = place
    lines = deepcopy(LINES)
    *above, last = path
    holder = lines[number]
    for key in above:
        holder = holder[key]
    if left_out:
        del holder[last]
    else:
        holder[last] = value
    folder = write_run(tmp_path_factory.mktemp("run"), LINES)
    (folder / EPISODES).write_text("".join(json.dumps(line) + "\n" for line in lines))
    try:
        run = read_run(folder)
    except InputError as error:
        assert f"{folder / EPISODES}, line " in str(error)
    else:
        shown(run)


def test_the_lines_of_which_others_are_made_here_are_whole(tmp_path):
    run = read_run(write_run(tmp_path, LINES))
    assert run.lines == LINES
    *_, (views,), _, episodes = shown(run)
    assert (len(views.rows), len(episodes)) == (4, 3)


@given(
    st.dictionaries(
        st.sampled_from(["suite", "methods", "seeds", "noise", "asked", "scenarios", "objects"]),
        ANY,
    )
)
def test_whatever_stands_in_a_configuration_is_shown_or_refused(tmp_path_factory, config):
    folder = write_run(tmp_path_factory.mktemp("run"), LINES, **config)
    try:
        run = read_run(folder)
    except InputError as error:
        assert str(folder / RUN) in str(error)
    else:
        command(run)


@given(st.binary(max_size=200))
def test_bytes_that_are_no_run_are_refused_or_cut_off(tmp_path_factory, content):
    folder = write_run(tmp_path_factory.mktemp("run"), LINES)
    with (folder / EPISODES).open("ab") as file:
        file.write(content)
    try:
        assert read_run(folder).lines == LINES
    except InputError as error:
        assert f"{EPISODES}, line " in str(error)
