"""Runs that are killed, and taken up again."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command import refused, tog
from test_runner import numbers, tables
from test_runner import run as run_here

from tog_drake.benchmark.journal import EPISODES, PICTURES
from tog_drake.benchmark.suite import TASKS

HERE = Path(__file__).parent


def begin(program, *arguments):
    """Starts a program, in a group of processes of its own."""
    command = [sys.executable, *map(str, program), *map(str, arguments)]
    return subprocess.Popen(
        command, text=True, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def lines_in(folder):
    path = folder / EPISODES
    return path.read_bytes().count(b"\n") if path.exists() else 0


def stop(running, folder, lines, how):
    """Waits until there are so many lines, or more, and stops all processes; returns the output."""
    end = time.monotonic() + 120
    while lines_in(folder) < lines and running.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.001)
    os.killpg(running.pid, how)
    return running.communicate(timeout=60)


def test_a_run_that_was_killed_again_and_again_ends_with_the_same_tables(tmp_path):
    run_here(tmp_path / "whole", count=40)
    folder = tmp_path / "killed"
    chance = random.Random(0)
    world = (HERE / "made_up_world.py",)
    for how in (signal.SIGKILL, signal.SIGINT, signal.SIGKILL):
        before = lines_in(folder)
        running = begin(world, folder, 2, 0.1)
        out, _ = stop(running, folder, before + chance.randint(3, 12), how)
        assert running.returncode != 0
        assert lines_in(folder) > before
        if how == signal.SIGINT:
            assert "the same command again goes on from there" in out
    assert len(numbers(folder)) < 40
    out, err = begin(world, folder, 2, 0).communicate(timeout=120)
    assert "40/40" in out, err
    assert tables(folder) == tables(tmp_path / "whole")
    assert (folder / EPISODES).read_bytes().count(b"\n") == lines_in(tmp_path / "whole")


BEHIND = """
directives:
  - add_directives: {file: package://tog_drake/scenes/table.dmd.yaml}
  - add_model:
      name: hammer
      file: package://tog_drake/objects/hammer/hammer.sdf
      default_free_body_pose:
        base: {translation: [-0.5, 0, 0.001]}
"""


@pytest.fixture
def out_of_view(tmp_path):
    """A scenario whose only object lies behind the robot, where the camera does not look."""
    path = tmp_path / "behind.yaml"
    path.write_text(BEHIND)
    return path


def test_eval_is_taken_up_where_it_was_killed_and_refuses_another_configuration(
    out_of_view, tmp_path
):
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    command = ("eval", out_of_view, "--selectors", "top-score,geometric")
    running = begin(("-m", "tog_drake.cli"), *command, "--workers", 1, "--out", killed)
    stop(running, killed, 2, signal.SIGKILL)
    with (killed / EPISODES).open("ab") as file:
        file.write(b'{"cell": {"name": "torn')
    ended = tog(*command, "--workers", 2, "--json", "--out", killed)
    undisturbed = tog(*command, "--workers", 1, "--json", "--out", whole)
    assert ended.status == undisturbed.status == 0, ended.err
    assert ended.out == undisturbed.out
    assert tables(killed) == tables(whole)
    told = json.loads(ended.out)
    assert (told["cells"], told["stopped"]) == (3, None)
    rows = {(row["method"], row["group"]): row for row in told["rows"]}
    assert rows["top-score", "all"]["failures"] == "1 no_grasp"
    assert (rows["top-score", "all"]["n"], rows["top-score", "all"]["tasks"]) == (1, 2)
    assert (rows["geometric", "use"]["n"], rows["geometric", "all"]["n"]) == (1, 2)
    assert len(TASKS) == 2
    assert {path.name for path in next((killed / PICTURES).iterdir()).iterdir()} == {"view.jpg"}
    assert "INFO" not in ended.err

    again = tog(*command, "--json", "--out", killed)
    assert again.out == ended.out
    assert "3/3" in ended.err
    assert "3/3" not in again.err  # there is no progress: nothing is run

    other = tog(*command, "--seeds", 2, "--noise", "--out", killed)
    refused(other, "seeds was 1, asked is 2", "noise was false, asked is true", "--fresh")
    fresh = tog(*command, "--noise", "--fresh", "--limit", 0, "--json", "--out", killed)
    assert json.loads(fresh.out)["stopped"] == "--limit 0 is reached"
    assert not (killed / PICTURES).exists()


BAD = {
    "no model": (("--selectors", "vlm"), ["no model", "--vlm"]),
    "no vlm": (("--selectors", "random", "--vlm", "openai:any"), ["--vlm", "--selectors"]),
    "options alone": (("--rendering", "paper"), ["--rendering", "--selectors"]),
    "strategies alone": (("--strategies", "cpg"), ["--strategies", "--selectors"]),
    "no key": (("--vlm", "anthropic:claude-sonnet-5-5"), ["ANTHROPIC_API_KEY"]),
    "no key of one": (
        ("--vlm", "openai:any@http://[::1]:9", "--vlm", "anthropic:claude-sonnet-5-5"),
        ["ANTHROPIC_API_KEY"],
    ),
    "no cassette": (("--vlm", "replay:none.jsonl"), ["none.jsonl"]),
    "no cassette to replay": (("--replay", "none.jsonl"), ["none.jsonl"]),
    "deadline": (("--vlm", "openai:any@http://[::1]:9", "--deadline", "0"), ["deadline"]),
    "strategy": (
        ("--vlm", "openai:any@http://[::1]:9", "--strategies", "gsi,x"), ["'x'", "gsi"],
    ),
    "k": (("--k", "2,many"), ["'many'", "auto"]),
    "judge": (("--judge", "somebody"), ["'somebody'", "vlm:"]),
    "checkpoint": (("--proposers", "antipodal", "--checkpoint", "x.pt"), ["contact-graspnet"]),
    "twice": (("--selectors", "oracle,oracle"), ["twice"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_eval_says_what_is_wrong_before_it_starts(case, monkeypatch, tmp_path):
    monkeypatch.delenv("ANTHROPIC_API_KEY", raising=False)
    arguments, words = BAD[case]
    refused(tog("eval", "Mug", *arguments, "--out", tmp_path / "e"), *words)
    assert not (tmp_path / "e").exists()
