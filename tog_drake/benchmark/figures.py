"""The success over the number K of candidates, as what an SVG needs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.success_sheets import TITLES
from tog_drake.benchmark.tables import candidate_rows

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line

WIDTH, HEIGHT = 360.0, 240.0  # of a panel, in units of its viewBox
LEFT, RIGHT, TOP, BOTTOM = 34.0, 10.0, 12.0, 34.0  # margins
COLORS = 7  # the page has so many; more methods take them again, with another mark
_APART = 7.0  # between the marks of two methods at the same K


def candidate_figure(lines: Sequence["Line"]) -> dict[str, Any] | None:
    """Returns the panels of the figure, one for each rate; None where K was not varied.

    Each method is a line through its rates, in order of K, with a 95 % interval (Wilson) at each;
    "auto" stands at the right end and is joined to nothing.
    """
    rows = [row for row in candidate_rows(lines) if row["tasks"]]
    ks = sorted({row["k"] for row in rows}, key=lambda k: (not k.isdigit(), k.zfill(9)))
    if len(ks) < 2:
        return None
    bases = list(dict.fromkeys(row["base"] for row in rows))
    step = (WIDTH - LEFT - RIGHT) / len(ks)
    return {
        "size": (WIDTH, HEIGHT),
        "frame": (LEFT, WIDTH - RIGHT, TOP, HEIGHT - BOTTOM),
        "ks": [(k, LEFT + step * (i + 0.5)) for i, k in enumerate(ks)],
        "levels": [(f"{level:g}", _y(level)) for level in (0, 0.25, 0.5, 0.75, 1)],
        "bases": [(base, i % COLORS + 1) for i, base in enumerate(bases)],
        "panels": [
            {"title": TITLES[rate], "series": [_series(rows, b, bases, ks, rate) for b in bases]}
            for rate in ("grasp", "task", "both")
        ],
        "chosen": [
            (row["base"], [(k, n, n / sum(row["chosen_k"].values())) for k, n in
                           row["chosen_k"].items()])
            for row in rows
            if row["chosen_k"]
        ],
    }  # fmt: skip


def _series(
    rows: Sequence[dict[str, Any]], base: str, bases: Sequence[str], ks: Sequence[str], rate: str
) -> dict[str, Any]:
    """The marks of one method in a panel, moved aside so that it covers no other's."""
    step = (WIDTH - LEFT - RIGHT) / len(ks)
    number = bases.index(base)
    aside = min(_APART, 0.8 * step / len(bases)) * (number - (len(bases) - 1) / 2)
    marks = [
        {
            "x": LEFT + step * (ks.index(row["k"]) + 0.5) + aside,
            "y": _y(row[rate]),
            "low": _y(row[f"{rate}_low"]),
            "high": _y(row[f"{rate}_high"]),
            "said": f"{base}, K {row['k']}: {row[rate]:.3f} [{row[f'{rate}_low']:.2f}, "
            f"{row[f'{rate}_high']:.2f}]",
            "joined": row["k"].isdigit(),
        }
        for row in rows
        if row["base"] == base
    ]
    line = " ".join(f"{m['x']:.1f},{m['y']:.1f}" for m in marks if m["joined"])
    return {"color": number % COLORS + 1, "marks": marks, "line": line}


def _y(share: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * share
