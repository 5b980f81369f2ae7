"""Work on a Ray cluster of two nodes on this machine, one of which is lost meanwhile.

Ray opens ports on all interfaces: it runs in a network namespace of its own.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="needs Ray: pip install 'tog_drake[cluster]'")
from command import refused, tog

IP = shutil.which("ip")
alone = pytest.mark.skipif(
    IP is None or subprocess.run(["unshare", "-rn", "true"], check=False).returncode != 0,
    reason="needs network namespaces: apt-get install iproute2, and unshare -rn",
)


def in_namespace(*arguments, timeout=240):
    """Runs a Python program where there is no network but its own loopback."""
    command = " ".join(["ip link set lo up && exec", sys.executable, "-B", *map(str, arguments)])
    return subprocess.run(
        ["unshare", "-rn", "sh", "-c", command],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        cwd=Path(__file__).parent,
    )


@alone
def test_all_episodes_are_in_the_table_though_a_node_is_lost_and_some_kill_their_worker(tmp_path):
    done = in_namespace("lose_a_node.py", tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["lost"], "the node was to die while it worked"
    assert told["tables"] == told["undisturbed"]
    assert told["lines"] == told["lines_undisturbed"]
    assert "died 3 times" in told["broken"]["4"]
    assert told["broken"]["3"] == "ZeroDivisionError: one by nothing"


def test_workers_that_are_neither_a_number_nor_ray_are_refused(tmp_path):
    for given in ("0", "-1", "two", "ray:", "", "1.5"):
        refused(tog("eval", "Mug", "--workers", given, "--out", tmp_path), "ray:ADDRESS")


@pytest.mark.parametrize("address", ["127.0.0.1:1", "ray://127.0.0.1:1", "127.0.0.1:nowhere"])
def test_a_cluster_that_does_not_answer_is_said_with_what_would_be_valid(address, tmp_path):
    asked = tog(
        *("eval", "Mug", "--workers", f"ray:{address}", "--selectors", "top-score"),
        *("--seeds", 1, "--out", tmp_path),
    )
    refused(asked, f"no Ray cluster answers at {address}", "ray start --head")
