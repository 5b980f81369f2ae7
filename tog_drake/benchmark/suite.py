"""A suite of trials: which objects, what is asked of each, and which of their parts it allows.

A suite is a YAML file::

    seeds: 3                       # how often each trial is run, unless --seeds says otherwise
    groups:
      - objects: [hammer, mug]     # left out: every labelled object of the scenario
        scenario: Tools            # left out: each object alone
        tasks:
          - {category: use, task: "use the {object}"}
          - {category: position, task: "pick up the {object} by its {part}"}
          - {category: handover, task: "hand me the {object}", allowed: [head], forbidden: others}

``{object}`` is what the labels call it; ``{part}`` is one part after the other, by the seed. Which
parts may be held is what the labels say of the task's words; a task that lists them must agree.
"""

import hashlib
import reprlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from tog_drake.assets.library import library_dir
from tog_drake.assets.model import MODEL
from tog_drake.benchmark.tables import PAPER
from tog_drake.errors import InputError
from tog_drake.files import read_yaml
from tog_drake.object_parts import ObjectParts, labels_file, load_parts
from tog_drake.resources import resource_dir, scenario_files
from tog_drake.scenario import Scenario, load_scenario
from tog_drake.world import load_objects

CATEGORIES = (*PAPER, "choose")
SCENARIO = "Tog29"  # of a single imported object: it takes the place of the one there
TASKS = {"use": "use the {object}", "handover": "hand me the {object}"}
"""What is asked where a scenario is run as a suite, by category."""
_SEEDS = 1  # where a suite does not say
_PART = "{part}"


@dataclass(frozen=True)
class Trial:
    """One task on one object."""

    object: str  # model instance
    task: str
    category: str
    allowed: frozenset[str]  # parts of the object that may be held
    scenario: str  # by name, or a file
    beyond: str | None = None  # why no hand that opens 8 cm can do it, if so
    in_turn: tuple[str, ...] = ()  # the parts that the task still names by {part}

    def at(self, seed: int) -> "Trial":
        """Returns the trial as that seed asks for it, its part named."""
        if not self.in_turn:
            return self
        part = self.in_turn[seed % len(self.in_turn)]
        task = self.task.replace(_PART, part.replace("_", " "))
        return replace(self, task=task, allowed=frozenset([part]), in_turn=())


@dataclass(frozen=True)
class Suite:
    """Trials, and how often each is to be run."""

    name: str
    trials: tuple[Trial, ...]
    seeds: int
    sha256: str  # of its file


def suite_files() -> dict[str, Path]:
    """Returns the suites that come with the package, by name."""
    return {path.stem: path for path in sorted((resource_dir("models") / "suites").glob("*.yaml"))}


def load_suite(name_or_file: str, text: str | None = None) -> Suite:
    """Reads the trials of a suite and checks them against the labels of their objects.

    Args:
        name_or_file: a suite by name or file; or a scenario, likewise, all of whose objects are
            asked for, to use and to hand over.
        text: YAML over the scenario, as of ``load_scenario``.

    Raises:
        InputError: there is none, it cannot be read, or a task does not read as the parts that it
            lists. The message says where, and what would be valid.
    """
    path = suite_files().get(name_or_file) or scenario_files().get(name_or_file)
    path = path or Path(name_or_file)
    if not path.is_file():
        raise InputError(
            f"unknown suite {name_or_file!r}; valid: {', '.join(suite_files())}; a scenario "
            f"({', '.join(scenario_files())}); or a YAML file of either"
        )
    try:
        content = _without_tags(path)
    except InputError as error:
        raise InputError(f"cannot read the suite {path}: {error}; valid: YAML in UTF-8") from error
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if isinstance(content, dict) and "groups" in content:
        try:
            groups = _checked(content, "the suite", {"groups": list}, {"seeds": int})["groups"]
            trials = [trial for group in groups for trial in _group(group, path.parent, text)]
            seeds = content.get("seeds", _SEEDS)
            if seeds < 1:
                raise InputError(f"seeds must be at least 1, not {seeds}")
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    else:
        trials, seeds = _of_scenario(name_or_file, text), _SEEDS
    if not trials:
        raise InputError(f"{path} holds no trial; valid: groups of objects and tasks")
    _check_different(trials, path)
    return Suite(path.stem, tuple(trials), seeds, sha256)


def _without_tags(path: Path) -> Any:
    """The content of a suite; None where it is a scenario with tags, which a suite has not."""
    try:
        return read_yaml(path)
    except InputError as error:
        if isinstance(error.__cause__, yaml.constructor.ConstructorError):
            return None
        raise


def _check_different(trials: Sequence[Trial], path: Path) -> None:
    seen = set()
    for trial in trials:
        key = (trial.scenario, trial.object, trial.task)
        if key in seen:
            raise InputError(f"{path}: {trial.task!r} is asked twice of {trial.object}")
        seen.add(key)


def _of_scenario(name: str, text: str | None) -> list[Trial]:
    """All objects of a scenario, to use and to hand over, as far as their labels say how."""
    objects = load_objects(load_scenario(name, text))
    if not objects:
        raise InputError(
            f"scenario {name} holds no labelled object; `tog assets label NAME` says where the "
            "labels of an imported one go"
        )
    return [
        Trial(model, said, category, allowed, name)
        for model, labels in objects.items()
        for category, task in TASKS.items()
        if (allowed := labels.allowed(said := task.format(object=_called(labels))))
    ]


def _group(group: Any, folder: Path, text: str | None) -> list[Trial]:
    """The trials of a group, task by task."""
    fields = {"objects": list, "scenario": str}
    group = _checked(group, "a group", {"tasks": list}, fields)
    scenario = group.get("scenario")
    known: dict[str, ObjectParts] = {}
    if scenario is not None:
        scenario = scenario if scenario in scenario_files() else str(folder / scenario)
        known = _objects_in(load_scenario(scenario, text))
    objects = group.get("objects", list(known))
    if not objects or not all(isinstance(name, str) for name in objects):
        raise InputError(
            f"a group of tasks {reprlib.repr(group['tasks'])} has no objects; valid: a list of "
            "names, or a scenario whose objects are labelled and, if imported, there"
        )
    return [
        _trial(task, name, known, scenario, objects) for task in group["tasks"] for name in objects
    ]


def _objects_in(scenario: Scenario) -> dict[str, ObjectParts]:
    """The labelled objects of a scenario; none where some of its models are not imported yet."""
    try:
        return load_objects(scenario)
    except InputError:
        return {}


def _trial(
    task: Any,
    name: str,
    known: Mapping[str, ObjectParts],
    scenario: str | None,
    objects: Collection[str],
) -> Trial:
    listed = {"allowed": (list, str), "forbidden": (list, str), "beyond": dict}
    task = _checked(task, "a task", {"category": str, "task": str}, listed)
    beyond = task.get("beyond", {})
    if strange := {*beyond} - {*objects}:
        raise InputError(f"{task['task']!r}: beyond names {strange}, not in its group")
    if task["category"] not in CATEGORIES:
        raise InputError(
            f"{task['task']!r}: category {task['category']!r} is none of {', '.join(CATEGORIES)}"
        )
    if known and name not in known:
        raise InputError(f"scenario {scenario} has no object {name!r}; valid: {', '.join(known)}")
    labels = known[name] if known else object_labels(name)
    said = task["task"].replace("{object}", _called(labels))
    where = f"{name}, {said!r}"
    place = scenario or alone(name)
    if _PART in said:
        in_turn = _in_turn(said, labels, {*task} & {"allowed", "forbidden"}, where)
        return Trial(
            name, said, task["category"], frozenset(), place, beyond.get(name), in_turn=in_turn
        )
    allowed = _allowed(task, labels, said, where)
    return Trial(name, said, task["category"], allowed, place, beyond.get(name))


def _called(labels: ObjectParts) -> str:
    return labels.object.replace("_", " ")


def object_labels(name: str) -> ObjectParts:
    """Returns the labels of an object: of this package, imported, or not yet.

    Raises:
        InputError: it has none.
    """
    own = resource_dir("models") / "objects" / name / f"{name}.sdf"
    path = labels_file(library_dir() / name / MODEL if is_imported(name) else own)
    if path is None:
        raise InputError(f"there are no part labels for {name} (models/labels/{name}.yaml)")
    return load_parts(path)


def is_imported(name: str) -> bool:
    """Returns whether an object is none of those that come with the package."""
    return not (resource_dir("models") / "objects" / name).is_dir()


def alone(name: str) -> str:
    """Returns the scenario in which an object lies alone: its own, or that of an imported one."""
    if is_imported(name):
        return SCENARIO
    return "".join(word.capitalize() for word in name.split("_"))


def _in_turn(
    said: str, labels: ObjectParts, listed: Collection[str], where: str
) -> tuple[str, ...]:
    """The parts that a task with {part} names one after the other, each read as itself."""
    if listed:
        raise InputError(f"{where}: {_PART} says itself what is allowed; leave out {listed}")
    for part in labels.part_words:
        read = labels.allowed(said.replace(_PART, part.replace("_", " ")))
        if read != frozenset([part]):
            raise InputError(f"{where}: with {part} it is read as {_shown(read)}")
    return tuple(labels.part_words)


def _allowed(task: Mapping[str, Any], labels: ObjectParts, said: str, where: str) -> frozenset[str]:
    """The parts that a task allows, by its words; raises InputError where it lists others."""
    read = labels.allowed(said)
    if not {"allowed", "forbidden"} & {*task}:
        if not read:
            raise InputError(
                f"{where}: its labels do not say which part that allows; name a part in the task, "
                "or leave the object out"
            )
        return read
    parts = frozenset(labels.part_words)
    for key in ("allowed", "forbidden"):
        listed = task.get(key, "others")
        if listed != "others" and not (
            isinstance(listed, list) and all(isinstance(part, str) for part in listed)
        ):
            raise InputError(
                f"{where}: {key} must be a list of parts or others, not {reprlib.repr(listed)}"
            )
    named = {
        key: frozenset(task[key])
        for key in ("allowed", "forbidden")
        if task.get(key, "others") != "others"
    }
    if not named:
        raise InputError(f"{where}: allowed and forbidden cannot both be the others")
    allowed = named.get("allowed", parts - named.get("forbidden", parts))
    forbidden = named.get("forbidden", parts - allowed)
    if allowed | forbidden != parts or allowed & forbidden or not allowed:
        raise InputError(
            f"{where}: allowed {sorted(allowed)} and forbidden {sorted(forbidden)} must divide its "
            f"parts {sorted(parts)}"
        )
    if read != allowed:
        raise InputError(
            f"{where}: it lists {_shown(allowed)}, but the words are read as {_shown(read)}"
        )
    return allowed


def _shown(parts: frozenset[str] | None) -> str:
    return str(None if parts is None else sorted(parts))


def _checked(
    content: Any,
    what: str,
    needed: Mapping[str, Any],
    other: Mapping[str, Any],
) -> dict[str, Any]:
    """Returns a mapping whose fields are known and of the right kind."""
    known = {**needed, **other}
    if not isinstance(content, dict):
        raise InputError(f"{what} must have {', '.join(known)}; it is {reprlib.repr(content)}")
    if strange := [key for key in content if key not in known]:
        raise InputError(f"{what} has no field {strange[0]!r}; valid: {', '.join(known)}")
    if missing := [key for key in needed if key not in content]:
        raise InputError(f"{what} lacks {missing[0]}; it has {', '.join(content) or 'nothing'}")
    for key, value in content.items():
        if not isinstance(value, known[key]) or isinstance(value, bool):
            kinds = known[key] if isinstance(known[key], tuple) else (known[key],)
            words = {list: "a list", dict: "a mapping", str: "text", int: "a whole number"}
            valid = " or ".join(words[kind] for kind in kinds)
            raise InputError(f"{what}: {key} must be {valid}, not {reprlib.repr(value)}")
    return content
