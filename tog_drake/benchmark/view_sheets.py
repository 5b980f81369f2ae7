"""What the choice of the view changes, as a table; beside it what the paper published."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.sheets import Sheet, make_sheet, share
from tog_drake.benchmark.success_sheets import (
    TITLES,
    compared,
    paper,
    published_name,
    published_share,
)
from tog_drake.benchmark.tables import HAND, view_rows

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line

_RATES = ("grasp", "task", "both")


def view_sheets(lines: Sequence["Line"]) -> list[Sheet]:
    """Returns the table of methods in the hand's view and in others; none where none differ so."""
    rows = [_ours(row) for row in view_rows(lines)]
    if not rows:
        return []
    published = [row for row in paper()["methods"] if "view" in row]
    hand = next(row for row in published if row["view"] == HAND)
    theirs = [_theirs(row, hand) for row in published]
    note = (
        "Of the same cameras and trials; rates with 95 % intervals (Wilson). ±: the rate less "
        "that in the hand's view on the trials that both have done, p of McNemar's exact test, and "
        "how many trials only the hand's view solved and how many only the other. Candidates: "
        "mean of the episodes that had any, and how many of them are not hidden in a view. Other "
        "view: in how many of these episodes another than the hand's was chosen. Only vlm looks at "
        "a view: any other selector chooses the same whatever is shown. Published: "
        f"{paper()['source']}; of other scenes, views compared by a detector."
    )
    changes = (f"{TITLES[rate]} ±" for rate in _RATES)
    columns = (
        *("Method", "View", "Tasks", *(TITLES[rate] for rate in _RATES), *changes),
        *("Candidates", "In hand's view", "In chosen view", "Other view"),
    )
    return [
        make_sheet(
            "views",
            "The hand's view and the least ambiguous one",
            columns,
            [*rows, *theirs],
            note=note,
            published=len(theirs),
        )
    ]


def _ours(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return (
        *(row["base"], row["view"], row["tasks"]),
        *(share(row, rate) for rate in _RATES),
        *(_change(row["pairs"].get(rate)) for rate in _RATES),
        *(_mean(row[name]) for name in ("candidates", "hand_shows", "shows")),
        f"{row['other_view']} of {row['views_n']}" if row["views_n"] else None,
    )


def _theirs(row: Mapping[str, Any], hand: Mapping[str, Any]) -> tuple[Any, ...]:
    """A published row; what its rates are more than those of the published hand's view."""
    apart = [
        f"{row[rate] - hand[rate]:+.3f}" if row is not hand and rate in row else None
        for rate in _RATES
    ]
    shares = [published_share(row.get(rate), int(row["trials"])) for rate in _RATES]
    return (published_name(row), row["view"], row["trials"], *shares, *apart, *[None] * 4)


def _change(pair: Mapping[str, Any] | None) -> str | None:
    """Such as "+0.053, p 0.375 (1 : 4 of 57)"; None of no trial that both have done."""
    if pair is None or not pair["n"]:
        return None
    apart, p = compared(pair)
    change = (pair["only_second"] - pair["only_first"]) / pair["n"]
    return f"{change:+.3f}, p {p} ({apart})"


def _mean(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"
