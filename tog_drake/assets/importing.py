"""From a mesh file to an object that can be grasped: read, clean, simplify, weigh, write, test."""

import errno
import json
import os
import re
import secrets
import shutil
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tog_drake.assets.collision import (
    CORE_FACES,
    FINE_FACES,
    INSTALL,
    Piece,
    core_faces,
    core_of,
    decompose,
    find_pieces,
    fits,
    merged,
    read_pieces,
)
from tog_drake.assets.library import PARTS, PREVIEW, REPORT, VARIABLE, checked_name, library_dir
from tog_drake.assets.mesh import Axis, ScannedMesh, Solid, read_mesh, solid_of, turn_from, up_axis
from tog_drake.assets.model import DENSITY, FRICTION, MODEL, Inertia, inertia_of, write_model
from tog_drake.assets.preview import write_preview
from tog_drake.assets.settle import Settled, settle
from tog_drake.assets.visual import write_visual
from tog_drake.errors import InputError
from tog_drake.files import write_atomically

LICENCE = "LICENSE.txt"  # goes with the object where it lies beside the mesh
MAX_LICENCE_BYTES = 1_000_000
MASS_RANGE = (0.001, 20.0)  # [kg]
# What half of all meshes are called: there the folder's name says more.
_GENERIC = ("mesh", "model", "scene", "textured", "nontextured", "untitled", "visual", "meshes")


@dataclass
class ImportOptions:
    """What a mesh does not say of itself."""

    scale: float = 1.0  # metres per unit of the file
    up: Axis | None = None  # which axis of the file points up; None: see ``mesh.up_axis``
    mass: float | None = None  # [kg]; None: from the density
    density: float = DENSITY  # [kg/m³]
    friction: float = FRICTION
    faces: int | None = None  # of the collision surface; None: as few as lie still
    decompose: bool = False  # cut convex pieces where none are given: seconds to minutes
    source: dict[str, Any] = field(default_factory=dict)  # where it is from, and its licence


def name_for(path: Path) -> str:
    """Returns a name for the object of a mesh file; where that says nothing, by its folders."""
    folders = (path.stem, path.resolve().parent.name, path.resolve().parent.parent.name)
    said = next((name for name in folders if name.lower() not in _GENERIC), path.stem)
    return re.sub(r"[^A-Za-z0-9_.-]+|\.{2,}", "_", said).strip("_.-")[:100] or "object"


def import_mesh(path: Path, name: str, options: ImportOptions) -> dict[str, Any]:
    """Imports one mesh into the library, in place of what had its name; returns the report.

    The folder appears whole or not at all; part labels that lay in it stay.

    Raises:
        InputError: the mesh or an option cannot be used.
        OSError: the library cannot be written to.
    """
    _check(options)
    started = time.perf_counter()
    target = library_dir() / checked_name(name)
    unfinished = target.parent / f".{os.getpid()}-{secrets.token_hex(4)}.tmp" / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        sweep()
        unfinished.mkdir(parents=True)
        report = _build(path, unfinished, options)
        report["seconds"] = round(time.perf_counter() - started, 2)
        write_atomically(unfinished / REPORT, json.dumps(report, indent=1) + "\n")
        _put_in_place(unfinished, target)
    except OSError as error:
        raise OSError(
            f"cannot write to {target.parent}: {error.strerror or error}; make room, or name "
            f"another folder by {VARIABLE}"
        ) from error
    finally:
        shutil.rmtree(unfinished.parent, ignore_errors=True)
    return report


def sweep() -> None:
    """Removes what imports have left whose process was killed."""
    for folder in library_dir().glob(".*-*.tmp"):
        process = folder.name[1:].partition("-")[0]
        if process.isdecimal() and not _runs(int(process)):
            shutil.rmtree(folder, ignore_errors=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it runs, but is not ours
        return True
    return True


def _put_in_place(unfinished: Path, target: Path) -> None:
    """Gives a finished folder its name; two imports at once leave that of the last."""
    for i in range(100):
        aside = unfinished.parent / f"before_{i}"
        try:
            with suppress(FileNotFoundError):
                target.rename(aside)
                if (aside / PARTS).is_file() and not (unfinished / PARTS).exists():
                    shutil.copyfile(aside / PARTS, unfinished / PARTS)
            unfinished.rename(target)
            return
        except BaseException as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # another import was faster
            if aside.exists() and not target.exists():  # interrupted between the two
                aside.rename(target)
            raise
    raise InputError(f"{target} is written to by others without end; try again")


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
    pieces, notes = _pieces(path, solid, options)
    inertia = inertia_of(solid, pieces, mass=options.mass, density=options.density)
    if not MASS_RANGE[0] <= inertia.mass <= MASS_RANGE[1]:
        raise InputError(
            f"{path} would weigh {inertia.mass:.3g} kg at {options.density:g} kg/m³: give --mass"
        )
    write_visual(mesh, solid, folder)
    skin = merged(pieces)
    settled, faces, finer = _write_settled(folder, solid, skin, inertia, options)
    _keep_licence(path.parent / LICENCE, folder)
    notes = [*mesh.notes, *notes, *_remarks(solid, settled, faces, finer, options)]
    try:
        write_preview(folder, solid.vertices)
    except InputError as error:  # a machine that cannot render can still simulate
        notes.append(f"no {PREVIEW}: {error}")
    return _report(path, mesh, solid, inertia, settled) | {
        "source": options.source,
        "faces": {"file": len(mesh.faces), "core": faces},
        "pieces": len(skin),
        "notes": notes,
    }


def _write_settled(
    folder: Path, solid: Solid, skin: list[Piece], inertia: Inertia, options: ImportOptions
) -> tuple[Settled, int, bool]:
    """Writes the model and tests it; returns how it lies, its core's faces, and if it is finer.

    Where nobody says how fine the core is to be and it does not lie still, it is made finer: small
    hooves end in spikes otherwise, which sink in.
    """
    finer = (core_faces(solid), CORE_FACES[1], FINE_FACES)
    for faces in sorted({*finer}) if options.faces is None else (options.faces,):
        core = core_of(solid, faces)
        write_model(folder, core=core, skin=skin, inertia=inertia, friction=options.friction)
        settled = settle(folder / MODEL, core[0])
        if settled.ok:
            break
    return settled, len(core[1]), faces == FINE_FACES


def _remarks(
    solid: Solid, settled: Settled, faces: int, finer: bool, options: ImportOptions
) -> list[str]:
    notes = []
    if not solid.watertight:
        notes.append("the surface is not closed: volume and inertia are estimates")
    if solid.dropped:
        notes.append(f"{solid.dropped} triangles were debris, and dropped")
    if options.faces is None and settled.ok and finer:
        notes.append(f"it needs {faces} faces to lie still, which is slower to simulate")
    if not settled.ok:
        notes.append("it does not lie still on the table: see settled")
    return notes


def _report(
    path: Path, mesh: ScannedMesh, solid: Solid, inertia: Inertia, settled: Settled
) -> dict[str, Any]:
    lower, upper = solid.vertices.min(axis=0), solid.vertices.max(axis=0)  # without debris
    return {
        "file": path.name,
        "extent": np.round(upper - lower, 5).tolist(),  # [m]
        "bounds": [np.round(lower, 5).tolist(), np.round(upper, 5).tolist()],  # [m]
        "volume": solid.volume,  # [m³]
        "mass": inertia.mass,  # [kg]
        "inertia_from": inertia.how,
        "watertight": solid.watertight,
        "textured": mesh.texture is not None,
        "settled": asdict(settled) | {"X_WB": settled.X_WB.tolist(), "ok": settled.ok},
    }


def _keep_licence(licence: Path, folder: Path) -> None:
    if licence.is_file() and licence.stat().st_size <= MAX_LICENCE_BYTES:
        write_atomically(folder / LICENCE, licence.read_bytes())


def _pieces(path: Path, solid: Solid, options: ImportOptions) -> tuple[list[Piece], list[str]]:
    """The convex pieces, and what is to be said of them."""
    files, notes = find_pieces(path), []
    if files:
        pieces = read_pieces(files, options.scale, turn_from(options.up or up_axis(path)))
        if fits(pieces, solid):
            return pieces, []
        notes.append(
            f"the convex pieces beside it ({files[0].name}) are of another shape: not used"
        )
    if options.decompose:
        return decompose(solid), notes
    return [], [
        *notes,
        "no convex pieces came with it: against other scanned objects it touches by points of its "
        f"convex hull. --decompose cuts it into pieces (needs {INSTALL})",
    ]
