"""A folder of scans, imported by several processes."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tog_drake.assets.importing import ImportOptions, import_mesh, name_for, sweep
from tog_drake.assets.library import checked_name
from tog_drake.assets.mesh import FORMATS
from tog_drake.benchmark.processes import in_job_order, in_processes
from tog_drake.errors import InputError, TogError

METADATA = "metadata.json"
MAX_METADATA_BYTES = 10_000_000


@dataclass(frozen=True)
class Job:
    """One object to import, or why it cannot be."""

    name: str
    mesh: Path | None
    options: ImportOptions
    error: str = ""


def find_jobs(folder: Path) -> list[Job]:
    """Returns the objects of a folder, by its metadata.json, or one for each folder in it.

    Raises:
        InputError: there is no such folder, no object in it, or its metadata cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; valid: one with the scans in it")
    if (folder / METADATA).is_file():
        jobs = [_described(folder, *item) for item in _read_metadata(folder / METADATA).items()]
    else:
        jobs = [_found(path) for path in sorted(folder.iterdir()) if _may_hold_one(path)]
    if not jobs:
        raise InputError(
            f"{folder} holds no folder with a mesh in it, one for each object; for a single mesh "
            "there is `tog assets import`"
        )
    return jobs


def _read_metadata(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise InputError(f"it has more than {MAX_METADATA_BYTES} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise InputError("it is no JSON object {NAME: {...}}")
    except (OSError, ValueError, RecursionError, InputError) as error:
        raise InputError(f"cannot read {path}: {error}") from error
    return content


def _described(folder: Path, name: str, about: Any) -> Job:
    """An object that the metadata describe."""
    try:
        checked_name(name)
        if not isinstance(about, dict):
            raise InputError(f"{METADATA} describes it by {about!r:.60}, which is no JSON object")
        options = _options(about)
        mesh = folder / name / str(about["mesh"]) if "mesh" in about else _only_mesh(folder / name)
        if not mesh.resolve().is_relative_to(folder.resolve()):
            raise InputError(f"its mesh {about['mesh']!r:.120} is outside {folder}")
        return Job(name, mesh, options)
    except InputError as error:
        return Job(name, None, ImportOptions(), str(error))


def _options(about: dict[str, Any]) -> ImportOptions:
    up = about.get("up_axis")
    if up not in ("z", "y", None):
        raise InputError(f"{METADATA}: up_axis must be z or y, not {up!r:.60}")
    source: dict[str, Any] = {
        what: str(about[what]) for what in ("licence", "repo", "commit") if what in about
    }
    mass, scale = about.get("mass_kg_ycb"), about.get("scale_to_m", 1.0)
    for what, value in (("mass_kg_ycb", 1.0 if mass is None else mass), ("scale_to_m", scale)):
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise InputError(f"{METADATA}: {what} must be a number, not {value!r:.60}")
    return ImportOptions(scale=scale, up=up, mass=mass, source=source)


def _may_hold_one(path: Path) -> bool:
    return path.is_dir() and not path.name.startswith(".")


def _found(folder: Path) -> Job:
    """An object of which nothing is known."""
    name = name_for(folder / "mesh.obj")
    try:
        return Job(name, _only_mesh(folder), ImportOptions())
    except InputError as error:
        return Job(name, None, ImportOptions(), str(error))


def _only_mesh(folder: Path) -> Path:
    """The one mesh of a folder; convex pieces do not count."""
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; valid: one with the scans in it")
    meshes = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in FORMATS]
    meshes = [m for m in meshes if not m.stem.lower().endswith(("_col", "_vhacd", "collision"))]
    if len(meshes) != 1:
        given = ", ".join(mesh.name for mesh in meshes) or "none"
        raise InputError(f"{folder} is to hold one mesh ({', '.join(FORMATS)}), not {given}")
    return meshes[0]


def add(jobs: Sequence[Job], workers: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Imports objects, and goes on where one cannot be; yields names and reports in their order.

    The report of one that could not be imported holds ``error`` alone.

    Raises:
        TogError: a process died.
    """
    alone = min(workers, len(jobs)) == 1
    results = (
        map(_import, jobs) if alone else in_job_order(jobs, in_processes(_import, jobs, workers))
    )
    try:
        yield from zip((job.name for job in jobs), results, strict=True)
    finally:
        sweep()  # what processes that were stopped have left


def _import(job: Job) -> dict[str, Any]:
    if job.mesh is None:
        return {"error": job.error}
    try:
        return import_mesh(job.mesh, job.name, job.options)
    except (TogError, OSError) as error:
        return {"error": str(error)}
