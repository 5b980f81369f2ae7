"""What a run is: all that decides its results, as ``run.json`` says it.

That is what was asked for, and the digests of what was there: the program, the scenarios, the
models of their objects, and the files that a pipeline reads besides. A run is gone on with, and a
machine may work on it, only where all of it is the same.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.cells import Cell, cell_scenario, worlds_of
from tog_drake.benchmark.journal import SCHEMA
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.suite import Suite
from tog_drake.errors import InputError
from tog_drake.files import file_sha256
from tog_drake.object_parts import labels_file
from tog_drake.pipeline import PipelineConfig
from tog_drake.proposers.contact_graspnet.proposer import ContactGraspNet, checkpoint_file
from tog_drake.proposers.file import File
from tog_drake.resources import scenario_files
from tog_drake.scenario import Scenario, model_files
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.view_scorers.detector import Detector, detector_files
from tog_drake.view_scorers.vlm_compare import VlmCompare
from tog_drake.weights import CONTACT_GRASPNET

if TYPE_CHECKING:
    from tog_drake.benchmark.episodes import EpisodeWork

_OF_MODEL = {".sdf", ".urdf", ".obj", ".mtl", ".gltf", ".glb", ".bin", ".stl", ".png", ".jpg"}
_PREVIEW = "preview.png"
_ASKED = ("prompt", "profile", "rendering", "votes", "fallback", "replay", "deadline")


def run_config(
    suite: Suite,
    methods: Sequence[Method],
    cells: Sequence[Cell],
    work: "EpisodeWork",
    *,
    seeds: int,
) -> dict[str, Any]:
    """Returns all that decides the results of a run, the content of its ``run.json``.

    Raises:
        InputError: a scenario, an object or a file is not there, or a method cannot be run on it.
    """
    first = cells[0]
    asked = {name: getattr(work.options, name) for name in _ASKED}
    return {
        "schema": SCHEMA,
        "suite": suite.name,
        "suite_sha256": suite.sha256,
        "methods": [method.name for method in methods],
        "seeds": seeds,
        "noise": first.noise,
        "side_cameras": first.views.side_cameras,
        "fuse": first.views.fuse,
        "target": first.views.target,
        "scenario_text": first.text,
        "asked": {k: str(v) if isinstance(v, Path) else v for k, v in asked.items()},
        "judge": work.judge,
        "version": version("tog_drake"),
        "program": work.program,
        **digests(cells, work.configured),
    }


def digests(
    cells: Iterable[Cell], configured: Callable[[Cell], Scenario]
) -> dict[str, dict[str, str]]:
    """Returns the SHA-256 of what some cells are made of on this machine.

    Args:
        cells: which.
        configured: makes the scenario of a cell with its method.

    Returns:
        By name those of the ``files`` that pipelines read (weights, proposals, cassettes that are
        replayed), of the ``scenarios``, and of the ``objects``: their models and labels.

    Raises:
        InputError: one of them is not there, or a package that is to read it.
    """
    cells = list(cells)
    files: dict[str, Path] = {}
    for cell in {(cell.scenario, cell.method): cell for cell in cells}.values():
        files |= _files_of(configured(cell).pipeline)
    scenarios = {cell.scenario for cell in cells}
    known = scenario_files()
    return {
        "files": {name: _sha256(file) for name, file in sorted(files.items())},
        "scenarios": {name: _sha256(known.get(name, Path(name))) for name in sorted(scenarios)},
        "objects": model_hashes(cells),
    }


def others(asked: Mapping[str, Any], here: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Returns which of the digests ``here`` are other than a ``run.json`` says."""
    return [
        f"{of}.{name}"
        for of, names in here.items()
        for name, digest in names.items()
        if asked[of].get(name) != digest
    ]


def _files_of(config: PipelineConfig) -> dict[str, Path]:
    """The files that a pipeline reads beside those of the program, each as it was named.

    Raises:
        InputError: there are no weights, or what is to read them is not installed.
    """
    proposer, selector, scorer = config.proposer, config.selector, config.view_selection.scorer
    files: dict[str, Path] = {}
    if isinstance(proposer, ContactGraspNet):
        stored = f"weights of {CONTACT_GRASPNET.name}"
        files[proposer.checkpoint or stored] = checkpoint_file(proposer)
    if isinstance(proposer, File):
        files[proposer.path] = Path(proposer.path)
    if isinstance(scorer, Detector):
        files |= {f"{scorer.model}/{file.name}": file for file in detector_files(scorer)}
    if isinstance(selector, Vlm) and selector.prompt:
        files[selector.prompt] = Path(selector.prompt)
    for asks in (selector, scorer):
        if isinstance(asks, Vlm | VlmCompare) and asks.replay:
            files[asks.replay] = Path(asks.replay)
    return files


def model_hashes(cells: Iterable[Cell]) -> dict[str, str]:
    """Returns of each object in any scenario the SHA-256 of its model's files and its labels."""
    files: dict[str, Path] = {}
    for cell in worlds_of(cells):
        files |= model_files(cell_scenario(cell))
    return {name: _hash(file) for name, file in sorted(files.items())}


def _hash(model: Path) -> str:
    of_model = {path for path in model.parent.iterdir() if path.suffix.lower() in _OF_MODEL}
    of_model -= {model.parent / _PREVIEW}
    labels = labels_file(model)
    total = hashlib.sha256()
    for path in [*sorted(of_model), *([labels] if labels is not None else [])]:
        total.update(path.name.encode() + b"\0" + bytes.fromhex(_sha256(path)))
    return total.hexdigest()


def _sha256(file: Path) -> str:
    try:
        return file_sha256(file)
    except OSError as error:
        raise InputError(
            f"{file} cannot be read: {error.strerror}; the results of a run depend on it: put it "
            "back, or name another"
        ) from error
