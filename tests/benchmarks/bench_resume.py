"""Kills `tog eval` at random moments: ``python tests/benchmarks/bench_resume.py [KILLS [SUITE]]``.

The same command is begun again after each kill -9 of all its processes; what it finds in its folder
at last must give the tables of a run that nobody disturbed, byte for byte. Exit status 1: they
differ.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tog_drake.benchmark.failures import failure_rows, fingers_and_pads, motion_rows, rejection_rows
from tog_drake.benchmark.journal import EPISODES, read_run
from tog_drake.benchmark.tables import GROUPS, candidate_rows, paired_rows, success_rows

OPTIONS = ["--selectors", "top-score,geometric,oracle", "--workers", "2"]
EPISODES_MORE = 1  # at most so many end before a kill, which comes up to
SECONDS = 4.0  # later


def begin(suite: str, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "tog_drake.cli", "eval", suite, *OPTIONS, "--out", str(out)]
    return subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)


def lines_in(folder: Path) -> int:
    path = folder / EPISODES
    return path.read_bytes().count(b"\n") if path.exists() else 0


def tables(folder: Path) -> str:
    lines = read_run(folder).lines
    return json.dumps(
        [
            *(success_rows(lines, by) for by in GROUPS),
            *(rows(lines) for rows in (paired_rows, failure_rows, rejection_rows, motion_rows)),
            candidate_rows(lines),
            fingers_and_pads(lines),
        ]
    )


def main(kills: int, suite: str) -> int:
    chance = random.Random(0)
    folder = Path(tempfile.mkdtemp(prefix="resume-"))
    killed, whole = folder / "killed", folder / "whole"
    for kill in range(kills):
        running = begin(suite, killed)
        wanted = lines_in(killed) + chance.randint(0, EPISODES_MORE)
        while running.poll() is None and lines_in(killed) < wanted:
            time.sleep(0.01)
        time.sleep(chance.uniform(0.0, SECONDS))
        done = running.poll()
        if done is None:
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        data = (killed / EPISODES).read_bytes() if (killed / EPISODES).exists() else b""
        torn = len(data) - data.rfind(b"\n") - 1
        print(f"{kill + 1}: {data.count(10)} lines, {torn} torn bytes, ended: {done}", flush=True)
    assert begin(suite, killed).wait() == 0
    assert begin(suite, whole).wait() == 0
    same = tables(killed) == tables(whole)
    lines = len(read_run(whole).lines)
    print(f"{lines} lines, {len(tables(whole))} bytes of tables: {'the same' if same else 'OTHER'}")
    print(folder)
    return 0 if same else 1


if __name__ == "__main__":
    given = sys.argv[1:]
    sys.exit(main(int(given[0]) if given else 20, given[1] if len(given) > 1 else "kitchen"))
