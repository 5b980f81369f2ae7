"""Work on a Ray cluster of two nodes on this machine, one of which is lost meanwhile.

Ray opens ports on all interfaces: it runs in a network namespace of its own.
"""

import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="needs Ray: pip install 'tog_drake[cluster]'")
from command import refused, tog

from tog_drake.benchmark import cluster
from tog_drake.errors import InputError
from tog_drake.selectors.vlm.keys import require_key

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


class Work:
    """Has a file beside it, and may lack a key."""

    def __init__(self, differs=(), lacks=None):
        self._differs, self._lacks = list(differs), lacks

    def others(self, cell):
        if self._lacks is not None:
            require_key([self._lacks], "https://example.org")
        return self._differs

    def __call__(self, cell):
        return Path(cell).read_text(), os.environ["TOG_ASSETS"], os.environ.get("MY_API_KEY")


@pytest.fixture
def asker(tmp_path, monkeypatch):
    """What a run begun in ``tmp_path/here`` with relative paths tells, heard elsewhere."""
    for name in ("here", "elsewhere"):
        (tmp_path / name).mkdir()
    (tmp_path / "here" / "tape.jsonl").write_text("what was said")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("TOG_ASSETS", "objects")
    monkeypatch.setenv("MY_API_KEY", "secret-secret")
    begun = cluster.Asker.here()
    monkeypatch.setenv("TOG_ASSETS", "/nowhere")
    monkeypatch.delenv("MY_API_KEY")
    monkeypatch.chdir(tmp_path / "elsewhere")
    return begun


def test_relative_paths_are_those_of_where_the_run_was_begun_and_keys_do_not_travel(
    asker, tmp_path
):
    said, assets, key = cluster.do(asker, Work(), "tape.jsonl")
    assert said == "what was said"
    assert assets == str(tmp_path / "here" / "objects")
    assert key is None
    assert b"secret" not in pickle.dumps(asker)


def test_a_machine_that_lacks_something_is_refused_with_its_name_and_what_it_is(asker):
    here = os.uname().nodename
    nowhere = replace(asker, folder=Path("/no/such/folder"))
    for refusal, words in {
        cluster.do(nowhere, Work(), "tape.jsonl"): ["/no/such/folder", "every machine"],
        cluster.do(asker, Work(["program", "objects.mug"]), "tape.jsonl"): [
            "program, objects.mug",
            "the same version",
        ],
        cluster.do(asker, Work(lacks="MY_API_KEY"), "tape.jsonl"): [
            "MY_API_KEY",
            "`ray start`",
            "do not travel",
        ],
    }.items():
        assert isinstance(refusal, InputError)
        assert str(refusal).startswith(f"{here}: ")
        for word in words:
            assert word in str(refusal)
