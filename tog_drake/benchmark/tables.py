"""What many episodes say together: the table of successes, of failures, and how labels agree."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from tog_drake.judge import COMPLIANT_SHARE
from tog_drake.record import EpisodeRecord, selector_name

# They do not read the task: one episode serves every task, and is judged for each.
TASK_BLIND = ("top-score", "random")
_TIE = 0.05  # by which a share may be smaller than the greatest and count as great

Rows = list[dict[str, str | int | float]]


def rows_by_scenario(record: EpisodeRecord) -> list[str]:
    """Returns the rows in which an episode counts: that of its scenario, and the last."""
    return [str(record["scenario"]), "all"]


def summarize(
    records: Sequence[EpisodeRecord],
    rows_of: Callable[[EpisodeRecord], Sequence[str]] = rows_by_scenario,
) -> Rows:
    """Returns success rates by selector and by the rows that each episode counts in.

    ``grasp`` and ``strict`` (turned by no more than 10° in the hand) are shares of the ``n``
    episodes that were run, ``task`` and ``both`` of the ``tasks`` that they were judged for: as
    many, but for a selector that does not read the task. An episode that ended early counts as a
    failure of each. ``_low`` and ``_high`` bound them with 95 % confidence (Wilson 1927). Rows
    whose name begins with "all" come last.
    """
    rows: Rows = []
    for selector in dict.fromkeys(map(selector_name, records)):
        counted = [(r, rows_of(r)) for r in records if selector_name(r) == selector]
        found = dict.fromkeys(name for _, names in counted for name in names)
        for name in sorted(found, key=lambda name: name.startswith("all")):
            rows.append(_row(selector, name, [r for r, names in counted if name in names]))
    return rows


def _row(
    selector: str, name: str, records: Sequence[EpisodeRecord]
) -> dict[str, str | int | float]:
    runs = list(records)
    if selector in TASK_BLIND:  # one run, however many tasks it is judged for
        runs = list({(r["scenario"], r["object"], r["seed"]): r for r in records}.values())
    row: dict[str, str | int | float] = {
        "selector": selector,
        "scenario": name,
        "n": len(runs),
        "tasks": len(records),
    }
    successes = {
        "grasp": [r["grasp_success"] for r in runs],
        "strict": [r["strict_success"] for r in runs],
        "task": [r["task_compliance"] for r in records],
        "both": [r["combined_success"] for r in records],
    }
    for name, values in successes.items():
        count = sum(map(bool, values))
        row[name] = count / len(values)
        row[f"{name}_low"], row[f"{name}_high"] = wilson(count, len(values))
    row["collisions"] = sum(bool(r["collisions"]) for r in runs)
    row["failures"] = _failures(runs)
    return row


def _failures(records: Sequence[EpisodeRecord]) -> str:
    """Returns such as "1 slipped, 6 no_choice (unreachable 5, refused 1), by fallback 2 (empty 2)".

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


def _statuses(records: Sequence[EpisodeRecord]) -> str:
    counts = Counter(r["vlm"]["status"] for r in records if r["vlm"] and r["vlm"]["status"])
    told = ", ".join(f"{status} {n}" for status, n in counts.most_common())
    return f" ({told})" if told else ""


def wilson(successes: int, n: int) -> tuple[float, float]:
    """Returns the 95 % confidence interval of a rate (Wilson 1927)."""
    from scipy.stats import binomtest  # slow to import

    interval = binomtest(successes, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def failures(records: Sequence[EpisodeRecord]) -> Rows:
    """Returns how many episodes were no success, by selector, outcome and reason, most first.

    An episode that lifted the object by a part that the task does not allow has the reason
    "held by" that part. Numbers in a reason are left out, so that like reasons are one.
    """
    found: dict[tuple[str, str, str], list[str]] = {}
    for record in records:
        if record["grasp_success"] and record["combined_success"] is not False:
            continue
        reason = re.sub(r"\d+(\.\d+)?", "#", record["message"] or "")
        if record["outcome"] == "lifted":
            if selector_name(record) in TASK_BLIND:
                continue  # no failure of one who was not told
            reason = f"held by {' and '.join(record['held'])}"
        key = (selector_name(record), record["outcome"], reason)
        found.setdefault(key, []).append(str(record["object"]))
    return [
        {
            "selector": selector,
            "outcome": outcome,
            "reason": reason,
            "n": len(objects),
            "objects": ", ".join(dict.fromkeys(objects)),
        }
        for (selector, outcome, reason), objects in sorted(
            found.items(), key=lambda item: (item[0][0], -len(item[1]))
        )
    ]


def _greatest(shares: Mapping[str, float]) -> set[str]:
    """The parts with the greatest share, or as good as it."""
    most = max(shares.values())
    return {part for part, share in shares.items() if share > most - _TIE}


def agreement(records: Sequence[EpisodeRecord]) -> dict[str, int]:
    """Returns how the part between the fingers agrees with the one that the pads then press.

    Of the episodes that were lifted (``n``; one whatever number of tasks it is judged for):
    ``agree`` have the same greatest part in both, or one of equally great ones (with a finger on
    each of two parts both have half, give or take ``_TIE``); of those where both are four fifths
    one part (``clear``), ``clear_agree``; the others are ``mixed``.
    """
    lifted = {
        (selector_name(r), r["scenario"], r["object"], r["seed"], str(r["held"])): r
        for r in records
        if r["grasp_success"] and r["held"] and r["closes_on"]
    }
    counts = {"n": len(lifted), "agree": 0, "clear": 0, "clear_agree": 0, "mixed": 0}
    for record in lifted.values():
        held, between = record["held"], record["closes_on"] or {}
        same = not _greatest(held).isdisjoint(_greatest(between))
        clear = min(max(held.values()), max(between.values())) >= COMPLIANT_SHARE
        counts["agree"] += same
        counts["clear" if clear else "mixed"] += 1
        counts["clear_agree"] += clear and same
    return counts
