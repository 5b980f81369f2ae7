"""Writes a scanned object as a model: an SDF with visual, core, skin and inertia."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from pydrake.multibody.tree import RotationalInertia, SpatialInertia

from tog_drake.assets.collision import Piece
from tog_drake.assets.mesh import Faces, Solid
from tog_drake.assets.visual import VISUAL
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.values import Array

MODEL = "model.sdf"
CORE_FILE = "core.obj"
CORE, SKIN = "core", "skin"
"""Names of the collision geometries; the pieces of a skin are skin_0, skin_1 ...
``stations.simulation`` filters contacts by them."""

FRICTION = 0.8
DISSIPATION = 1.25  # [s/m]
SKIN_MODULUS = 1e7  # [Pa]
_WHY = "which is more than it fills: the surface is not closed"
DENSITY = 400.0  # [kg/m³] where nobody says: between a hollow toy and a full bottle


@dataclass(frozen=True)
class Inertia:
    """Mass properties in the object's frame."""

    mass: float  # [kg]
    center: Array  # (3,) [m]
    moments: Array  # (3, 3) [kg m²] about the centre of mass
    how: str  # what they were computed from, for a person


def inertia_of(solid: Solid, pieces: list[Piece], *, mass: float | None, density: float) -> Inertia:
    """Integrates a solid of even density.

    One that is not watertight has no volume: its convex pieces stand for it, or its convex hull.

    Raises:
        InputError: not even its hull has the mass properties of a body.
    """
    import trimesh

    surface = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    bodies = [(surface, "its surface")] if solid.watertight else []
    if pieces:
        parts = [trimesh.Trimesh(*piece, process=False) for piece in pieces]
        bodies.append((trimesh.util.concatenate(parts), f"the sum of its convex pieces, {_WHY}"))
    bodies.append((surface.convex_hull, f"its convex hull, {_WHY}"))
    for body, how in bodies:
        inertia = _integrate(body, how, mass, density)
        if _can_be(inertia):
            return inertia
    raise InputError("no body of even density has this shape; mend the mesh")


def _integrate(body: Any, how: str, mass: float | None, density: float) -> Inertia:
    volume = float(body.volume)
    if mass is None:
        mass = density * volume
    body.density = mass / volume if volume > 0 else 0.0
    return Inertia(mass, np.asarray(body.center_mass), np.asarray(body.moment_inertia), how)


def _can_be(inertia: Inertia) -> bool:
    """Whether Drake takes it for a body's: surfaces that cross themselves may add up to none."""
    m = inertia.moments
    if not (inertia.mass > 0 and np.isfinite(m).all() and np.isfinite(inertia.center).all()):
        return False
    try:
        moments = RotationalInertia(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])
        SpatialInertia.MakeFromCentralInertia(inertia.mass, inertia.center, moments)
    except (RuntimeError, SystemExit):  # as conditions of Drake end where they do not hold
        return False
    return bool(np.linalg.eigvalsh(m)[0] > 0)


def write_model(
    folder: Path,
    *,
    core: tuple[Array, Faces],
    skin: list[Piece],
    inertia: Inertia,
    friction: float = FRICTION,
) -> None:
    """Writes ``model.sdf`` and the meshes of core and skin; the visual must be there already."""
    write_atomically(folder / CORE_FILE, _obj(*core))
    for i, piece in enumerate(skin):
        write_atomically(folder / f"skin_{i}.obj", _obj(*piece))
    write_atomically(folder / MODEL, _sdf(folder.name, len(skin), inertia, friction))


def _obj(vertices: Array, faces: Faces) -> str:
    """A plain OBJ, to the tenth of a micrometre."""
    lines = ["v {:.7f} {:.7f} {:.7f}".format(*vertex) for vertex in vertices]
    lines += ["f {} {} {}".format(*face) for face in faces + 1]
    return "\n".join(lines) + "\n"


def _sdf(name: str, pieces: int, inertia: Inertia, friction: float) -> str:
    ixx, ixy, ixz = inertia.moments[0]
    iyy, iyz, izz = inertia.moments[1, 1], inertia.moments[1, 2], inertia.moments[2, 2]
    x, y, z = inertia.center
    contact = (
        f"<drake:mu_dynamic>{friction:g}</drake:mu_dynamic>"
        f"<drake:mu_static>{friction:g}</drake:mu_static>"
        f"<drake:hunt_crossley_dissipation>{DISSIPATION:g}</drake:hunt_crossley_dissipation>"
    )
    skin = "".join(
        f"""
      <collision name="{SKIN}_{i}">
        <geometry><mesh><uri>skin_{i}.obj</uri><drake:declare_convex/></mesh></geometry>
        <drake:proximity_properties>
          <drake:compliant_hydroelastic/>
          <drake:hydroelastic_modulus>{SKIN_MODULUS:g}</drake:hydroelastic_modulus>{contact}
        </drake:proximity_properties>
      </collision>"""
        for i in range(pieces)
    )
    return f"""<?xml version="1.0"?>
<sdf version="1.9" xmlns:drake="drake.mit.edu">
  <model name={quoteattr(name)}>
    <link name="base">
      <inertial>
        <pose>{x:.9g} {y:.9g} {z:.9g} 0 0 0</pose>
        <mass>{inertia.mass:.9g}</mass>
        <inertia>
          <ixx>{ixx:.9g}</ixx><iyy>{iyy:.9g}</iyy><izz>{izz:.9g}</izz>
          <ixy>{ixy:.9g}</ixy><ixz>{ixz:.9g}</ixz><iyz>{iyz:.9g}</iyz>
        </inertia>
      </inertial>
      <visual name="visual">
        <geometry><mesh><uri>{VISUAL}</uri></mesh></geometry>
      </visual>
      <collision name="{CORE}">
        <geometry><mesh><uri>{CORE_FILE}</uri></mesh></geometry>
        <drake:proximity_properties><drake:rigid_hydroelastic/>{contact}</drake:proximity_properties>
      </collision>{skin}
    </link>
  </model>
</sdf>
"""
