"""Runs a benchmark on a cluster of two nodes and kills one: ``python lose_a_node.py DIR``.

Prints as JSON what its tables are, and what they are of a run in this process.
"""

import json
import os
import sys
import threading
from io import StringIO
from pathlib import Path

from made_up_world import CONFIG, MadeUpWork, cells
from ray.cluster_utils import Cluster
from rich.console import Console

from tog_drake.benchmark.cluster import on_cluster
from tog_drake.benchmark.failures import failure_rows
from tog_drake.benchmark.journal import Journal, read_run
from tog_drake.benchmark.processes import in_processes
from tog_drake.benchmark.runner import evaluate
from tog_drake.benchmark.tables import success_rows

TROUBLES = ((3, "raises"), (4, "dies"))


def run(folder, parallel, seconds):
    with Journal(folder, CONFIG) as journal:
        evaluate(
            cells(16), MadeUpWork(seconds, TROUBLES), journal,
            workers=1, console=Console(file=StringIO()), parallel=parallel,
        )  # fmt: skip
    lines = read_run(folder).lines
    for line in lines:  # how it is told that a worker died is the matter of who lost it
        if "died" in (line["record"]["message"] or ""):
            line["record"]["message"] = "died"
    return lines


def tables(lines):
    return json.dumps([success_rows(lines), failure_rows(lines)])


def main(folder):
    # Workers find the modules of the tests by the environment that they are begun in.
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    head = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    second = cluster.add_node(num_cpus=1, node_ip_address="127.0.0.1")
    lost = []

    def lose():
        cluster.remove_node(second, allow_graceful=False)
        lost.append(True)

    timer = threading.Timer(5.0, lose)
    timer.start()
    lines = run(folder / "cluster", on_cluster(cluster.address), 0.5)
    during = bool(lost)
    timer.join()
    broken = {
        line["cell"]["number"]: line["record"]["message"]
        for line in read_run(folder / "cluster").lines
        if line["record"]["outcome"] == "broken"
    }
    cluster.shutdown()
    whole = run(folder / "whole", in_processes, 0.0)
    print(
        json.dumps(
            {
                "lost": during,
                "tables": tables(lines),
                "undisturbed": tables(whole),
                "lines": len(lines),
                "lines_undisturbed": len(whole),
                "broken": broken,
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
