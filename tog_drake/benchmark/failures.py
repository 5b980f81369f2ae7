"""What failed and why: the robot's attempts, the proposals, and how far labels agree."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from tog_drake.benchmark.tables import TASK_BLIND, Rows, in_table_order, methods_of, runs_of
from tog_drake.judge import COMPLIANT_SHARE

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line

_NUMBER = re.compile(r"(?<![\w.])\d+(\.\d+)?(e[-+]?\d+)?(?!\.?\w)")
"""A number that stands alone: the one in ycb_006_mustard_bottle is part of a name."""
_TIE = 0.05  # by which a share may be smaller than the greatest and count as great


def failure_rows(lines: Sequence["Line"]) -> Rows:
    """Returns how many episodes were no success, by method, outcome and reason, most first.

    An episode that lifted the object by a part that the task does not allow has the reason
    "held by" that part; it is no failure of a method that was not told. Numbers in a reason are
    left out, so that like reasons are one.
    """
    lines = in_table_order(lines)
    found: dict[tuple[str, str, str], list[str]] = {}
    reading = [line for line in lines if line["cell"]["selector"] not in TASK_BLIND]
    blind = runs_of(line for line in lines if line["cell"]["selector"] in TASK_BLIND)
    for line in [*reading, *(line for line in blind if not line["record"]["grasp_success"])]:
        cell, record = line["cell"], line["record"]
        if record["grasp_success"] and record["combined_success"] is not False:
            continue
        reason = _alike(record["message"] or "")
        if record["outcome"] == "lifted":
            reason = f"held by {' and '.join(record['held'])}"
        found.setdefault((cell["method"], record["outcome"], reason), []).append(cell["object"])
    order = methods_of(lines)
    return [
        {
            "method": method,
            "outcome": outcome,
            "reason": reason,
            "n": len(objects),
            "objects": ", ".join(dict.fromkeys(objects)),
        }
        for (method, outcome, reason), objects in sorted(
            found.items(), key=lambda item: (order.index(item[0][0]), -len(item[1]), item[0])
        )
    ]


def rejection_rows(lines: Sequence["Line"]) -> Rows:
    """Returns why proposals were not feasible, by proposer and reason, most first.

    Of each scene that was seen (an object put down by a seed) proposals count once, whatever number
    of methods chose among them. ``share`` is of all that were proposed in the ``scenes``.
    """
    scenes: dict[str, dict[tuple[str, str, int], Line]] = {}
    for line in in_table_order(lines):
        cell = line["cell"]
        if line["record"]["rejected"]:
            seen = scenes.setdefault(cell["proposer"] or line["record"]["proposer"]["kind"], {})
            seen.setdefault((cell["scenario"], cell["object"], cell["seed"]), line)
    rows: Rows = []
    for proposer, seen in scenes.items():
        records = [line["record"] for line in seen.values()]
        proposed = sum(record["counts"]["proposed"] or 0 for record in records)
        reasons: Counter[str] = Counter()
        for record in records:
            reasons.update(record["rejected"])
        rows += [
            {
                "proposer": proposer,
                "reason": reason,
                "n": n,
                "share": n / proposed,
                "scenes": len(records),
            }
            for reason, n in reasons.most_common()
            if n and proposed
        ]
    return rows


def motion_rows(lines: Sequence["Line"]) -> Rows:
    """Returns how motions were planned, by method and the planner's note, most first.

    Numbers in a note are left out, so that like notes are one.
    """
    lines = in_table_order(lines)
    rows: Rows = []
    for method in methods_of(lines):
        of_method = runs_of(line for line in lines if line["cell"]["method"] == method)
        motions = [line["record"]["motion"] for line in of_method]
        notes = Counter(_alike(motion["note"]) for motion in motions if motion is not None)
        rows += [{"method": method, "note": note, "n": n} for note, n in notes.most_common()]
    return rows


def _alike(text: str) -> str:
    return _NUMBER.sub("#", text)


def _greatest(shares: Mapping[str, float]) -> set[str]:
    """The parts with the greatest share, or as good as it."""
    most = max(shares.values())
    return {part for part, share in shares.items() if share > most - _TIE}


def fingers_and_pads(lines: Sequence["Line"]) -> dict[str, int]:
    """Returns how the part between the fingers agrees with the one that the pads then press.

    Of the episodes that were lifted (``n``; one whatever number of tasks it is judged for):
    ``agree`` have the same greatest part in both, or one of equally great ones (with a finger on
    each of two parts both have half, give or take ``_TIE``); of those where both are four fifths
    one part (``clear``), ``clear_agree``; the others are ``mixed``.
    """
    counts = {"n": 0, "agree": 0, "clear": 0, "clear_agree": 0, "mixed": 0}
    for record in (line["record"] for line in runs_of(lines)):
        held, between = record["held"], record["closes_on"]
        if not (record["grasp_success"] and held and between):
            continue
        same = not _greatest(held).isdisjoint(_greatest(between))
        clear = min(max(held.values()), max(between.values())) >= COMPLIANT_SHARE
        counts["n"] += 1
        counts["agree"] += same
        counts["clear" if clear else "mixed"] += 1
        counts["clear_agree"] += clear and same
    return counts
