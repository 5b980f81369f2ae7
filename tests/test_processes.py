import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from tog_drake.benchmark.processes import ATTEMPTS, Broken, in_job_order, in_processes
from tog_drake.errors import InputError, TogError


def square(n):
    return n * n


def ran(work, jobs, workers=2):
    return dict(in_processes(work, jobs, workers))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_each_job_is_done_once_whatever_the_number_of_workers(workers):
    done = list(in_processes(square, range(30), workers))
    assert Counter(done) == Counter((n, n * n) for n in range(30))


def test_no_jobs_are_done_at_once():
    assert ran(square, []) == {}


def process(_):
    return os.getpid()


def test_a_worker_is_replaced_after_some_jobs():
    lives = Counter(ran(process, range(25), 1).values())
    assert sorted(lives.values()) == [5, 10, 10]


def odd_ones_break(how, n):
    if n % 2:
        if how == "raise":
            raise ValueError(f"{n} is odd\nvery much so")
        sys.exit(how)
    return n


@pytest.mark.parametrize("how", ["raise", "a condition of Drake"])
def test_a_job_that_raises_is_broken_and_says_where_and_the_others_are_done(how):
    done = ran(partial(odd_ones_break, how), range(4))
    assert (done[0], done[2]) == (0, 2)
    for n in (1, 3):
        assert isinstance(done[n], Broken)
        said = f"ValueError: {n} is odd very much so"
        assert done[n].message == (said if how == "raise" else "SystemExit: a condition of Drake")
        assert "in odd_ones_break" in done[n].traceback


def unpicklable(n):
    return lambda: n


def test_a_result_that_cannot_be_sent_is_broken():
    assert "pickle" in ran(unpicklable, [1])[1].message.lower()


def refuse(n):
    raise InputError(f"{n} cannot be used")


def test_wrong_input_ends_all():
    with pytest.raises(InputError, match="cannot be used"):
        ran(refuse, range(9))


def die(folder, name):
    """Notes that it was tried; ``fragile`` dies at first, ``deadly`` always, ``slow`` waits."""
    with (folder / name).open("a") as file:
        file.write("x")
    tries = len((folder / name).read_text())
    if name == "deadly" or (name == "fragile" and tries < ATTEMPTS):
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "slow":
        time.sleep(0.5)
    return tries


def test_a_job_whose_worker_dies_is_tried_again_and_takes_no_other_with_it(tmp_path):
    jobs = ["deadly", "slow", "fragile", "fine"]
    done = ran(partial(die, tmp_path), jobs)
    assert {name: done[name] for name in jobs[1:]} == {"slow": 1, "fragile": ATTEMPTS, "fine": 1}
    assert done["deadly"].message.startswith(
        f"its worker process died {ATTEMPTS} times, at last by SIGKILL"
    )
    assert (tmp_path / "deadly").read_text() == "x" * ATTEMPTS


def test_jobs_are_taken_when_a_worker_is_free_so_that_one_can_stop():
    taken = []

    def jobs():
        while len(taken) < 5:
            taken.append(len(taken))
            yield taken[-1]

    for n, (_, result) in enumerate(in_processes(square, jobs(), 2)):
        assert len(taken) <= n + 2
        assert result in {0, 1, 4, 9, 16}
    assert len(taken) == 5


def idle(seconds):
    time.sleep(seconds)
    return os.getpid()


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_what_is_under_way_is_ended_with_those_who_wait_for_it(tmp_path):
    with closing(in_processes(partial(note_and_wait, tmp_path), [0.0, 600.0], 2)) as ended:
        next(ended)
        (pid,) = (int(path.name) for path in tmp_path.iterdir() if path.read_text() == "600.0")
        assert alive(pid)
    assert not alive(pid)


def note_and_wait(folder, seconds):
    if seconds == 0.0:
        while not any(path.read_text() for path in folder.iterdir()):
            time.sleep(0.01)  # until the other is under way
    else:
        (folder / str(os.getpid())).write_text(str(seconds))
    time.sleep(seconds)
    return seconds


PROGRAM = """
import sys
sys.path.insert(0, {here!r})
from functools import partial
from pathlib import Path
from test_processes import note_and_wait
from tog_drake.benchmark.processes import in_processes

if __name__ == "__main__":
    list(in_processes(partial(note_and_wait, Path({folder!r})), [600.0, 601.0], 2))
"""


def test_no_worker_outlives_a_program_that_is_killed(tmp_path):
    program = tmp_path / "program.py"
    folder = tmp_path / "notes"
    folder.mkdir()
    here = str(Path(__file__).parent)
    program.write_text(PROGRAM.format(here=here, folder=str(folder)))
    running = subprocess.Popen([sys.executable, str(program)])
    try:
        _until(lambda: len(list(folder.iterdir())) == 2)
        pids = [int(path.name) for path in folder.iterdir()]
    finally:
        running.kill()
        running.wait()
    _until(lambda: not any(map(alive, pids)))


def _until(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_results_are_put_in_order():
    jobs = [3, 1, 2]
    assert list(in_job_order(jobs, [(2, "b"), (3, "c"), (1, "a")])) == ["c", "a", "b"]
    with pytest.raises(TogError, match="out of paper"):
        list(in_job_order(jobs, [(1, "a"), (3, Broken("out of paper", ""))]))
