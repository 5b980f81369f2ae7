"""How the command speaks: tables and lines for people, one JSON object for programs."""

import json
import logging
import os
import sys
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from tog_drake.visible_text import visible

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from tog_drake.record import EpisodeRecord
    from tog_drake.selectors.vlm.specification import ModelConfig

WIDE = 180  # characters of a line in a file or a pipe
RATES_WIDTH = 160  # characters that the table of successes needs on a line
LONGEST = 100  # characters of what a model says that are shown on a line


def keep_drake_quiet() -> None:
    """Keeps Drake's notices off stderr, but not its warnings of what there may be.

    By a filter, because Drake sets the level of its logger itself when it is imported. Of any half
    space Drake warns that nothing deformable touches it; here nothing is deformable.
    """
    logging.getLogger("drake").addFilter(
        lambda record: record.levelno >= logging.WARNING and "deformable" not in record.getMessage()
    )


def console_for(as_json: bool) -> Console:
    """Where people read: stdout, or stderr when stdout is for one JSON object.

    A task or a file name is printed as it is, whatever brackets or colons are in it. In a file or a
    pipe a table is as wide as it needs, not cut to the 80 columns that no terminal has there.
    """
    console = Console(stderr=as_json, markup=False, highlight=False, emoji=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = WIDE
    return console


def say(console: Console, text: str) -> None:
    """Prints one line as it is: a path or a command broken in two could not be copied.

    Control characters, which a model or a file may have put into it, become visible.
    """
    console.print(visible(text), soft_wrap=True)


def asking(model: "ModelConfig", deadline: float) -> str:
    """Whom one waits for, and how long at most [s]."""
    host = urlsplit(model.base_url).netloc
    return visible(f"asking {model.model} at {host} (at most {deadline:g} s)")


def deciding(selector: object) -> str:
    """What there is to wait for while the selector of this config decides."""
    from tog_drake.selectors.vlm.selector import Vlm

    if isinstance(selector, Vlm) and selector.model is not None and selector.replay is None:
        return asking(selector.model, selector.deadline)
    return "deciding"


def print_json(as_json: bool, content: Any) -> None:
    """Prints ``content`` as the one JSON object on stdout, if ``--json`` was given."""
    if as_json:
        sys.stdout.write(json.dumps(content) + "\n")


def print_rates(console: Console, rows: "Sequence[Mapping[str, Any]]") -> None:
    """The table of successes; each rate with its 95 % interval."""
    from tog_drake.benchmark.tables import RATES

    narrow = console.width < RATES_WIDTH
    table = _folding("method", "group", "n", "tasks", *RATES, "collisions", "failures")
    if narrow:
        table.box, table.padding, table.show_edge = SIMPLE_HEAD, 0, False
        table.columns[-2].header = "colli-\nsions"
    for row in rows:
        table.add_row(
            visible(row["method"]),
            visible(row["group"]),
            str(row["n"]),
            str(row["tasks"]),
            *(_rate(row, rate, narrow=narrow) for rate in RATES),
            str(row["collisions"]),
            row["failures"],
        )
    console.print(table)


def _folding(*columns: str, title: str | None = None) -> Table:
    """A table that loses nothing where the terminal is narrow: what is too long goes on below."""
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _rate(row: "Mapping[str, Any]", rate: str, *, narrow: bool) -> str:
    if row[rate] is None:
        return "-"
    value, low, high = (f"{row[rate + end]:.2f}" for end in ("", "_low", "_high"))
    return f"{value}\n{low}–\n{high}" if narrow else f"{value} [{low}, {high}]"


def print_failures(console: Console, rows: "Sequence[Mapping[str, Any]]") -> None:
    """The table of what failed, and why; nothing where nothing did."""
    if not rows:
        return
    columns = ("method", "n", "outcome", "reason", "objects")
    table = _folding(*columns, title="what failed")
    for row in rows:
        table.add_row(*(visible(str(row[column])) for column in columns))
    console.print(table)


def print_stages(console: Console, record: "EpisodeRecord") -> None:
    """The short table: stage, how many, ms; then what came of it."""
    from tog_drake.record import stage_rows

    task = visible(record["task"])
    table = Table("stage", "how many", "ms", title=task, title_justify="left")
    table.columns[1].justify = table.columns[2].justify = "right"
    for stage, count, seconds in stage_rows(record):
        table.add_row(stage, count, f"{seconds * 1e3:.0f}")
    console.print(table)
    print_origins(console, [record["proposer"]])
    print_looks(console, record)
    print_view(console, record)
    for camera, alignment in (record["alignment"] or {}).items():
        if not alignment["tolerable"]:
            say(console, f"misaligned: {camera} is {alignment['message']}")
    print_answers(console, record)
    choice = record["choice"]
    if choice is not None:
        held_by = choice["part"] or f"grasp {choice['index']}"
        say(console, f"choice: {held_by}. {choice['reason']}")
        if choice["status"] != "ok":
            who = "status" if record["vlm"] is None else "the model"
            say(console, f"{who}: {choice['status']}")
    held = ", ".join(f"{part} {share:.0%}" for part, share in record["held"].items())
    say(
        console,
        f"outcome: {record['outcome']}"
        + (f"; held by {held}" if held else "")
        + (f"; task compliance: {record['task_compliance']}" if held else "")
        + (f"; turned in the hand: {record['turned']:.0f}°" if record["turned"] is not None else "")
        + (f" ({record['message']})" if record["message"] else ""),
    )
    for pair, newtons in (record["collisions"] or {}).items():
        say(console, f"collision: {pair}, {newtons:.1f} N")


def print_looks(console: Console, record: "EpisodeRecord") -> None:
    """One line for each further look of the last attempt, and for why there was no other."""
    for look in record["attempts"][-1]["looks"]:
        if look["X_WC"] is None:
            say(console, look["reason"])
            continue
        x, y, z = (row[3] for row in look["X_WC"][:3])
        say(
            console,
            f"looked again from ({x:.2f}, {y:.2f}, {z:.2f}) m, {look['duration']:.1f} s away: "
            f"{look['reason']}",
        )


def print_view(console: Console, record: "EpisodeRecord") -> None:
    """One line that says whose view is shown, where several were compared."""
    shown = record["view_selection"]
    if shown is not None:
        marks = {state: len(rows) for state, rows in shown["marks"].items() if rows}
        if set(marks) - {"shown"}:
            counts = ", ".join(f"{count} {state}" for state, count in marks.items())
            say(console, f"marks in the view of {shown['camera']}: {counts} (hidden or outside)")
    if shown is None or shown["scorer"]["kind"] == "hand":
        return
    scores, seen = dict(shown["scores"]), shown["candidates_visible"]
    best = scores.pop(shown["camera"])
    others = ", ".join(f"{camera} {score:.2f}" for camera, score in scores.items())
    missing = "" if shown["status"] == "ok" else " No view shows the target."
    say(
        console,
        f"shown: the view of {shown['camera']} ({best:.2f}; {others}), in which "
        f"{seen[shown['camera']]} of {record['counts']['candidates']} candidates are visible. "
        f"{shown['reason']}{missing}",
    )


def print_weights(console: Console, weights: "Mapping[str, Any] | None") -> None:
    """One line that says whose weights a network had, where one proposed."""
    if weights is not None:
        say(console, f"weights: {weights['file']}, {weights['note']}")


def print_origins(console: Console, proposers: "Sequence[Mapping[str, Any]]") -> None:
    """What records say of who proposed, where it was not the usual one, and of whose weights.

    Each is said once: of a server, in its own words.
    """
    from tog_drake.record import proposer_name

    unusual = [p for p in proposers if p["kind"] != "antipodal" and "answered_by" not in p]
    for name in dict.fromkeys(map(proposer_name, unusual)):
        say(console, f"proposer: {name}")
    weights: dict[str, Any] = {}
    for proposer in proposers:
        if "weights" in proposer:
            weights.setdefault(str(proposer["weights"]), proposer["weights"])
    for each in weights.values():
        print_weights(console, each)
    for line in dict.fromkeys(_answerer(p) for p in proposers if "answered_by" in p):
        say(console, line)


def _answerer(proposer: "Mapping[str, Any]") -> str:
    said, url = proposer["answered_by"], proposer["url"]
    if said is None:
        return f"proposer: {url} does not say what proposes there, nor with what weights"
    weights = f", sha256 {said['sha256']}" if said["sha256"] else ""
    note = f", {said['note']}" if said["note"] else ""
    return f"proposer: {url} says that it is {said['name']}{weights}{note}"


def print_answers(console: Console, record: "EpisodeRecord") -> None:
    """One line for each question to a model: what it answered, and what that took."""
    from tog_drake.record import usage

    vlm = record["vlm"]
    if vlm is None:
        return
    for exchange in vlm["exchanges"]:
        answer, status = exchange["answer"], exchange["status"]
        said = "did not answer" if answer is None else f'answered "{_end(answer)}"'
        message = visible(exchange["message"], limit=2 * LONGEST)
        trouble = "" if status == "ok" else f" ({status}: {message})"
        from_file = exchange["replayed"]
        took = usage(exchange["seconds"], [exchange["tokens"]], [exchange["cost"]], [from_file])
        took = f"in {took}" if from_file is None else f"({took})"
        name = visible(exchange["model"] or vlm["model"], limit=LONGEST)
        say(console, f"model: {name} {said}{trouble} {took}")
    if vlm["fallback"]:
        say(console, f"fallback: {vlm['fallback']} chose, because the model's answer was no use")


def _end(answer: str) -> str:
    """The end of an answer, where what was asked for stands, on one line."""
    line = " ".join(answer.split())
    return line if len(line) <= LONGEST else "… " + line[-LONGEST:]
