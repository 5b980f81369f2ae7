"""From a list of pieces to the files of an object: its OBJ meshes and its SDF.

Metres, kilograms and radians. The frame of an object is B: z up, origin on the table below it.
A *section* is an outline (N, 2); a *ring* is a section placed in B, (N, 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Cylinder, Ellipsoid, Sphere, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import CalcSpatialInertia, SpatialInertia
from scipy.interpolate import CubicSpline
from scipy.spatial import ConvexHull

from tog_drake.values import Array

Faces = NDArray[np.intp]
Triple = tuple[float, float, float]
ORIGIN: Triple = (0.0, 0.0, 0.0)

MICRON = 6  # decimals of a length in a file
CREASE = np.radians(50.0)  # edges sharper than this stay sharp when a mesh is drawn

# The same contact for every piece (see models/README.md).
PROXIMITY = """\
        <drake:proximity_properties>
          <drake:compliant_hydroelastic/>
          <drake:hydroelastic_modulus>5e6</drake:hydroelastic_modulus>
          <drake:mesh_resolution_hint>0.01</drake:mesh_resolution_hint>
          <drake:hunt_crossley_dissipation>1.25</drake:hunt_crossley_dissipation>
          <drake:mu_dynamic>0.8</drake:mu_dynamic>
          <drake:mu_static>0.8</drake:mu_static>
        </drake:proximity_properties>
"""


@dataclass(frozen=True)
class Material:
    """What a piece is made of. Paint has no density: a piece of it is only drawn."""

    colour: Triple  # red, green, blue from 0 to 1
    density: float = 0.0  # [kg/m³]


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A closed surface; the vertices of a face run counter-clockwise, seen from outside."""

    vertices: Array  # (N, 3)
    faces: Faces  # (M, 3)


@dataclass(frozen=True)
class Piece:
    """One shape of an object, posed in B by ``xyz`` and roll, pitch, yaw.

    A piece weighs what its material does, or ``mass`` where that is given. Where contact needs
    convex shapes and the eye sees one round thing, the latter is not ``solid`` and pieces of no
    material, not ``drawn``, take the contact.
    """

    name: str
    shape: Box | Cylinder | Ellipsoid | Sphere | TriangleMesh
    material: Material | None = None
    xyz: Triple = ORIGIN
    rpy: Triple = ORIGIN
    mass: float | None = None  # [kg]
    drawn: bool = True  # has a <visual>
    solid: bool = True  # has a <collision>


@dataclass(frozen=True)
class Thing:
    """An object: one free body."""

    name: str
    about: str  # what it is, its frame, its size, its materials: the comment in the SDF
    pieces: Sequence[Piece]


# Sections and rings.


def octagon(width: float, height: float, chamfer: float) -> Array:
    """A rectangle about the origin without its corners, (8, 2)."""
    a, b, c = width / 2, height / 2, chamfer
    right = [(a, b - c), (a - c, b), (-a + c, b), (-a, b - c)]
    return np.array([*right, *((-x, -y) for x, y in right)])


def ellipse(a: float, b: float, count: int, phase: float = 0.0) -> Array:
    """An ellipse with half axes ``a``, ``b``, (count, 2), its first point ``phase`` steps on."""
    t = (np.arange(count) + phase) * 2 * np.pi / count
    return np.stack([a * np.cos(t), b * np.sin(t)], axis=1)


def ring(
    section: Array, axis: Literal["x", "y", "z"], at: float, centre: tuple[float, float] = (0, 0)
) -> Array:
    """The section in the plane ``axis`` = ``at``, its coordinates along the other two axes."""
    return np.insert(section + centre, "xyz".index(axis), at, axis=1)


def bar(x: float, z: float, width: float, height: float, chamfer: float) -> Array:
    """A ring of a bar along x, at height ``z``: ``width`` along y, ``height`` along z."""
    return ring(octagon(width, height, chamfer), "x", x, (0, z))


def smooth_path(xz: Sequence[tuple[float, float]], count: int) -> Array:
    """A path (count, 3) in the plane y = 0 through the points x, z, evenly along a cubic spline."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xz, axis=0), axis=1))])
    path = CubicSpline(along, xz)(np.linspace(0, along[-1], count))
    return np.insert(path, 1, 0.0, axis=1)


def sweep(path: Array, sections: Sequence[Array]) -> list[Array]:
    """Rings along ``path`` (M, 3), which lies in a plane y = constant, one section per point.

    A section's first coordinate lies along y, its second along (tangent × y).
    """
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    y = np.array([0.0, 1.0, 0.0])
    return [
        p + s[:, :1] * y + s[:, 1:] * np.cross(t, y)
        for p, t, s in zip(path, tangents, sections, strict=True)
    ]


# Meshes.


def loft(rings: Sequence[Array]) -> TriangleMesh:
    """The surface through rings of equally many points, closed by a fan at either end."""
    m, n = len(rings), len(rings[0])
    vertices = np.vstack([*rings, rings[0].mean(0), rings[-1].mean(0)])
    here = np.arange(n)
    after = (here + 1) % n
    quads = [
        triangle
        for i in range(m - 1)
        for j, k in zip(here + i * n, after + i * n, strict=True)
        for triangle in ((j, k, k + n), (j, k + n, j + n))
    ]
    last = (m - 1) * n
    fans = [
        triangle
        for j, k in zip(here, after, strict=True)
        for triangle in ((m * n, k, j), (m * n + 1, last + j, last + k))
    ]
    faces = np.array(quads + fans)
    volume = np.linalg.det(vertices[faces]).sum() / 6
    return TriangleMesh(vertices, faces if volume > 0 else faces[:, ::-1])


def hoop(rings: Sequence[Array]) -> TriangleMesh:
    """The surface through rings and from the last to the first again: a torus."""
    mesh = loft([*rings, rings[0]])
    corners = len(mesh.vertices) - 2  # without the middles of the fans
    return TriangleMesh(mesh.vertices[:corners], mesh.faces[np.all(mesh.faces < corners, axis=1)])


def hull(*points: Array) -> TriangleMesh:
    """The convex hull of all the points (N, 3) given."""
    corners = np.unique(np.round(np.vstack(points), MICRON), axis=0)
    simplices = ConvexHull(corners).simplices
    used, faces = np.unique(simplices, return_inverse=True)
    corners, faces = corners[used], faces.reshape(-1, 3)
    inward = np.linalg.det(corners[faces] - corners.mean(0)) < 0
    faces[inward] = faces[inward, ::-1]
    return TriangleMesh(corners, faces)


def join(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return TriangleMesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def write_obj(path: Path, mesh: TriangleMesh, comment: str) -> None:
    """Writes a mesh with one normal per corner, smooth except across creases."""
    corners = mesh.vertices[mesh.faces]
    scaled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
    points = np.round(mesh.vertices, MICRON) + 0.0  # no negative zeros
    places = [tuple(point) for point in points]
    faces_at: dict[tuple[float, ...], list[int]] = {}
    for i, face in enumerate(mesh.faces):
        for vertex in face:
            faces_at.setdefault(places[vertex], []).append(i)

    number: dict[tuple[float, ...], int] = {}  # of each normal, from 1, as OBJ counts
    rows = []
    for i, face in enumerate(mesh.faces):
        words = []
        for vertex in face:
            near = [j for j in faces_at[places[vertex]] if unit[j] @ unit[i] > np.cos(CREASE)]
            normal = scaled[near].sum(0)
            rounded = tuple(np.round(normal / np.linalg.norm(normal), 3) + 0.0)
            words.append(f"{vertex + 1}//{number.setdefault(rounded, len(number) + 1)}")
        rows.append("f " + " ".join(words))
    lines = [f"# {comment}"]
    lines += ["v " + " ".join(f"{x:.6g}" for x in point) for point in points]
    lines += ["vn " + " ".join(f"{x:.3g}" for x in normal) for normal in number]
    path.write_text("\n".join(lines + rows) + "\n")


# Inertia.


def inertia_of(piece: Piece) -> SpatialInertia:
    """The spatial inertia of one piece about Bo, in B."""
    shape = piece.shape
    if isinstance(shape, TriangleMesh):
        triangles = [SurfaceTriangle(*(int(v) for v in face)) for face in shape.faces]
        shape = TriangleSurfaceMesh(triangles, list(np.round(shape.vertices, MICRON)))
    of_water = CalcSpatialInertia(shape, 1000.0)
    mass = piece.mass
    if mass is None:
        density = piece.material.density if piece.material else 0.0
        mass = density / 1000.0 * of_water.get_mass()
    X_BS = RigidTransform(RollPitchYaw(piece.rpy), piece.xyz)
    about_own_origin = SpatialInertia(mass, of_water.get_com(), of_water.get_unit_inertia())
    return about_own_origin.ReExpress(X_BS.rotation()).Shift(-X_BS.translation())


def inertial_xml(pieces: Sequence[Piece]) -> str:
    """The sum over all pieces: mass, centre of mass, and moments about it."""
    total = SpatialInertia.Zero()
    for piece in pieces:
        total += inertia_of(piece)
    centre = total.get_com()
    moments = total.Shift(centre).CalcRotationalInertia().CopyToFullMatrix3()
    moments[np.abs(moments) < 1e-9] = 0.0
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    rows = "".join(
        f"          <{name}>{moment:.4g}</{name}>\n"
        for name, moment in zip(names, moments[np.triu_indices(3)], strict=True)
    )
    return (
        "      <inertial>\n"
        f"        <pose>{text(np.round(centre, 5))} 0 0 0</pose>\n"
        f"        <mass>{total.get_mass():.4g}</mass>\n"
        f"        <inertia>\n{rows}        </inertia>\n"
        "      </inertial>\n"
    )


# The SDF.


def text(values: Sequence[float] | Array) -> str:
    """Numbers to a micron, without negative zeros."""
    return " ".join(f"{round(float(x), MICRON) + 0.0:.6g}" for x in values)


def shape_xml(piece: Piece, convex: bool) -> str:
    """The geometry of a piece; a mesh is in the file of its name."""
    match piece.shape:
        case Box() as box:
            return f"<box><size>{text(box.size())}</size></box>"
        case Cylinder() as rod:
            radius, length = text([rod.radius()]), text([rod.length()])
            return f"<cylinder><radius>{radius}</radius><length>{length}</length></cylinder>"
        case Sphere() as ball:
            return f"<sphere><radius>{text([ball.radius()])}</radius></sphere>"
        case Ellipsoid() as egg:
            return f"<ellipsoid><radii>{text([egg.a(), egg.b(), egg.c()])}</radii></ellipsoid>"
    declared = "<drake:declare_convex/>" if convex else ""
    return f"<mesh>{declared}<uri>{piece.name}.obj</uri></mesh>"


def geometry_xml(piece: Piece, tag: Literal["visual", "collision"]) -> str:
    """The <visual> or <collision> of a piece."""
    pose = "" if piece.xyz == piece.rpy == ORIGIN else f"{text(piece.xyz)} {text(piece.rpy)}"
    shape = shape_xml(piece, convex=tag == "collision")
    inside = f"        <pose>{pose}</pose>\n" if pose else ""
    inside += f"        <geometry>{shape}</geometry>\n"
    if tag == "collision":
        inside += PROXIMITY
    elif piece.material:
        colour = text(piece.material.colour)
        inside += f"        <material><diffuse>{colour} 1</diffuse></material>\n"
    return f'      <{tag} name="{piece.name}">\n{inside}      </{tag}>\n'


def sdf_xml(thing: Thing) -> str:
    """The SDF file of a thing: one link, ``base``."""
    about = "".join(f"  {line}\n" for line in thing.about.strip().splitlines())
    geometries = ""
    for piece in thing.pieces:
        geometries += geometry_xml(piece, "visual") if piece.drawn else ""
        geometries += geometry_xml(piece, "collision") if piece.solid else ""
    return (
        f'<?xml version="1.0"?>\n<!--\n{about}-->\n'
        '<sdf version="1.9" xmlns:drake="http://drake.mit.edu">\n'
        f'  <model name="{thing.name}">\n    <link name="base">\n'
        f"{inertial_xml(thing.pieces)}{geometries}"
        "    </link>\n  </model>\n</sdf>\n"
    )


def write_thing(folder: Path, thing: Thing) -> None:
    """Writes the thing's SDF and meshes into ``folder / thing.name``; leaves its labels alone."""
    folder = folder / thing.name
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("*.obj"):
        stale.unlink()
    for piece in thing.pieces:
        if isinstance(piece.shape, TriangleMesh):
            comment = f"{thing.name}: {piece.name.replace('_', ' ')}, made for tog_drake"
            write_obj(folder / f"{piece.name}.obj", piece.shape, comment)
    (folder / f"{thing.name}.sdf").write_text(sdf_xml(thing))
