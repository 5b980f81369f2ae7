"""From a mesh file to an object that can be grasped: read, clean, simplify, weigh, write, test."""

import json
import secrets
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tog_drake.assets.collision import CORE_FACES, INSTALL, Piece, core_of, decompose, read_pieces
from tog_drake.assets.library import REPORT, checked_name, library_dir
from tog_drake.assets.mesh import Solid, read_mesh, solid_of
from tog_drake.assets.model import DENSITY, FRICTION, MODEL, inertia_of, write_model
from tog_drake.assets.settle import settle
from tog_drake.assets.visual import write_visual
from tog_drake.errors import InputError
from tog_drake.files import write_atomically

LICENCE = "LICENSE.txt"  # goes with the object where it lies beside the mesh
MAX_LICENCE_BYTES = 1_000_000
MASS_RANGE = (0.001, 20.0)  # [kg]
# Where scans keep their convex pieces, beside the mesh.
_PIECES = ("collision/*.obj", "*_vhacd.stl", "*_col.obj")


@dataclass
class ImportOptions:
    """What a mesh does not say of itself."""

    scale: float = 1.0  # metres per unit of the file
    up: Literal["z", "y"] = "z"  # which axis of the file points up
    mass: float | None = None  # [kg]; None: from the density
    density: float = DENSITY  # [kg/m³]
    friction: float = FRICTION
    faces: int = CORE_FACES  # of the collision surface
    decompose: bool = False  # cut convex pieces where none are given: minutes
    source: dict[str, Any] = field(default_factory=dict)  # where it is from, and its licence


def import_mesh(path: Path, name: str, options: ImportOptions) -> dict[str, Any]:
    """Imports one mesh into the library, in place of what had its name; returns the report.

    The folder appears whole or not at all.

    Raises:
        InputError: the mesh or an option cannot be used.
        OSError: the library cannot be written to.
    """
    _check(options)
    started = time.perf_counter()
    target = library_dir() / checked_name(name)
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.parent / f".{secrets.token_hex(4)}.tmp" / name
    try:
        unfinished.mkdir(parents=True)
        report = _build(path, unfinished, options)
        report["seconds"] = round(time.perf_counter() - started, 2)
        write_atomically(unfinished / REPORT, json.dumps(report, indent=1) + "\n")
        shutil.rmtree(target, ignore_errors=True)
        unfinished.rename(target)
    finally:
        shutil.rmtree(unfinished.parent, ignore_errors=True)
    return report


def _check(options: ImportOptions) -> None:
    for what, value, (low, high) in (
        ("--mass", options.mass, MASS_RANGE),
        ("--density", options.density, (10.0, 20_000.0)),
        ("--friction", options.friction, (0.05, 2.0)),
    ):
        if value is not None and not low <= value <= high:
            raise InputError(f"{what} must be from {low:g} to {high:g}, not {value:g}")


def _build(path: Path, folder: Path, options: ImportOptions) -> dict[str, Any]:
    mesh = read_mesh(path, scale=options.scale, up=options.up)
    solid = solid_of(mesh)
    core = core_of(solid, options.faces)
    pieces, notes = _pieces(path, solid, options)
    inertia = inertia_of(solid, pieces, mass=options.mass, density=options.density)
    if not MASS_RANGE[0] <= inertia.mass <= MASS_RANGE[1]:
        raise InputError(
            f"{path} would weigh {inertia.mass:.3g} kg at {options.density:g} kg/m³: give --mass"
        )
    write_visual(mesh, folder)
    write_model(folder, core=core, skin=pieces, inertia=inertia, friction=options.friction)
    _keep_licence(path.parent / LICENCE, folder)
    settled = settle(folder / MODEL, core[0])
    if not solid.watertight:
        notes.append("the surface is not closed: volume and inertia are estimates")
    if solid.dropped:
        notes.append(f"{solid.dropped} triangles were debris, and dropped")
    if not settled.ok:
        notes.append("it does not lie still on the table: see settled")
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return {
        "file": path.name,
        "source": options.source,
        "extent": np.round(upper - lower, 5).tolist(),  # [m]
        "bounds": [np.round(lower, 5).tolist(), np.round(upper, 5).tolist()],  # [m]
        "volume": solid.volume,  # [m³]
        "mass": inertia.mass,  # [kg]
        "inertia_from": inertia.how,
        "watertight": solid.watertight,
        "textured": mesh.texture is not None,
        "faces": {"file": len(mesh.faces), "core": len(core[1])},
        "pieces": len(pieces),
        "settled": asdict(settled) | {"X_WB": settled.X_WB.tolist(), "ok": settled.ok},
        "notes": notes,
    }


def _keep_licence(licence: Path, folder: Path) -> None:
    if licence.is_file() and licence.stat().st_size <= MAX_LICENCE_BYTES:
        write_atomically(folder / LICENCE, licence.read_bytes())


def _pieces(path: Path, solid: Solid, options: ImportOptions) -> tuple[list[Piece], list[str]]:
    """The convex pieces, and what is to be said of them."""
    turn = np.eye(3)
    if options.up == "y":
        turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for pattern in _PIECES:
        files: Sequence[Path] = sorted(path.parent.glob(pattern))
        if files:
            return read_pieces(files, options.scale, turn), []
    if options.decompose:
        return decompose(solid), []
    return [], [
        "no convex pieces came with it: against other scanned objects it touches by points of its "
        f"convex hull. --decompose cuts it into pieces (needs {INSTALL})"
    ]
