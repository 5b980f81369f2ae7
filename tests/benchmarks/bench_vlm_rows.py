"""Does a table say of a model how often it was right?

``PYTHONPATH=tests python tests/benchmarks/bench_vlm_rows.py [SUITE [SEEDS]]``

Models that know the right answers (``knowing_server``) give them with a probability p, and `tog
eval` must find p again in "task, as chosen". A question that has no right answer among those to
choose from, or no wrong one, tells nothing of p and is left out of what is found. Exit status 1: a
table does not say what a model did.
"""

import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from command import tog
from knowing_server import NOT_CARRIED_OUT, KnowingModel, Lesson, learn, trial_of
from vlm_server import VlmServer

from tog_drake.benchmark.journal import Line, read_run
from tog_drake.benchmark.statistics import Rate
from tog_drake.benchmark.suite import load_suite
from tog_drake.benchmark.tables import ALL, success_rows

STRATEGIES = ("gsi", "cpsi", "gmi", "cpmi", "cpg")
PROBABILITIES = (0.5, 0.8, 1.0)
HEAD = "strategy    p  right of   telling  found  interval      holds p"


def row_of(name: str, p: float, right: int, asked: int, telling: Rate) -> str:
    """Returns a row of what is printed."""
    assert telling.value is not None
    assert telling.interval is not None
    low, high = telling.interval
    holds = "yes" if low <= p <= high else "no"
    found = f"{telling.value:.2f}   [{low:.2f}, {high:.2f}]  {holds}"
    return f"{name:9} {p:4.1f} {right:5} {asked:4} {telling.n:6}    {found}"


def telling_rate(lines: Sequence[Line], lessons: Mapping[object, Lesson]) -> Rate:
    """Returns "task, as chosen" where a model had the choice between right and wrong."""
    of_choice = [line for line in lines if lessons[trial_of(line["cell"])].leaves_a_choice]
    (row,) = (row for row in success_rows(of_choice) if row["group"] == ALL)
    return Rate(row["chosen_successes"], row["tasks"])


def main(suite: str = "builtin", seeds: str = "1") -> None:
    lessons = learn(load_suite(suite), STRATEGIES, range(int(seeds)))
    models = [KnowingModel(lessons.values(), p) for p in PROBABILITIES]
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        servers = [stack.enter_context(VlmServer(model, key=None)) for model in models]
        model_of = {server.specification("openai"): server.answer for server in servers}
        done = tog(
            "eval", suite, *(word for spec in model_of for word in ("--vlm", spec)),
            "--strategies", ",".join(STRATEGIES), "--seeds", seeds, "--workers", 2,
            "--scenario-text", NOT_CARRIED_OUT, "--out", folder, "--json",
        )  # fmt: skip
        assert done.status == 0, done
        lines = read_run(Path(folder)).lines
    rows = json.loads(done.out.splitlines()[-1])["rows"]
    told = {row["method"]: row for row in rows if row["group"] == ALL}
    print(HEAD)
    differ = 0
    for spec, model in model_of.items():
        total = Rate(0, 0)
        for strategy in STRATEGIES:
            row = told[f"vlm {strategy} {spec}"]
            mine = [line for line in lines if line["cell"]["method"] == row["method"]]
            right = sum(model.was_right[trial_of(line["cell"])] for line in mine)
            differ += (row["chosen_successes"], row["tasks"]) != (right, len(mine))
            rate = telling_rate(mine, lessons)
            total = Rate(total.successes + rate.successes, total.n + rate.n)
            print(row_of(strategy, model.probability, right, len(mine), rate))
        gave = model.was_right.values()
        print(row_of("all", model.probability, sum(gave), len(gave), total))
    print(f"{differ} of {len(told)} rows say something else than what the model did")
    sys.exit(differ > 0)


if __name__ == "__main__":
    main(*sys.argv[1:])
