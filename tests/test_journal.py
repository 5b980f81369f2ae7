import json
import re

import pytest

from tog_drake.benchmark.journal import (
    EPISODES,
    RUN,
    SCHEMA,
    Journal,
    Result,
    differences,
    read_run,
)
from tog_drake.errors import InputError

CONFIG = {"schema": SCHEMA, "suite": "builtin", "seeds": 2, "objects": {"hammer": "ab"}}


def lines_of(number, tasks=("use it",), **record):
    """The lines of an episode, with no more than the journal reads."""
    return [
        {
            "cell": {"name": f"cell-{number}", "number": number, "tasks": len(tasks), "task": task},
            "record": {"outcome": "lifted", "task": task, **record},
            "judge": None,
        }
        for task in tasks
    ]


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
    for length in range(len(whole) + 1):
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
        with pytest.raises(InputError, match=rf"byte {len(damage)} .*--fresh"):
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
