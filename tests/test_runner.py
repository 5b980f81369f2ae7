"""What runs many episodes, in a world where an episode is a small calculation."""

import json
from dataclasses import replace
from io import StringIO

import pytest
from made_up_world import CONFIG, MadeUpWork, cells
from rich.console import Console

from tog_drake.benchmark.failures import failure_rows
from tog_drake.benchmark.journal import EPISODES, Journal, read_run
from tog_drake.benchmark.processes import Broken, in_processes
from tog_drake.benchmark.runner import Stopped, evaluate, model_costs
from tog_drake.benchmark.tables import paired_rows, success_rows


def in_turn(work, jobs, workers):
    """As ``in_processes``, but in this one."""
    for job in jobs:
        try:
            yield job, work(job)
        except ZeroDivisionError as error:
            yield job, Broken(f"ZeroDivisionError: {error}", "Traceback ...")


def run(folder, work=None, *, count=12, workers=1, parallel=in_turn, **rest):
    """Runs cells; returns why it ended early, and what was said."""
    said = StringIO()
    console = Console(file=said, width=180)
    with Journal(folder, CONFIG) as journal:
        why = evaluate(
            cells(count), work or MadeUpWork(), journal,
            workers=workers, console=console, parallel=parallel, **rest,
        )  # fmt: skip
    return why, said.getvalue()


def numbers(folder):
    return sorted({line["cell"]["number"] for line in read_run(folder).lines})


def tables(folder):
    lines = read_run(folder).lines
    return json.dumps([success_rows(lines), paired_rows(lines), failure_rows(lines)])


def test_every_cell_is_run_once_and_a_line_for_each_of_its_tasks(tmp_path):
    why, said = run(tmp_path, MadeUpWork(folder=tmp_path))
    assert why is None
    assert [line["cell"]["number"] for line in read_run(tmp_path).lines] == [
        cell.number for cell in cells(12) for _ in range(cell.tasks)
    ]
    assert "12/12" in said
    run(tmp_path, MadeUpWork(folder=tmp_path))
    assert all((tmp_path / cell.name).read_text() == "x" for cell in cells(12))


def test_the_tables_do_not_depend_on_the_number_of_workers(tmp_path):
    run(tmp_path / "one")
    run(tmp_path / "many", workers=3, parallel=in_processes)
    assert tables(tmp_path / "many") == tables(tmp_path / "one")


def test_a_broken_episode_is_a_row_and_not_the_end(tmp_path):
    work = MadeUpWork(troubles=((3, "raises"), (4, "dies")))
    why, said = run(tmp_path, work, workers=2, parallel=in_processes)
    assert why is None
    assert numbers(tmp_path) == list(range(12))
    broken = [line for line in read_run(tmp_path).lines if line["record"]["outcome"] == "broken"]
    messages = {line["cell"]["number"]: line["record"]["message"] for line in broken}
    assert messages[3] == "ZeroDivisionError: one by nothing"
    assert "died 3 times, at last by SIGKILL" in messages[4]
    assert "2 broken" in said


def test_a_limit_is_for_one_time(tmp_path):
    why, said = run(tmp_path, limit=5)
    assert why == "--limit 5 is reached"
    assert "5 of 12 episodes are in" in said
    assert "the same command again" in said
    assert run(tmp_path, limit=5)[0] is not None
    assert numbers(tmp_path) == list(range(10))
    assert run(tmp_path, limit=5)[0] is None
    assert numbers(tmp_path) == list(range(12))


def test_no_episode_is_begun_when_models_have_cost_enough(tmp_path):
    work = MadeUpWork(cost=0.01)
    why, said = run(tmp_path, work, max_cost=0.035)
    assert why == "--max-cost 0.035 is reached: models have cost $0.0400"
    assert numbers(tmp_path) == [0, 1, 2, 3]  # each counts once, whatever number of tasks it has
    assert "$0.0400" in said
    assert run(tmp_path, work, max_cost=0.035)[0] == why  # what it cost before counts
    assert numbers(tmp_path) == [0, 1, 2, 3]
    assert run(tmp_path, work, max_cost=1.0)[0] is None


def test_a_bound_on_the_cost_needs_prices(tmp_path):
    assert run(tmp_path / "free", max_cost=0.1)[0] is None  # nothing was asked
    with pytest.raises(Stopped, match=r"--max-cost cannot be kept.*TOG_PRICES"):
        run(tmp_path / "asked", Unpriced(), max_cost=0.1)
    assert numbers(tmp_path / "asked") == [0]
    assert run(tmp_path / "asked", Unpriced())[0] is None


class Unpriced(MadeUpWork):
    def __call__(self, cell):
        result = replace(MadeUpWork(), cost=0.0)(cell)
        for line in result.lines:
            for attempt in line["record"]["attempts"]:
                for exchange in attempt["exchanges"]:
                    exchange["cost"] = None
        return result


def test_what_is_replayed_costs_nothing_and_judges_do(tmp_path):
    (line,) = MadeUpWork(cost=0.5)(cells(1)[0]).lines
    assert model_costs(line) == ([0.5], False)
    line["record"]["attempts"][0]["exchanges"][0]["replayed"] = "tape.jsonl"
    line["judge"] = {"cost": 0.25, "status": "ok"}
    assert model_costs(line) == ([0.25], False)
    line["judge"] = {"cost": None, "status": "ok"}
    assert model_costs(line) == ([], True)


def test_a_server_that_takes_no_question_ends_the_run_and_is_asked_again_the_next_time(tmp_path):
    work = MadeUpWork(troubles=((3, "no_proposal"),))
    with pytest.raises(Stopped, match="the rest is not run"):
        run(tmp_path, work)
    assert numbers(tmp_path) == [0, 1, 2]
    assert run(tmp_path)[0] is None
    assert numbers(tmp_path) == list(range(12))


def test_a_rejected_question_is_no_line(tmp_path):
    work = Rejected()
    with pytest.raises(Stopped, match=r"openai:m does not take the question.*wrong key"):
        run(tmp_path, work)
    assert numbers(tmp_path) == [0]


def test_what_was_paid_for_counts_though_it_is_no_line_also_the_next_time(tmp_path):
    with pytest.raises(Stopped):
        run(tmp_path, Rejected(), max_cost=0.25)
    assert numbers(tmp_path) == [0]  # $0.10, and as much was asked for number 1 in vain
    why, _ = run(tmp_path, MadeUpWork(cost=0.1), max_cost=0.25)
    assert why == "--max-cost 0.25 is reached: models have cost $0.3000"
    assert numbers(tmp_path) == [0, 1]


def test_what_was_asked_before_an_episode_broke_counts(tmp_path):
    why, _ = run(tmp_path, MadeUpWork(troubles=((1, "breaks"),), cost=0.1), max_cost=0.15)
    assert why == "--max-cost 0.15 is reached: models have cost $0.2000"
    assert numbers(tmp_path) == [0, 1]


class Rejected(MadeUpWork):
    def __call__(self, cell):
        result = MadeUpWork(cost=0.1)(cell)
        if cell.number == 1:
            for line in result.lines:
                line["record"]["vlm"]["status"] = "rejected"
                line["record"]["vlm"]["exchanges"][-1]["message"] = "status 401: wrong key"
        return result


def test_ctrl_c_says_how_to_go_on(tmp_path):
    def interrupted(work, jobs, workers):
        for ended, job in enumerate(jobs):
            if ended == 2:
                raise KeyboardInterrupt
            yield job, work(job)

    said = StringIO()
    with pytest.raises(KeyboardInterrupt), Journal(tmp_path, CONFIG) as journal:
        evaluate(
            cells(12), MadeUpWork(), journal,
            workers=1, console=Console(file=said, width=180), parallel=interrupted,
        )  # fmt: skip
    assert f"2 of 12 episodes are in {tmp_path}; the same command again" in said.getvalue()
    assert (tmp_path / EPISODES).read_text().count("\n") == 3
