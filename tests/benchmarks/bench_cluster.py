"""Simulated episodes on two Ray nodes, one of which is killed: ``python bench_cluster.py [DIR]``.

Both are begun by ``ray start`` on this machine, with a processor each, in another folder than the
run; its suite is named by a relative path. Once the second node has work it is killed with all its
processes. The tables must be those of ``--workers 1``, byte for byte; exit status 1: they differ.
Ray opens ports on all interfaces, so all of it runs in a network namespace of its own (``unshare``
and ``ip``).
"""

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from bench_resume import lines_in, tables

from tog_drake.benchmark.journal import read_run

SUITE = """
seeds: 2
groups:
  - objects: [hammer, mug]
    tasks: [{category: use, task: "use the {object}"}]
"""
EVAL = ["-m", "tog_drake.cli", "eval", "suite.yaml", "--selectors", "top-score,geometric"]
ADDRESS = "127.0.0.1:6379"
NODE = ["--num-cpus=1", "--node-ip-address=127.0.0.1", "--object-store-memory=100000000", "--block"]
INSIDE = "--inside"
LINES = 2  # are there when the node is killed
PATIENCE = 900.0  # [s] for each step


def main(folder: Path) -> int:
    """Runs the suite on the cluster and by one worker; prints what came of it."""
    (folder / "suite.yaml").write_text(SUITE)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    head = start(["--head", "--port=6379", "--include-dashboard=false"], elsewhere)
    second = None
    try:
        wait_for(lambda: joined(1), head)
        second = start([f"--address={ADDRESS}"], elsewhere)
        wait_for(lambda: joined(2), second)
        killed_at, seconds = run_and_lose(folder, second)
    finally:
        for node in filter(None, (second, head)):
            kill(node)
    began = time.monotonic()
    subprocess.run(
        [sys.executable, *EVAL, "--workers", "1", "--out", "alone"],
        cwd=folder, stdout=subprocess.DEVNULL, check=True,
    )  # fmt: skip
    same = tables(folder / "cluster") == tables(folder / "alone")
    episodes = len({line["cell"]["name"] for line in read_run(folder / "cluster").lines})
    print(
        f"{episodes} episodes; the second node died with {killed_at} of them ended; "
        f"{seconds:.0f} s on the cluster, {time.monotonic() - began:.0f} s with --workers 1; "
        f"{len(tables(folder / 'alone'))} bytes of tables: {'the same' if same else 'OTHER'}"
    )
    return 0 if same else 1


def run_and_lose(folder: Path, node: "subprocess.Popen[bytes]") -> tuple[int, float]:
    """Runs the suite and kills a node at work; returns after how many lines, and the time [s]."""
    began = time.monotonic()
    command = [sys.executable, *EVAL, "--workers", f"ray:{ADDRESS}", "--out", "cluster"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as running:
        try:
            wait_for(lambda: lines_in(folder / "cluster") >= LINES and is_at_work(node), running)
            lines = lines_in(folder / "cluster")
            kill(node)
            assert running.wait(PATIENCE) == 0
        finally:
            running.kill()
    return lines, time.monotonic() - began


def start(arguments: list[str], folder: Path) -> "subprocess.Popen[bytes]":
    """Begins a node."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", *arguments, *NODE]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)


def joined(nodes: int) -> bool:
    """Whether the cluster has so many nodes."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "status", f"--address={ADDRESS}"]
    told = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    return f"/{float(nodes)} CPU" in told


def wait_for(happened: Callable[[], bool], process: "subprocess.Popen[bytes]") -> None:
    """Waits until something is so, while a process lasts."""
    end = time.monotonic() + PATIENCE
    while not happened():
        assert process.poll() is None, f"{process.args} ended before"
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.1)


def is_at_work(node: "subprocess.Popen[bytes]") -> bool:
    """Whether a worker of a node does a job; Ray calls it by the function."""
    return any(b"ray::do" in read(pid, "cmdline") for pid in descendants(node.pid))


def kill(node: "subprocess.Popen[bytes]") -> None:
    """Kills a node with all its processes."""
    for pid in [node.pid, *descendants(node.pid)]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    node.wait()


def descendants(parent: int) -> list[int]:
    """The processes that a process has begun, and they."""
    pids = [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()]
    mine = [p for p in pids if read(p, "stat").rpartition(b")")[2].split()[1:2] == [b"%d" % parent]]
    return [*mine, *(pid for child in mine for pid in descendants(child))]


def read(pid: int, name: str) -> bytes:
    """What the system says of a process; nothing once it is gone."""
    try:
        return Path(f"/proc/{pid}/{name}").read_bytes()
    except OSError:
        return b""


def in_namespace(folder: Path) -> int:
    """Runs this program where there is no network but its own loopback."""
    mine = shlex.join([sys.executable, __file__, INSIDE, str(folder)])
    command = ["unshare", "-rn", "sh", "-c", f"ip link set lo up && exec {mine}"]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    given = sys.argv[1:]
    if given[:1] == [INSIDE]:
        sys.exit(main(Path(given[1])))
    place = Path(given[0]) if given else Path(tempfile.mkdtemp(prefix="cluster-"))
    place.mkdir(parents=True, exist_ok=True)
    os.environ["RAY_AUTH_MODE"] = "disabled"  # nobody else is there
    sys.exit(in_namespace(place.resolve()))
