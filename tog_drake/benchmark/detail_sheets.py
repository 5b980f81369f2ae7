"""What failed, what it took and how judges agree, as tables for people."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from tog_drake.benchmark.costs import cost_rows
from tog_drake.benchmark.failures import failure_rows, motion_rows, rejection_rows
from tog_drake.benchmark.human_labels import Labels, agreements
from tog_drake.benchmark.sheets import Sheet, make_sheet
from tog_drake.benchmark.success_sheets import paper

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line


def detail_sheets(lines: Sequence["Line"], labels: Labels | None = None) -> list[Sheet]:
    """Returns the tables besides those of successes; what has nothing to tell is left out.

    Args:
        lines: the episodes.
        labels: what people said of them; see ``human_labels.labels_of``.
    """
    sheets = (
        _failures(lines),
        _rejections(lines),
        _motions(lines),
        _times(lines),
        _models(lines),
        _judges(lines, labels or {}),
    )
    return [sheet for sheet in sheets if sheet.rows]


def _failures(lines: Sequence["Line"]) -> Sheet:
    columns = ("method", "outcome", "reason", "n", "objects")
    rows = [[row[column] for column in columns] for row in failure_rows(lines)]
    return make_sheet(
        "failures", "What failed", ("Method", "Outcome", "Reason", "Episodes", "Objects"), rows
    )


def _rejections(lines: Sequence["Line"]) -> Sheet:
    rows = [
        (r["proposer"], words(r["reason"]), r["n"], f"{r['share']:.1%}", r["scenes"])
        for r in rejection_rows(lines)
    ]
    return make_sheet(
        "rejections",
        "Why proposals were not feasible",
        ("Proposer", "Reason", "Proposals", "Share of all", "Scenes"),
        rows,
    )


def _motions(lines: Sequence["Line"]) -> Sheet:
    rows = [(row["method"], row["note"], row["n"]) for row in motion_rows(lines)]
    return make_sheet("motions", "How motions were planned", ("Method", "Plan", "Episodes"), rows)


def _times(lines: Sequence["Line"]) -> Sheet:
    keys = ("decide", "decide_p95", "execute", "execute_p95")
    rows = [
        (row["method"], row["n"], *(_seconds(row[key]) for key in keys)) for row in cost_rows(lines)
    ]
    return make_sheet(
        "times",
        "Time of an episode [s]",
        ("Method", "Episodes", "Decision", "95 %", "Simulation", "95 %"),
        rows,
        note="Wall time: median and 95th percentile. Decision: from the image to the motion, with "
        "the answers of a model; what a replayed answer took back then is not in it.",
    )


def _models(lines: Sequence["Line"]) -> Sheet:
    rows = [
        (
            row["method"],
            {"live": "asked", "replayed": "replayed"}[kind],
            row[kind],
            row[f"{kind}_questions"],
            _seconds(row[f"{kind}_model"]),
            _seconds(row[f"{kind}_model_p95"]),
            _per(row[f"{kind}_tokens"], row[kind], "{:,.0f}"),
            _per(row[f"{kind}_cost"], row[kind], "{:.4f}"),
            _per(row[f"{kind}_cost"], 1, "{:.4f}"),
        )
        for row in cost_rows(lines)
        for kind in ("live", "replayed")
        if row[kind]
    ]
    return make_sheet(
        "models",
        "Questions to a model",
        ("Method", "Answers", "Decisions", "Questions", "Latency [s]", "95 %", "Tokens each",
         "$ each", "$ in all"),
        rows,
        note="Each: of a decision. Latency: median and 95th percentile of a decision's questions "
        "together. What was replayed took so long and cost so much when it was asked.",
    )  # fmt: skip


def words(identifier: str) -> str:
    """Returns ``hand_collision`` as "hand collision"."""
    return identifier.replace("_", " ")


def _judges(lines: Sequence["Line"], labels: Labels) -> Sheet:
    rows = [
        (
            who.capitalize(),
            found.n,
            None if found.agree is None else f"{found.agree:.3f}",
            None if found.kappa is None else f"{found.kappa:.3f}",
        )
        for who, found in agreements(lines, labels).items()
    ]
    published = paper()["judge_agreement"]
    return make_sheet(
        "judges",
        "How judges agree",
        ("Judges", "Grasps", "Agree", "Cohen's κ"),
        rows,
        note="On whether the chosen grasp suits the task. Geometry: the judge by part labels that "
        f"every table here is of. Published, of the paper's model and people: {published}.",
    )


def _seconds(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


def _per(total: float | None, n: int, form: str) -> str | None:
    return None if total is None else form.format(total / n)
