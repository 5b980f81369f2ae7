"""The tables as files for other programs: CSV, Markdown and LaTeX."""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.sheets import Cell, Sheet, shown
from tog_drake.benchmark.tables import GROUPS, RATES, success_rows

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line

_LATEX = {
    "[": "{[}",  # after a line's end it would be an optional length
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "“": "``",
    "”": "''",
    "κ": r"$\kappa$",
    "×": r"$\times$",
    "°": r"$^\circ$",
    "…": r"\ldots{}",
    "–": "--",
    **{character: f"\\{character}" for character in "{}$&#%_"},
}


def csv_text(runs: Mapping[str, Sequence["Line"]]) -> str:
    """Returns the rates of each run, method and group as CSV, a row each; see ``success_rows``.

    Args:
        runs: the name of each run, and its lines.
    """
    of_rate = ("", "_successes", "_n", "_low", "_high")
    counts = [f"{rate}{what}" for rate in RATES for what in of_rate]
    views = ["candidates", "hand_shows", "shows", "other_view", "views_n"]
    whole = ["run", "by", "group", "method", "n", "tasks"]
    columns = [*whole, *counts, *views, "collisions", "failures"]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(columns)
    for name, lines in runs.items():
        for by in GROUPS:
            for row in success_rows(lines, by):
                cells = {"run": name, "by": by, **row}
                writer.writerow([_csv_cell(cells[column]) for column in columns])
    return file.getvalue()


def _csv_cell(value: Any) -> Any:
    """A text that a spreadsheet would take for a formula gets an apostrophe before it."""
    if not isinstance(value, str):
        return value
    text = shown(value)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def markdown_text(sheets: Mapping[str, Sequence[Sheet]]) -> str:
    """Returns all tables as Markdown, under a heading for each run."""
    said: list[str] = []
    for run, of_run in sheets.items():
        said.append(f"# {_markdown(shown(run))}\n")
        for sheet in of_run:
            lines = [sheet.columns, ["---"] * len(sheet.columns), *sheet.rows]
            body = [f"| {' | '.join(_text(cell, _markdown) for cell in row)} |" for row in lines]
            body[1] = body[1].replace("\\", "")
            said.append(f"## {_markdown(sheet.title)}\n\n" + "\n".join(body) + "\n")
            if sheet.note:
                said.append(_markdown(sheet.note) + "\n")
    return "\n".join(said)


def latex_text(sheets: Mapping[str, Sequence[Sheet]]) -> str:
    """Returns all tables as LaTeX, each a ``table`` for the package booktabs."""
    said = ["% In the preamble: \\usepackage[T1]{fontenc} \\usepackage{booktabs}"]
    for run, of_run in sheets.items():
        said += [_latex_table(shown(run), sheet) for sheet in of_run]
    return "\n\n".join(said) + "\n"


def _latex_table(run: str, sheet: Sheet) -> str:
    def line(cells: Sequence[Cell]) -> str:
        return "  " + " & ".join(_text(cell, _latex) for cell in cells) + r" \\"

    kinds = ["r" if sheet.is_number(i) else "l" for i in range(len(sheet.columns))]
    rows = [line(row) for row in sheet.rows]
    if sheet.published:
        rows.insert(len(rows) - sheet.published, r"  \midrule")
    return "\n".join(
        [
            r"\begin{table}",
            r"  \centering",
            rf"  \caption{{{_latex(run)}: {_latex(sheet.title)}. {_latex(sheet.note)}}}",
            rf"  \begin{{tabular}}{{{''.join(kinds)}}}",
            r"  \toprule",
            line(sheet.columns),
            r"  \midrule",
            *rows,
            r"  \bottomrule",
            r"  \end{tabular}",
            r"\end{table}",
        ]
    )


def _text(cell: Cell, escape: Callable[[str], str]) -> str:
    return escape("–" if cell is None else str(cell))


def _markdown(text: str) -> str:
    """Escapes what Markdown would read as more than text, so that no cell ends its row."""
    return re.sub(r"([\\`*_{}\[\]|~#])", r"\\\1", text).replace("&", "&amp;").replace("<", "&lt;")


def _latex(text: str) -> str:
    """Escapes what LaTeX would obey; what its fonts lack becomes the number of the character."""
    return "".join(
        _LATEX.get(c) or (c if ord(c) < 0x100 else f"{{[}}U+{ord(c):04X}]") for c in text
    )
