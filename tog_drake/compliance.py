"""The labelled parts of objects: which one is held, and whether the task allows it.

Part labels are simulated ground truth. They are for judging, evaluating and showing; no stage of
the pipeline but the oracle (``selectors/oracle.py``) reads them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    QueryObject,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, MultibodyPlant

from tog_drake.assets.model import CORE, SKIN
from tog_drake.errors import InputError
from tog_drake.labelled_surface import UNLABELLED, LabelledSurface, Shares, labelled_surface
from tog_drake.object_parts import ObjectParts
from tog_drake.panda import PAD_WIDTH
from tog_drake.values import Array, Grasps

Planes = tuple[Array, Array, float]
"""Outward normals (F, 3), offsets (F,) [m] and the distance of the farthest corner from the origin
[m], in the frame of the geometry."""


@dataclass(frozen=True)
class PartLabels:
    """The part that each collision geometry of the objects, or place on a core, belongs to.

    An object without labels counts as one part, for what the hand meets of it.
    """

    part_of: dict[GeometryId, tuple[str, str]]  # -> (model instance, part)
    objects: dict[str, ObjectParts]  # by model instance
    planes: dict[GeometryId, Planes]  # that bound each of those geometries
    surfaces: dict[GeometryId, LabelledSurface]  # of scanned objects: their cores

    @staticmethod
    def from_plant(
        plant: MultibodyPlant, scene_graph: SceneGraph, objects: dict[str, ObjectParts]
    ) -> "PartLabels":
        """Finds the geometries of all objects in a finalized plant.

        Args:
            plant: whose free bodies are the objects.
            scene_graph: where it has its geometries.
            objects: the labels of those that have any, by model instance; those of others may
                have no parts.

        Raises:
            InputError: if a labelled object has a collision geometry without a part.
        """
        inspector = scene_graph.model_inspector()
        part_of: dict[GeometryId, tuple[str, str]] = {}
        surfaces: dict[GeometryId, LabelledSurface] = {}
        for index in sorted(plant.GetFloatingBaseBodies()):
            body = plant.get_body(index)
            model = plant.GetModelInstanceName(body.model_instance())
            labels = objects.get(model)
            for geometry in plant.GetCollisionGeometriesForBody(body):
                name = inspector.GetName(geometry).split("::")[-1]
                shape = inspector.GetShape(geometry)
                if name == CORE and isinstance(shape, Mesh):
                    regions = labels.regions if labels else ()
                    core = Path(shape.source().path())
                    surfaces[geometry] = labelled_surface(model, core, regions, index)
                elif name.startswith(f"{SKIN}_"):
                    continue  # no pad touches it
                elif labels is None or not labels.part_words:
                    part_of[geometry] = (model, UNLABELLED)
                elif name not in labels.geometries:
                    raise InputError(
                        f"collision geometry {name} of {model} has no part in its parts.yaml; "
                        f"labelled are {', '.join(labels.geometries) or 'regions of its core'}"
                    )
                else:
                    part_of[geometry] = (model, labels.geometries[name])
        planes = {g: _planes(inspector, g) for g in part_of}
        return PartLabels(part_of, objects, planes, surfaces)

    def closing_region(
        self, grasps: Grasps, query_object: QueryObject, *, beside: float = 0.0
    ) -> list[Shares]:
        """Returns the share of each (model instance, part) in what each grasp closes on.

        The box between the pads, a little wider than they are, is sampled; each sample counts for
        the part nearest to it, if one is near. The samples nearest to a scanned object are shared
        out by what the pads would press of it: it has a surface, but no inside.

        Args:
            grasps: N of them.
            query_object: where the objects are.
            beside: [m] by which the pads on scanned objects are taken to be larger.
        """
        if len(grasps) == 0:
            return []
        samples = _region_samples(grasps)
        parts, nearest = self.nearest_part(samples.reshape(-1, 3), query_object, _CONTACT_REACH)
        regions: list[Shares] = []
        for row in nearest.reshape(samples.shape[:2]):
            found, counts = np.unique(row[row >= 0], return_counts=True)
            shares = counts / counts.sum()
            regions.append({parts[i]: float(s) for i, s in zip(found, shares, strict=True)})
        for geometry, surface in self.surfaces.items():
            X_WO = query_object.GetPoseInWorld(geometry).GetAsMatrix4()
            for region, pressed in zip(regions, surface.pressed(X_WO, grasps, beside), strict=True):
                if pressed:
                    of_it = [region.pop(part, 0.0) for part in dict.fromkeys(surface.parts)]
                    region |= {part: sum(of_it) * share for part, share in pressed.items()}
        return regions

    def nearest_part(
        self, p_W: Array, query_object: QueryObject, reach: float
    ) -> tuple[list[tuple[str, str]], NDArray[np.int64]]:
        """Finds the labelled part nearest to each of the points p_W (P, 3).

        Distances are to the planes of each convex shape: exact inside and before its faces, too
        short beside its edges; of a scanned object, to points on its surface.

        Returns:
            All (model instance, part), and of each point which of them it is (P,); -1 where none
            is within ``reach`` [m].
        """
        known = [*self.part_of.values()]
        known += [part for surface in self.surfaces.values() for part in surface.parts]
        parts = list(dict.fromkeys(known))
        nearest = np.full(len(p_W), -1)
        distance = np.full(len(p_W), reach)
        for geometry, part in self.part_of.items():
            normal, offset, radius = self.planes[geometry]
            p_G = query_object.GetPoseInWorld(geometry).inverse().multiply(p_W.T).T
            row = np.flatnonzero((p_G**2).sum(axis=1) < (radius + reach) ** 2)
            to_shape = (p_G[row] @ normal.T - offset).max(axis=1)
            nearer = to_shape < distance[row]
            distance[row[nearer]] = to_shape[nearer]
            nearest[row[nearer]] = parts.index(part)
        for geometry, surface in self.surfaces.items():
            p_G = query_object.GetPoseInWorld(geometry).inverse().multiply(p_W.T).T
            to_surface, point = surface.tree.query(p_G, distance_upper_bound=reach)
            row = np.flatnonzero(to_surface < distance)
            distance[row] = to_surface[row]
            index = np.array([parts.index(part) for part in surface.parts])
            nearest[row] = index[surface.part[point[row]]]
        return parts, nearest

    def held(
        self,
        contacts: ContactResults,
        pads: frozenset[GeometryId],
        poses: Sequence[RigidTransform],
        *,
        by_part: bool = True,
    ) -> Shares:
        """Returns the force [N] of the finger pads on each (model instance, part).

        Where a pad meets a scanned object, each face of the patch of contact counts for the part
        that its middle lies on, by area and pressure.

        Args:
            contacts: all of them.
            pads: the geometries of the fingers.
            poses: X_WB of every body, by its index.
            by_part: False to count all of a scanned object as ``UNLABELLED``: its faces take most
                of the time.
        """
        force: Shares = {}
        for a, b, newtons, i in contact_forces(contacts, pads):
            other = b if a in pads else a
            if other in self.part_of:
                shares = {self.part_of[other]: 1.0}
            elif other in self.surfaces:
                surface = self.surfaces[other]
                if not by_part:
                    whole = surface.parts[-1]
                    force[whole] = force.get(whole, 0.0) + newtons
                    continue
                p_W, weight = _patch(contacts, i)
                p_O = poses[surface.body].inverse().multiply(p_W.T).T
                shares = surface.shares(p_O, weight)
            else:
                continue
            for part, share in shares.items():
                force[part] = force.get(part, 0.0) + share * newtons
        return force


_CONTACT_REACH = 0.02  # [m] a sample farther than this from every part counts for none


def _region_samples(grasps: Grasps) -> Array:
    """Points between the pads, (N, 24, 3) [m]: across, along and beyond the pads' faces."""
    x, y, z = np.moveaxis(grasps.X_WG[:, :3, :3], -1, 0)
    from_middle = grasps.p_WContact - grasps.X_WG[:, :3, 3]
    side = np.where((from_middle * y).sum(axis=1) < 0, -1.0, 1.0)
    along = np.array([-0.7, 0.0, 0.7]) * PAD_WIDTH
    across = np.array([0.0, 1 / 3, 2 / 3, 1.0])
    deep = np.array([-0.4, 0.4]) * PAD_WIDTH
    grid = np.stack(np.meshgrid(along, across, deep), axis=-1).reshape(-1, 3)
    inwards = -(side * grasps.width)[:, None] * y
    samples: Array = grasps.p_WContact[:, None] + grid @ np.stack([x, inwards, z], axis=1)
    return samples


def _planes(inspector: SceneGraphInspector, geometry: GeometryId) -> Planes:
    """Returns the planes that bound a convex shape; a round one is cut out by 96 of them."""
    shape = inspector.GetShape(geometry)
    hull = inspector.GetConvexHull(geometry)
    if hull is not None:
        corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        normal = np.array([hull.face_normal(i) for i in range(hull.num_faces())])
        offset = (corners @ normal.T).max(axis=0)
        return normal, offset, float(np.linalg.norm(corners, axis=1).max())
    turn, height = np.pi * (3 - np.sqrt(5)) * np.arange(96), np.linspace(-1, 1, 96)
    ring = np.sqrt(1 - height**2)
    normal = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    axes = np.vstack([np.eye(3), -np.eye(3)])
    match shape:
        case Box():
            half = shape.size() / 2
            return axes, np.abs(axes) @ half, float(np.linalg.norm(half))
        case Cylinder():
            turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)
            ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
            normal = np.vstack([ring, axes[[2, 5]]])
            half_length = shape.length() / 2
            offset = np.append(np.full(96, shape.radius()), [half_length, half_length])
            return normal, offset, float(np.hypot(shape.radius(), half_length))
        case Capsule():
            half_length = shape.length() / 2
            offset = shape.radius() + half_length * np.abs(normal[:, 2])
            return normal, offset, shape.radius() + half_length
        case Ellipsoid():
            half = np.array([shape.a(), shape.b(), shape.c()])
        case Sphere():
            half = np.full(3, shape.radius())
        case _:
            raise InputError(
                f"a collision geometry of an object is a {type(shape).__name__}; valid: Mesh or "
                "Convex (taken for its hull), Box, Capsule, Cylinder, Ellipsoid, Sphere"
            )
    return normal, np.linalg.norm(normal * half, axis=1), float(half.max())


class ContactForce(NamedTuple):
    """What two geometries do to each other."""

    a: GeometryId
    b: GeometryId
    newtons: float
    row: int  # of the contact: hydroelastic ones first, then those at a point


def contact_forces(contacts: ContactResults, of: frozenset[GeometryId]) -> list[ContactForce]:
    """Returns the contacts of any of the geometries ``of``.

    All others, such as of what lies on the table, are passed over: to turn them into Python's
    objects would take most of the time.
    """
    found = []
    count = contacts.num_hydroelastic_contacts()
    for i in range(count):
        info = contacts.hydroelastic_contact_info(i)
        surface = info.contact_surface()
        a, b = surface.id_M(), surface.id_N()
        if a in of or b in of:
            newtons = math.hypot(*info.F_Ac_W().translational())
            found.append(ContactForce(a, b, newtons, i))
    for i in range(contacts.num_point_pair_contacts()):
        pair = contacts.point_pair_contact_info(i)
        a, b = pair.point_pair().id_A, pair.point_pair().id_B
        if a in of or b in of:
            found.append(ContactForce(a, b, math.hypot(*pair.contact_force()), count + i))
    return found


def _patch(contacts: ContactResults, index: int) -> tuple[Array, Array]:
    """Points (M, 3) [m] of a contact in W and their shares of its force (M,); see ``ContactForce``.

    Of a hydroelastic one they are the middles of its faces, weighted by area and pressure.
    """
    count = contacts.num_hydroelastic_contacts()
    if index >= count:
        pair = contacts.point_pair_contact_info(index - count)
        return pair.contact_point()[None], np.ones(1)
    surface = contacts.hydroelastic_contact_info(index).contact_surface()
    pressure = surface.tri_e_MN() if surface.is_triangle() else surface.poly_e_MN()
    faces = range(surface.num_faces())
    p_W = np.array([surface.centroid(face) for face in faces])
    weight = np.array(
        [surface.area(face) * pressure.EvaluateCartesian(face, p_W[face]) for face in faces]
    )
    return p_W, weight / weight.sum()
