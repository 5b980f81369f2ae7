"""A table as people read it, laid out once for the page, Markdown and LaTeX."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tog_drake.visible_text import visible

LONGEST = 200  # characters of a text in a table


@dataclass(frozen=True)
class Share:
    """A rate in a cell, with its 95 % interval where one is known."""

    value: float
    low: float | None = None
    high: float | None = None
    of: str = ""  # such as "12/57"

    def __str__(self) -> str:
        interval = "" if self.low is None else f" [{self.low:.2f}, {self.high:.2f}]"
        return f"{self.value:.3f}{interval}"


Cell = str | int | Share | None


@dataclass(frozen=True)
class Sheet:
    """One table. Its texts are fit to be shown, wherever they came from, and not escaped."""

    key: str  # unique in a run
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    published: int = 0  # so many rows at the end are the paper's
    narrow: bool = False  # of a share only the rate is shown; the rest where one points to it

    def is_number(self, column: int) -> bool:
        """Returns whether a column holds plain numbers, which stand at its right."""
        cells = [row[column] for row in self.rows]
        return (
            column > 0
            and not any(isinstance(c, Share) for c in cells)
            and all(
                cell is None or str(cell)[:1].isdigit() or str(cell)[:1] == "<" for cell in cells
            )
        )


def make_sheet(
    key: str,
    title: str,
    columns: Sequence[str],
    rows: Iterable[Sequence[Cell]],
    *,
    note: str = "",
    published: int = 0,
    narrow: bool = False,
) -> Sheet:
    """Returns a table, with every text in it made visible and short."""
    return Sheet(
        key,
        shown(title),
        shown(note, 10 * LONGEST),
        tuple(map(shown, columns)),
        tuple(tuple(shown(cell) if isinstance(cell, str) else cell for cell in r) for r in rows),
        published,
        narrow,
    )


def shown(text: str, limit: int = LONGEST) -> str:
    """Returns a text from anywhere on one line, with nothing hidden in it."""
    return visible(" ".join(text.split()), limit=limit)


def share(row: Mapping[str, Any], rate: str) -> Share | None:
    """Returns a rate of a row of ``success_rows``; None where nothing was judged."""
    if row[rate] is None:
        return None
    low, high = row[f"{rate}_low"], row[f"{rate}_high"]
    return Share(row[rate], low, high, f"{row[f'{rate}_successes']}/{row[f'{rate}_n']}")
