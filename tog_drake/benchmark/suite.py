"""A suite of trials: which objects, what is asked of each, and which of their parts it allows."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tog_drake.assets.library import library_dir
from tog_drake.assets.model import MODEL
from tog_drake.benchmark.tables import rows_by_scenario
from tog_drake.errors import InputError
from tog_drake.files import read_yaml
from tog_drake.object_parts import ObjectParts, labels_file, load_parts
from tog_drake.record import EpisodeRecord
from tog_drake.resources import resource_dir

PAPER = ("position", "use", "handover")
"""The paper's categories: specific position, tool use, handover."""
CATEGORIES = (*PAPER, "choose")
SCENARIO = "Tog29"  # of a single object: it takes the place of the one there


@dataclass(frozen=True)
class Trial:
    """One task on one object."""

    object: str  # name of the imported object, and of its model
    task: str
    category: str
    allowed: frozenset[str]  # parts of the object that may be held
    forbidden: frozenset[str]  # all others
    scenario: str
    beyond: str | None  # why no hand that opens 8 cm can do it, if so


def suite_files() -> dict[str, Path]:
    """Returns the suites that come with the package, by name."""
    return {path.stem: path for path in sorted((resource_dir("models") / "suites").glob("*.yaml"))}


def load_suite(path: Path) -> list[Trial]:
    """Reads the trials of a suite and checks them against the labels of their objects.

    Raises:
        InputError: it cannot be read, or a task does not read as the parts that it lists.
    """
    try:
        content = read_yaml(path)
        return [
            trial
            for group in content["groups"]
            for task in group["tasks"]
            for trial in _trials(task, group["objects"], group.get("scenario", SCENARIO))
        ]
    except (InputError, LookupError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            f"cannot read the suite {path}: {error}; it has groups, each of objects and tasks, "
            "these with category, task, allowed and forbidden"
        ) from error


def _trials(task: dict[str, Any], objects: Sequence[str], scenario: str) -> list[Trial]:
    beyond = task.get("beyond", {})
    if strange := {*beyond} - {*objects}:
        raise InputError(f"{task['task']!r}: beyond names {strange}, not in its group")
    if task["category"] not in CATEGORIES:
        raise InputError(
            f"{task['task']!r}: category {task['category']!r} is none of {', '.join(CATEGORIES)}"
        )
    trials = []
    for name in objects:
        labels = object_labels(name)
        said = task["task"].format(object=labels.object)
        allowed, forbidden = _parts(task, labels, f"{name}, {said!r}")
        trials.append(
            Trial(name, said, task["category"], allowed, forbidden, scenario, beyond.get(name))
        )
    return trials


def object_labels(name: str) -> ObjectParts:
    """Returns the labels of an object, imported or not yet.

    Raises:
        InputError: it has none.
    """
    path = labels_file(library_dir() / name / MODEL)
    if path is None:
        raise InputError(f"there are no part labels for {name} (models/labels/{name}.yaml)")
    return load_parts(path)


def _parts(
    task: dict[str, Any], labels: ObjectParts, where: str
) -> tuple[frozenset[str], frozenset[str]]:
    """The parts that a task lists, `others` spelled out."""
    parts = frozenset(labels.part_words)
    listed = {key: task[key] for key in ("allowed", "forbidden")}
    named = {key: frozenset(value) for key, value in listed.items() if value != "others"}
    if not named:
        raise InputError(f"{where}: allowed and forbidden cannot both be the others")
    allowed = named.get("allowed", parts - named.get("forbidden", parts))
    forbidden = named.get("forbidden", parts - allowed)
    if allowed | forbidden != parts or allowed & forbidden or not allowed:
        raise InputError(
            f"{where}: allowed {sorted(allowed)} and forbidden {sorted(forbidden)} must divide its "
            f"parts {sorted(parts)}"
        )
    read = labels.allowed(task["task"].format(object=labels.object))
    if read != allowed:
        raise InputError(
            f"{where}: it lists {sorted(allowed)}, but the words are read as "
            f"{None if read is None else sorted(read)}"
        )
    return allowed, forbidden


def rows_of_suites(names: Sequence[str]) -> Callable[[EpisodeRecord], list[str]]:
    """Returns what tells in which rows of the table an episode counts.

    One of the suites named counts in that of its category and, if it is one of the paper's, in
    those of all; every other episode in that of its scenario.
    """
    files = suite_files()
    trials = {
        (trial.scenario, trial.object, trial.task): trial
        for name in names
        if name in files
        for trial in load_suite(files[name])
    }

    def rows_of(record: EpisodeRecord) -> list[str]:
        key = (str(record["scenario"]), str(record["object"]), record["task"])
        trial = trials.get(key)
        if trial is None:
            return rows_by_scenario(record)
        if trial.category not in PAPER:
            return [trial.category]
        rows = [trial.category, "all"]
        return rows if trial.beyond else [*rows, "all that 8 cm can hold"]

    return rows_of
