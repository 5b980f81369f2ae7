"""What many episodes say together: how often each method succeeds, and which does better.

Every table is a list of rows, each a plain dictionary, and the same for the same episodes, in
whatever order these ended. An episode of a method that does not read the task serves several of
them: it is one grasp, judged for each.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.statistics import Rate, mcnemar
from tog_drake.judge import complies
from tog_drake.record import EpisodeRecord, chosen_region

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line

TASK_BLIND = ("top-score", "random")
"""Selectors that do not read the task: one episode serves every task, and is judged for each."""
RATES = {
    "grasp": "lifted by 0.10 m and held for 2 s",
    "strict": "so lifted, and turned by no more than 10° in the hand",
    "chosen": "the region that the chosen grasp closes on suits the task",
    "task": "what the pads press at lift-off suits the task",
    "both": "lifted, and held as the task wants it",
}
"""The rates of a table, in its order, and what counts as a success."""
PAPER = ("position", "use", "handover")
"""The paper's, in its order; "all" is of these. An episode of another counts in that one alone."""
ALL, WITHIN = "all", "all that 8 cm can hold"
HAND = "hand"
"""The view of the pipeline's own camera, as ``--views`` names it."""
_OF_METHOD = ("proposer", "selector", "strategy", "vlm", "view", "k")  # fields of a cell
GROUPS = ("category", "scenario", "object", "task")
"""By what a table of successes may be divided."""

Rows = list[dict[str, Any]]


def in_table_order(lines: Iterable["Line"]) -> list["Line"]:
    """Returns the lines in the order of the run, in whatever order its episodes ended."""
    return sorted(lines, key=lambda line: (line["cell"]["number"], line["cell"]["task"]))


def methods_of(lines: Iterable["Line"]) -> list[str]:
    """Returns the methods in the order of the run."""
    return list(dict.fromkeys(line["cell"]["method"] for line in in_table_order(lines)))


def success_rows(lines: Sequence["Line"], by: str = "category") -> Rows:
    """Returns the rates of each method in each group; see ``RATES``.

    ``grasp`` and ``strict`` are shares of the ``n`` episodes that were run, the others of the
    ``tasks`` that they were judged for: as many, but for a method that does not read the task. Of
    what an episode did not come to it is a failure: without a choice of each rate, without a motion
    of each but ``chosen``; a task that does not say what may be held is not judged, nor is a choice
    of which an older record does not say what it closes on. ``_n`` is what a rate is a share of;
    ``_low`` and ``_high`` bound it with 95 % confidence (Wilson 1927), None of nothing judged.

    What was in view is of the episodes that had candidates, as means: ``candidates``, and how many
    of them ``hand_shows`` and the chosen view ``shows``; None where no record tells. ``other_view``
    is in how many of the ``views_n`` episodes another view than the hand's was chosen.

    Args:
        lines: the episodes.
        by: one of ``GROUPS``; by category, the paper's together are a group besides.
    """
    rows: Rows = []
    lines = in_table_order(lines)
    some_beyond = any(line["cell"]["beyond"] for line in lines)
    for method in methods_of(lines):
        groups: dict[str, list[Line]] = {}
        for line in lines:
            if line["cell"]["method"] == method:
                for group in _groups(line, by, some_beyond):
                    groups.setdefault(group, []).append(line)
        rows += [_success_row(method, name, groups[name]) for name in sorted(groups, key=_rank)]
    return rows


def _groups(line: "Line", by: str, some_beyond: bool) -> list[str]:
    cell: Mapping[str, Any] = line["cell"]
    group = str(cell[by])
    if by != "category" or group not in PAPER:
        return [group]
    return [group, ALL, *([WITHIN] if some_beyond and not cell["beyond"] else [])]


def _rank(group: str) -> tuple[int, str]:
    """Places the paper's categories first, then any other group by name, then all."""
    known = (*PAPER, None, ALL, WITHIN)
    return known.index(group if group in known else None), group


def runs_of(lines: Iterable["Line"]) -> list["Line"]:
    """One line of each episode."""
    return list({line["cell"]["name"]: line for line in lines}.values())


def _success_row(method: str, group: str, lines: Sequence["Line"]) -> dict[str, Any]:
    runs = runs_of(lines)
    judged = [line for line in lines if _is_judged(line)]
    row: dict[str, Any] = {"method": method, "group": group, "n": len(runs), "tasks": len(judged)}
    for name in RATES:
        of = runs if name in ("grasp", "strict") else judged
        if name == "chosen":
            of = [line for line in judged if _is_known(line)]
        row |= rate_columns(name, Rate(sum(succeeded(line, name) for line in of), len(of)))
    row |= _view_columns(runs)
    row["collisions"] = sum(bool(line["record"]["collisions"]) for line in runs)
    row["failures"] = _failures([line["record"] for line in runs])
    return row


def rate_columns(name: str, rate: Rate) -> dict[str, Any]:
    """Returns a rate as it stands in a row: itself, how many successes of what, its interval."""
    low, high = rate.interval or (None, None)
    return {
        name: rate.value,
        f"{name}_successes": rate.successes,
        f"{name}_n": rate.n,
        f"{name}_low": low,
        f"{name}_high": high,
    }


def _view_columns(runs: Iterable["Line"]) -> dict[str, Any]:
    """What of the candidates the views showed; the hand's view is the first of a record."""
    seen: list[tuple[int, int, int]] = []  # candidates, in the hand's view, in the chosen one
    chosen: list[bool] = []  # whether it is another than the hand's
    for record in (line["record"] for line in runs):
        selection = record.get("view_selection")
        visible = selection["candidates_visible"] if selection else {}
        if selection and selection["camera"] in visible and record["counts"]["candidates"]:
            hand, camera = next(iter(visible)), selection["camera"]
            seen.append((record["counts"]["candidates"], visible[hand], visible[camera]))
            chosen.append(camera != hand)
    names = ("candidates", "hand_shows", "shows")
    means = [sum(column) / len(seen) for column in zip(*seen, strict=True)] or [None] * 3
    return {
        **dict(zip(names, means, strict=True)),
        "other_view": sum(chosen),
        "views_n": len(chosen),
    }


def _is_judged(line: "Line") -> bool:
    record = line["record"]
    return record["task_compliance"] is not None or record["outcome"] == "broken"


def _is_known(line: "Line") -> bool:
    """Whether it is known what the chosen grasp closes on, or that there was none."""
    record = line["record"]
    return record["choice"] is None or chosen_region(record) is not None


def succeeded(line: "Line", rate: str) -> bool:
    """Returns whether an episode is a success of this rate; see ``RATES``."""
    record = line["record"]
    if rate == "chosen":
        return bool(complies(chosen_region(record) or {}, record["allowed"]))
    key = {"grasp": "grasp_success", "strict": "strict_success", "task": "task_compliance"}
    values: Mapping[str, Any] = record
    return bool(values[key.get(rate, "combined_success")])


def _failures(records: Sequence["EpisodeRecord"]) -> str:
    """Returns such as "1 slipped, 6 no_choice (unreadable 5, refused 1), by fallback 2 (empty 2)".

    In brackets is what became of the questions to a model. What the fallback chose is not the
    model's merit, whatever came of it.
    """
    outcomes = Counter(r["outcome"] for r in records if r["outcome"] != "lifted")
    said = [
        f"{n} {outcome}" + _statuses([r for r in records if r["outcome"] == outcome == "no_choice"])
        for outcome, n in outcomes.items()
    ]
    replaced = [r for r in records if r["vlm"] is not None and r["vlm"]["fallback"]]
    if replaced:
        said.append(f"by fallback {len(replaced)}" + _statuses(replaced))
    return ", ".join(said)


def _statuses(records: Sequence["EpisodeRecord"]) -> str:
    counts = Counter(r["vlm"]["status"] for r in records if r["vlm"] and r["vlm"]["status"])
    told = ", ".join(f"{status} {n}" for status, n in counts.most_common())
    return f" ({told})" if told else ""


def paired_rows(lines: Sequence["Line"]) -> Rows:
    """Returns of each two methods how they compare on the trials that both have done.

    A trial is one task on one object, as one seed puts it there; those of categories that are not
    the paper's do not count. An episode of a method that does not read the task is one trial of
    the grasp, whatever number of tasks it is judged for; of a method that does, the episode of the
    first task stands beside it. ``p`` is McNemar's exact test.
    """
    counted = [line for line in in_table_order(lines) if line["cell"]["category"] in PAPER]
    return [
        row
        for first, second in combinations(methods_of(lines), 2)
        for rate in ("grasp", "task", "both")
        if (row := _paired_row(counted, first, second, rate))["n"]
    ]


def _paired_row(lines: Sequence["Line"], first: str, second: str, rate: str) -> dict[str, Any]:
    of_both = [line for line in lines if line["cell"]["method"] in (first, second)]
    blind = any(line["cell"]["selector"] in TASK_BLIND for line in of_both)
    if rate != "grasp":
        of_both = [line for line in of_both if _is_judged(line)]
    done: dict[str, dict[tuple[Any, ...], bool]] = {first: {}, second: {}}
    for line in of_both:
        cell = line["cell"]
        trial = (cell["scenario"], cell["object"], cell["seed"], cell["task"])
        if blind and rate == "grasp":
            trial = (*trial[:3], "")
        done[cell["method"]].setdefault(trial, succeeded(line, rate))
    of_first, of_second = done[first], done[second]
    pairs = [(won, of_second[trial]) for trial, won in of_first.items() if trial in of_second]
    only = {first: pairs.count((True, False)), second: pairs.count((False, True))}
    return {
        "first": first,
        "second": second,
        "rate": rate,
        "n": len(pairs),
        "both": pairs.count((True, True)),
        "only_first": only[first],
        "only_second": only[second],
        "neither": pairs.count((False, False)),
        "p": mcnemar(only[first], only[second]),
    }


def candidate_rows(lines: Sequence["Line"]) -> Rows:
    """Returns the rates over the number K of candidates, of methods that differ in it alone.

    A row has the ``base``, the method without its K; ``k``, a number or "auto"; and of "auto" how
    often it chose which K (``chosen_k``), "none" where there was nothing to choose from.
    """
    bases = _alike_but_for(lines, "k")
    return [
        {
            "base": base,
            "k": k,
            "chosen_k": _chosen_k(runs_of(by_k[k])) if k == "auto" else {},
            **_success_row(by_k[k][0]["cell"]["method"], ALL, by_k[k]),
        }
        for base, by_k in bases.items()
        if len(by_k) > 1
        for k in sorted(by_k, key=lambda k: (not k.isdigit(), int(k) if k.isdigit() else 0, k))
    ]


def view_rows(lines: Sequence["Line"]) -> Rows:
    """Returns the rates of methods that differ in the view alone, the hand's and others.

    A row has the ``base``, the method without its view; the ``view``, as ``--views`` names who
    compares them; and in ``pairs``, of another than the hand's, by rate how the two compare on the
    trials that both have done, as ``paired_rows`` says it of the hand's as the first.
    """
    rows: Rows = []
    for base, by_view in _alike_but_for(lines, "view").items():
        if HAND not in by_view or len(by_view) < 2:
            continue
        named = {view: of[0]["cell"]["method"] for view, of in by_view.items()}
        for view in sorted(by_view, key=lambda view: view != HAND):  # stable: as in the run
            of_two = [*by_view[HAND], *by_view[view]]
            pairs = {
                rate: _paired_row(of_two, named[HAND], named[view], rate)
                for rate in ("grasp", "task", "both")
                if view != HAND
            }
            row = _success_row(named[view], ALL, by_view[view])
            rows.append({"base": base, "view": view, "pairs": pairs, **row})
    return rows


def _alike_but_for(lines: Iterable["Line"], field: str) -> dict[str, dict[str, list["Line"]]]:
    """The paper's lines by what a method is but for one field of the cell, and by that field."""
    alike: dict[str, dict[str, list[Line]]] = {}
    for line in in_table_order(lines):
        cell: Mapping[str, Any] = line["cell"]
        if cell["category"] in PAPER and cell.get(field) is not None:
            named = {name: cell.get(name) for name in _OF_METHOD if name != field}
            words = [f"K={said}" if name == "k" else said for name, said in named.items() if said]
            alike.setdefault(" ".join(words), {}).setdefault(str(cell[field]), []).append(line)
    return alike


def _chosen_k(lines: Sequence["Line"]) -> dict[str, int]:
    counts = [line["record"]["counts"]["candidates"] or 0 for line in lines]
    return {str(k or "none"): counts.count(k) for k in sorted(set(counts))}
