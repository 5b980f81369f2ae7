"""People judge whether grasps suit their tasks, without knowing who chose them or what came of it.

``export_sample`` writes a page of pictures in random order, two buttons each; its answers are a
file of JSON lines, which ``import_answers`` puts beside the run. How far people, the judge by
geometry and a model agree is Cohen's κ (Cohen 1960).
"""

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.benchmark.journal import LABELS, PICTURES, Line, Run, episode_folder, read_run
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.judge import complies
from tog_drake.pages import page_environment
from tog_drake.record import chosen_region
from tog_drake.visible_text import visible

PICTURE = "grasp.jpg"  # in the folder of an episode: the chosen grasp alone
ANSWERS = {"yes": True, "no": False, "unclear": None}
_MAX_ANSWERS = 10_000_000  # [byte]


@dataclass(frozen=True)
class Agreement:
    """How two judges agree on the same grasps."""

    n: int  # grasps that both judged
    agree: float | None  # share on which they agree; None: n = 0
    kappa: float | None  # Cohen's κ; None where one of them always says the same, or n = 0


def agreement(pairs: Sequence[tuple[bool, bool]]) -> Agreement:
    """Returns how two judges agree, beyond what chance would give: κ = (p₀ − pₑ) / (1 − pₑ)."""
    n = len(pairs)
    if n == 0:
        return Agreement(0, None, None)
    first, second = (sum(column) / n for column in zip(*pairs, strict=True))
    observed = sum(a == b for a, b in pairs) / n
    expected = first * second + (1 - first) * (1 - second)
    if math.isclose(expected, 1.0):
        return Agreement(n, observed, None)
    return Agreement(n, observed, (observed - expected) / (1 - expected))


def export_sample(folder: Path, out: Path, *, count: int, seed: int) -> int:
    """Writes the page with a random sample of a run's grasps.

    Args:
        folder: of the run.
        out: file of the page.
        count: of grasps at most.
        seed: of the sample and its order.

    Returns:
        How many grasps are on it.

    Raises:
        InputError: there is no run, or no episode of it has a grasp to look at.
    """
    shown = list(_grasps(read_run(folder)).items())
    if not shown:
        raise InputError(
            f"{folder} has no picture of a grasp to judge ({PICTURES}/*/{PICTURE}); "
            "valid: a run of `tog eval` in which grasps were chosen"
        )
    rows = np.random.default_rng(seed).permutation(len(shown))[:count]
    items = [
        {
            "id": name,
            "task": visible(line["cell"]["task"], limit=500),
            "picture": base64.b64encode(picture).decode(),
        }
        for name, (line, picture) in (shown[row] for row in rows)
    ]
    page = page_environment().get_template("human_labels.html.j2").render(items=items)
    write_atomically(out, page)
    return len(items)


def identifier(line: Line, picture: bytes) -> str:
    """Returns what an answer is about: an episode, its task and the very picture that is judged.

    It tells nobody who chose, nor what came of it.
    """
    about = f"{line['cell']['name']}\n{line['cell']['task']}\n".encode()
    return hashlib.sha256(about + hashlib.sha256(picture).digest()).hexdigest()[:16]


def _grasps(run: Run) -> dict[str, tuple[Line, bytes]]:
    """The lines that there is a picture of, with it, by ``identifier``."""
    found = ((line, _picture(run.folder, line)) for line in run.lines)
    return {identifier(line, data): (line, data) for line, data in found if data is not None}


def _picture(run: Path, line: Line) -> bytes | None:
    """The picture of a line's grasp; None where there is none."""
    folder = episode_folder(run, line)
    try:
        return None if folder is None else (folder / PICTURE).read_bytes()
    except OSError:
        return None


def import_answers(folder: Path, answers: Path) -> int:
    """Adds answers to those that the run has; a later answer replaces an earlier one.

    Returns:
        How many the run has now that are not "unclear".

    Raises:
        InputError: there is no run, or the file is none of its page.
    """
    known = _grasps(read_run(folder))
    given = _read_answers(answers)
    if strange := [name for name in given if name not in known]:
        raise InputError(
            f"{answers}: {strange[0]!r} is no grasp of {folder}, or its picture has changed since; "
            "valid: the answers of a page that was made of this run as it is now"
        )
    labels = _read_labels(folder) | given
    write_atomically(folder / LABELS, json.dumps(labels, indent=1) + "\n")
    return sum(label is not None for name, label in labels.items() if name in known)


Labels = Mapping[tuple[str, str], bool | None]
"""What people said of grasps, by the name of the episode and the task; None: it was unclear."""


def labels_of(run: Run) -> Labels:
    """Returns what people said of a run's grasps, as far as the pictures that they saw are there.

    Raises:
        InputError: the file that holds it was damaged.
    """
    labels = _read_labels(run.folder)
    grasps = _grasps(run) if labels else {}
    return {_about(line): labels[n] for n, (line, _) in grasps.items() if n in labels}


def _about(line: Line) -> tuple[str, str]:
    return line["cell"]["name"], line["cell"]["task"]


def _read_labels(folder: Path) -> dict[str, bool | None]:
    """What people said, by ``identifier``."""
    path = folder / LABELS
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read: {error}; valid: to delete it") from error
    return _checked(content, path)


def _read_answers(path: Path) -> dict[str, bool | None]:
    """The answers in a file of the page, JSON lines of id and answer."""
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_ANSWERS + 1)
        if len(data) > _MAX_ANSWERS:
            raise InputError(f"{path} has more than {_MAX_ANSWERS} bytes; valid: a page's answers")
        said = [json.loads(line) for line in data.decode().splitlines() if line.strip()]
        return _checked({item["id"]: ANSWERS[item["answer"]] for item in said}, path)
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path} cannot be read: {error!r}; valid: lines such as "
            '{"id": "1f0c9a...", "answer": "yes"}, with '
            f"{', '.join(ANSWERS)}"
        ) from error


def _checked(content: Any, path: Path) -> dict[str, bool | None]:
    if not isinstance(content, Mapping) or not all(
        isinstance(name, str) and (label is None or isinstance(label, bool))
        for name, label in content.items()
    ):
        raise InputError(f"{path} holds something else than labels; valid: to delete it")
    return dict(content)


def agreements(lines: Sequence[Line], labels: Labels) -> dict[str, Agreement]:
    """Returns how those agree who judged whether the chosen grasp suits the task.

    The geometric judge is the one of the region that this grasp closes on; see ``judge.complies``.
    """
    said: dict[str, dict[tuple[str, str], bool]] = {"geometry": {}, "model": {}, "people": {}}
    for line in lines:
        name, record, judge = _about(line), line["record"], line["judge"]
        region = chosen_region(record)
        by_labels = None if region is None else complies(region, record["allowed"])
        by_model = None if judge is None else judge["complies"]
        for who, suits in (
            ("geometry", by_labels),
            ("model", by_model),
            ("people", labels.get(name)),
        ):
            if suits is not None:
                said[who][name] = suits
    pairs = (("model", "geometry"), ("people", "geometry"), ("people", "model"))
    return {
        f"{a} and {b}": agreement([(said[a][n], said[b][n]) for n in said[a] if n in said[b]])
        for a, b in pairs
        if said[a] and said[b]
    }
