"""How well the methods of a run did, as tables for people; beside them what the paper published."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.failures import fingers_and_pads
from tog_drake.benchmark.sheets import Cell, Share, Sheet, make_sheet, share
from tog_drake.benchmark.statistics import Rate
from tog_drake.benchmark.tables import (
    ALL,
    PAPER,
    RATES,
    Rows,
    candidate_rows,
    methods_of,
    paired_rows,
    success_rows,
)
from tog_drake.errors import InputError
from tog_drake.files import read_yaml

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line, Run

TITLES = {
    "grasp": "Grasp",
    "strict": "Grasp, unturned",
    "chosen": "Task, as chosen",
    "task": "Task, as held",
    "both": "Grasp and task",
}
SCENES = ("household", "kitchen", "tools")
"""The suites that stand for the paper's scenes on a real robot."""


def success_sheets(lines: Sequence["Line"]) -> list[Sheet]:
    """Returns the tables of successes; those that have nothing to tell are left out."""
    sheets = [
        main_sheet(lines),
        _strategies(lines),
        _pairs(lines),
        _categories(lines),
        _candidates(lines),
        *(_matrix(lines, by) for by in ("scenario", "object", "task")),
        _beyond(lines),
    ]
    return [sheet for sheet in sheets if sheet is not None and sheet.rows]


def main_sheet(lines: Sequence["Line"]) -> Sheet:
    """Every method with its rates, and below them what the paper published."""
    rows = success_rows(lines)
    counted = [row for row in rows if row["group"] == ALL] or rows
    ours = [
        (row["method"], row["n"], *(share(row, rate) for rate in RATES), row["failures"])
        for row in counted
    ]
    theirs = [
        (
            published_name(row),
            row["trials"],
            *(published_share(row.get(rate), int(row["trials"])) for rate in RATES),
            "",
        )
        for row in paper()["methods"]
    ]
    what = "; ".join(f"{TITLES[name]}: {text}" for name, text in RATES.items())
    same = fingers_and_pads(lines)
    note = (
        f"Rates with 95 % intervals (Wilson). {what}. Of what an episode did not "
        "come to it is a failure: without a choice, as where an answer could not be read, of each; "
        "without a motion, of each but the chosen grasp. The part between the fingers is the one "
        f"that the pads then press in {same['agree']} of {same['n']} lifts. Published: "
        f"{paper()['source']}; judged by hand, of other scenes and another "
        "simulation; an interval stands where a count of so many trials gives the rate."
    )
    columns = ("Method", "n", *TITLES.values(), "Failures")
    return make_sheet(
        "main", "Methods", columns, [*ours, *theirs], note=note, published=len(theirs)
    )


def _strategies(lines: Sequence["Line"]) -> Sheet | None:
    """Strategy × model, where there are several of both."""
    cells = {line["cell"]["method"]: line["cell"] for line in lines if line["cell"]["strategy"]}
    strategies = list(dict.fromkeys(str(cell["strategy"]) for cell in cells.values()))
    models = list(dict.fromkeys(str(cell["vlm"]) for cell in cells.values()))
    named = {(str(cell["strategy"]), str(cell["vlm"])) for cell in cells.values()}
    if min(len(strategies), len(models)) < 2 or len(named) < len(cells):
        return None  # several methods in one place differ in what the table does not show
    of = {row["method"]: row for row in success_rows(lines) if row["group"] == ALL}
    found = {
        (str(cell["strategy"]), str(cell["vlm"])): share(of[method], "both")
        for method, cell in cells.items()
        if method in of
    }
    rows = [[s, *(found.get((s, model)) for model in models)] for s in strategies]
    return make_sheet(
        "strategies",
        "Strategy × model: grasp and task",
        ["Strategy", *models],
        rows,
        note="Rates with 95 % intervals (Wilson).",
    )


def _pairs(lines: Sequence["Line"]) -> Sheet:
    of: dict[tuple[str, str], dict[str, dict[str, Any]]] = {}
    for row in paired_rows(lines):
        of.setdefault((row["first"], row["second"]), {})[row["rate"]] = row
    rates = ("grasp", "task", "both")
    return make_sheet(
        "pairs",
        "Two methods on the same trials",
        ("First", "Second", *(c for rate in rates for c in (TITLES[rate], "p"))),
        [
            (
                *pair,
                *(cell for rate in rates for cell in compared(found.get(rate))),
            )
            for pair, found in of.items()
        ],
        note="How many trials only the first method solved, and how many only the second, of so "
        "many that both have done. p: McNemar's exact test, not corrected for the number of "
        "comparisons. Where a method does not read the task, the grasp is one trial of an object "
        "and seed, whatever number of tasks it is judged for.",
    )


def compared(row: Mapping[str, Any] | None) -> tuple[str | None, str | None]:
    """Returns how two methods compare, such as ("1 : 4 of 57", "0.375"), and the p-value."""
    if row is None:
        return None, None  # no such task was judged
    p = row["p"]
    apart = f"{row['only_first']} : {row['only_second']} of {row['n']}"
    return apart, "< 0.001" if p < 0.001 else f"{p:.3f}"


def _categories(lines: Sequence["Line"]) -> Sheet:
    rows = [
        (row["method"], row["group"], row["tasks"], *(share(row, rate) for rate in RATES))
        for row in success_rows(lines)
    ]
    return make_sheet(
        "categories",
        "By category",
        ("Method", "Category", "Tasks", *TITLES.values()),
        rows,
        note=f"All: {', '.join(PAPER)}, the paper's categories; any other is apart.",
    )


def _candidates(lines: Sequence["Line"]) -> Sheet:
    rows = [
        (
            row["base"],
            row["k"],
            row["tasks"],
            *(share(row, rate) for rate in ("grasp", "task", "both")),
            ", ".join(f"{k}: {n}" for k, n in row["chosen_k"].items()),
        )
        for row in candidate_rows(lines)
    ]
    return make_sheet(
        "candidates",
        "Number K of candidates",
        ("Method", "K", "Tasks", *(TITLES[r] for r in ("grasp", "task", "both")), "K chosen"),
        rows,
        note="auto chooses K by silhouette; K chosen says how often it took which.",
    )


def _matrix(lines: Sequence["Line"], by: str) -> Sheet | None:
    """The combined success of every method in each group of a kind."""
    methods = methods_of(lines)
    rows = success_rows(lines, by)
    groups = sorted({row["group"] for row in rows})
    objects = {line["cell"]["object"] for line in lines}
    if len(groups) < 2 or (by == "scenario" and len(groups) >= len(objects)):
        return None  # nothing that another table does not tell
    found = {(row["group"], row["method"]): share(row, "both") for row in rows}
    return make_sheet(
        f"by-{by}",
        f"By {by}: grasp and task",
        [by.capitalize(), *methods],
        [[group, *(found.get((group, method)) for method in methods)] for group in groups],
        narrow=True,
    )


def _beyond(lines: Sequence["Line"]) -> Sheet:
    trials = {
        (cell["object"], cell["task"], str(cell["beyond"]))
        for cell in (line["cell"] for line in lines)
        if cell["beyond"]
    }
    return make_sheet(
        "beyond",
        "Trials that no hand that opens 8 cm can do",
        ("Object", "Task", "Why"),
        sorted(trials),
        note="They count in “all”.",
    )


def scene_sheet(runs: Sequence["Run"]) -> Sheet | None:
    """The paper's scenes of a real robot, in simulation; None of fewer than two of them.

    Several runs of a scene may be of different methods.

    Raises:
        InputError: two runs of a scene are of the same method: nobody could tell which counts.
    """
    of: dict[str, list[Line]] = {}
    for run in runs:
        lines = of.setdefault(str(run.config.get("suite")), [])
        if run.config.get("suite") in SCENES and {*methods_of(lines)} & {*methods_of(run.lines)}:
            raise InputError(
                f"{run.folder} is a second run of {run.config['suite']} with the method "
                f"{methods_of(run.lines)[0]}; valid: one of them in a page"
            )
        lines += run.lines
    scenes = [name for name in SCENES if name in of]
    if len(scenes) < 2:
        return None
    methods = dict.fromkeys(m for name in scenes for m in methods_of(of[name]))
    rows: list[list[Cell]] = []
    for method in methods:
        tables = [_of_method(success_rows(of[name]), method) for name in scenes]
        count, n = (sum(t[key] for t in tables) for key in ("both_successes", "tasks"))
        low, high = Rate(count, n).interval or (None, None)
        whole = all(table["tasks"] for table in tables)  # else it would be of other scenes
        everything = Share(count / n, low, high, f"{count}/{n}") if whole else None
        rows.append([method, *(share(t, "both") if t else None for t in tables), everything])
    rows.append(["Real robot (published)", *(None for _ in scenes), Share(paper()["real_robot"])])
    return make_sheet(
        "scenes",
        "Scenes of several objects: grasp and task",
        ("Method", *(name.capitalize() for name in scenes), "Together"),
        rows,
        note="Rates with 95 % intervals (Wilson). Published: success on a real robot, by "
        f"{paper()['source']}.",
        published=1,
    )


def _of_method(rows: Rows, method: str) -> Mapping[str, Any]:
    empty: dict[str, Any] = {"both_successes": 0, "tasks": 0, "both": None}
    return next((r for r in rows if r["method"] == method and r["group"] == ALL), empty)


@cache
def paper() -> dict[str, Any]:
    """Returns what the paper published; see ``paper.yaml``."""
    content: dict[str, Any] = read_yaml(Path(__file__).with_name("paper.yaml"))
    return content


def published_name(row: Mapping[str, Any]) -> str:
    """Returns what one of the paper's methods is called in a table."""
    return " ".join(filter(None, (row["method"], row.get("model"), "(published)")))


def published_share(value: float | None, n: int) -> Share | None:
    """Returns a published rate, with an interval where a count of ``n`` trials gives that rate."""
    if value is None:
        return None
    count = round(value * n)
    if round(count / n, 3) != value:
        return Share(value)
    low, high = Rate(count, n).interval or (None, None)
    return Share(value, low, high, f"{count}/{n}")
