"""What decisions took: seconds, tokens and dollars, those of an earlier time told apart."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.tables import Rows, in_table_order, methods_of, runs_of

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line
    from tog_drake.vlm_record import ExchangeRecord


def cost_rows(lines: Sequence["Line"]) -> Rows:
    """Returns what the decisions of each method took.

    ``decide`` is the time from the image to the motion at the last look, ``execute`` that of the
    simulation [s, median; ``_p95``: the 95th percentile]. Of those decisions that asked a model,
    the questions of every look: the ``live`` ones and those ``replayed`` from a cassette, which
    took as long and cost as much when they were asked. ``cost`` [USD] is None where the price of
    a question is not known; so are ``tokens``.
    """
    lines = in_table_order(lines)
    rows: Rows = []
    for method in methods_of(lines):
        runs = runs_of(line for line in lines if line["cell"]["method"] == method)
        row: dict[str, Any] = {"method": method, "n": len(runs)}
        for stage in ("decide", "execute"):
            seconds = (line["record"]["seconds"].get(stage) for line in runs)
            row |= _spread(stage, [value for value in seconds if value is not None])
        asked = [found for line in runs if (found := exchanges(line))]
        replayed = [all(e["replayed"] is not None for e in found) for found in asked]
        for kind, wanted in (("live", False), ("replayed", True)):
            of_kind = [
                found for found, is_so in zip(asked, replayed, strict=True) if is_so is wanted
            ]
            row |= _questions(kind, of_kind)
        rows.append(row)
    return rows


def _questions(kind: str, decisions: Sequence[Sequence["ExchangeRecord"]]) -> dict[str, Any]:
    """What the questions of these decisions took."""
    asked = [exchange for decision in decisions for exchange in decision]
    prices = [exchange["cost"] for exchange in asked]
    tokens = [exchange["tokens"] for exchange in asked]
    counted = [sum(t[of] for of in ("input", "output")) for t in tokens if t and _counts_both(t)]
    seconds = [sum(exchange["seconds"] for exchange in decision) for decision in decisions]
    priced = [price for price in prices if price is not None]
    return {
        kind: len(decisions),
        f"{kind}_questions": len(asked),
        f"{kind}_tokens": sum(counted) if len(counted) == len(asked) else None,
        f"{kind}_cost": sum(priced) if len(priced) == len(asked) else None,
        **_spread(f"{kind}_model", seconds),
    }


def _counts_both(tokens: dict[str, int]) -> bool:
    return {"input", "output"} <= tokens.keys()


def exchanges(line: "Line") -> list["ExchangeRecord"]:
    """The questions of every look of an episode."""
    return [exchange for attempt in line["record"]["attempts"] for exchange in attempt["exchanges"]]


def _spread(name: str, values: Sequence[float]) -> dict[str, float | None]:
    """The median and the 95th percentile of what there is."""
    if not values:
        return {name: None, f"{name}_p95": None}
    import numpy as np

    middle, high = np.percentile(values, [50, 95])
    return {name: float(middle), f"{name}_p95": float(high)}
