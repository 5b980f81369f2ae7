"""The labelled parts of objects: which one is held, and whether the task allows it.

Part labels are simulated ground truth. They are for judging, evaluating and showing; no stage of
the pipeline but the oracle (``selectors/oracle.py``) reads them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    GeometryId,
    QueryObject,
    SceneGraph,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.plant import ContactResults, MultibodyPlant

from tog_drake.errors import InputError
from tog_drake.grammar import lemma
from tog_drake.lexicon import LEXICON
from tog_drake.panda import PAD_WIDTH
from tog_drake.task import read_task
from tog_drake.values import Array, Grasps


@dataclass(frozen=True)
class ObjectParts:
    """What an object is and what its parts are for: the content of a ``parts.yaml``."""

    object: str
    words: tuple[str, ...]  # what a person may call it
    geometries: dict[str, str]  # collision geometry -> part
    part_words: dict[str, tuple[str, ...]]  # part -> what a person may call it
    tasks: dict[str, tuple[str, ...]]  # intent -> parts that may be held

    def allowed(self, task: str) -> frozenset[str] | None:
        """Returns the parts that the task allows to hold; None where its words do not say.

        A part named in the task overrides its intent; a part to be avoided is taken away, and
        where nothing else is asked for the others remain. None is allowed, an empty set, where
        the task says to leave things alone.
        """
        reading = read_task(task)
        if reading.forbidden:
            return frozenset()
        avoided = self._parts_called(reading.avoid)
        asked = frozenset(self.tasks.get(reading.intent or "", ()))
        if reading.parts:
            asked = self._parts_called(reading.parts)
        if asked - avoided:
            return asked - avoided
        return frozenset(self.part_words) - avoided if avoided else None

    def _parts_called(self, words: tuple[str, ...]) -> frozenset[str]:
        # A task's words for parts come in the spelling of the lexicon, labels as people say them.
        return frozenset(
            part
            for part, called in self.part_words.items()
            if {LEXICON.parts.get(lemma(word), word) for word in (part, *called)} & set(words)
        )


def load_parts(path: Path) -> ObjectParts:
    """Reads a ``parts.yaml`` (its form is described in ``models/README.md``).

    Raises:
        InputError: if the file is missing or not of that form.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        parts = content["parts"]
        return ObjectParts(
            object=str(content["object"]),
            words=tuple(map(str, content["words"])),
            geometries={str(g): part for part, p in parts.items() for g in p["geometries"]},
            part_words={part: tuple(map(str, p["words"])) for part, p in parts.items()},
            tasks={intent: tuple(allowed) for intent, allowed in content["tasks"].items()},
        )
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"cannot read part labels from {path}: {error}; a labelled object has a parts.yaml "
            "beside its SDF with the keys object, words, parts and tasks"
        ) from error


Planes = tuple[Array, Array, float]
"""Outward normals (F, 3), offsets (F,) [m] and the distance of the farthest corner from the origin
[m], in the frame of the geometry."""


@dataclass(frozen=True)
class PartLabels:
    """The part that each collision geometry of the objects belongs to.

    An object without labels counts as one part, for what the hand meets of it.
    """

    part_of: dict[GeometryId, tuple[str, str]]  # -> (model instance, part)
    objects: dict[str, ObjectParts]  # by model instance
    planes: dict[GeometryId, Planes]  # that bound each of those geometries

    @staticmethod
    def from_plant(
        plant: MultibodyPlant, scene_graph: SceneGraph, objects: dict[str, ObjectParts]
    ) -> "PartLabels":
        """Finds the geometries of all objects in a finalized plant.

        Args:
            plant: whose free bodies are the objects.
            scene_graph: where it has its geometries.
            objects: the labels of those that have any, by model instance.

        Raises:
            InputError: if a labelled object has a collision geometry without a part.
        """
        inspector = scene_graph.model_inspector()
        part_of = {}
        for model, labels in objects.items():
            for body in plant.GetBodyIndices(plant.GetModelInstanceByName(model)):
                for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(body)):
                    name = inspector.GetName(geometry).split("::")[-1]
                    if name not in labels.geometries:
                        raise InputError(
                            f"collision geometry {name} of {model} has no part in its parts.yaml; "
                            f"labelled are {', '.join(labels.geometries)}"
                        )
                    part_of[geometry] = (model, labels.geometries[name])
        for index in plant.GetFloatingBaseBodies():
            body = plant.get_body(index)
            model = plant.GetModelInstanceName(body.model_instance())
            for geometry in plant.GetCollisionGeometriesForBody(body):
                part_of.setdefault(geometry, (model, _UNLABELLED))
        return PartLabels(part_of, objects, {g: _planes(inspector, g) for g in part_of})

    def closing_region(
        self, grasps: Grasps, query_object: QueryObject
    ) -> list[dict[tuple[str, str], float]]:
        """Returns the share of each (model instance, part) in what each grasp closes on.

        The box between the pads, a little wider than they are, is sampled; each sample counts for
        the part nearest to it, if one is near.
        """
        if len(grasps) == 0:
            return []
        samples = _region_samples(grasps)
        parts, nearest = self.nearest_part(samples.reshape(-1, 3), query_object, _CONTACT_REACH)
        regions = []
        for row in nearest.reshape(samples.shape[:2]):
            found, counts = np.unique(row[row >= 0], return_counts=True)
            shares = counts / counts.sum()
            regions.append({parts[i]: float(s) for i, s in zip(found, shares, strict=True)})
        return regions

    def nearest_part(
        self, p_W: Array, query_object: QueryObject, reach: float
    ) -> tuple[list[tuple[str, str]], NDArray[np.int64]]:
        """Finds the labelled part nearest to each of the points p_W (P, 3).

        Distances are to the planes of each convex shape: exact inside and before its faces, too
        short beside its edges.

        Returns:
            All (model instance, part), and of each point which of them it is (P,); -1 where none
            is within ``reach`` [m].
        """
        parts = list(dict.fromkeys(self.part_of.values()))
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
        return parts, nearest

    def held(
        self, forces: list[tuple[GeometryId, GeometryId, float]], pads: frozenset[GeometryId]
    ) -> dict[tuple[str, str], float]:
        """Returns the force [N] of the finger pads on each (model instance, part).

        Args:
            forces: of all contacts, from ``contact_forces``.
            pads: the geometries of the fingers.
        """
        force: dict[tuple[str, str], float] = {}
        for a, b, newtons in forces:
            other = b if a in pads else a if b in pads else None
            if other is not None and other in self.part_of:
                part = self.part_of[other]
                force[part] = force.get(part, 0.0) + newtons
        return force


_UNLABELLED = "unlabelled"  # the one part of an object that has no parts.yaml
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


def contact_forces(contacts: ContactResults) -> list[tuple[GeometryId, GeometryId, float]]:
    """Returns each contact's two geometries and the size of its force [N]."""
    found = []
    for i in range(contacts.num_hydroelastic_contacts()):
        info = contacts.hydroelastic_contact_info(i)
        surface, force = info.contact_surface(), info.F_Ac_W().translational()
        found.append((surface.id_M(), surface.id_N(), float(np.linalg.norm(force))))
    for i in range(contacts.num_point_pair_contacts()):
        pair = contacts.point_pair_contact_info(i)
        force = pair.contact_force()
        found.append((pair.point_pair().id_A, pair.point_pair().id_B, float(np.linalg.norm(force))))
    return found
