"""The labelled parts of objects: which one is held, and whether the task allows it.

Part labels are simulated ground truth. Only the judge of an episode (``judge.py``) and the oracle
use this module; nothing here reaches any other selector.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from pydrake.geometry import GeometryId, QueryObject, SceneGraph
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

        A part named in the task overrides its intent; a part to be avoided is taken away. None
        is allowed, an empty set, where the task says to leave things alone.
        """
        reading = read_task(task)
        if reading.forbidden:
            return frozenset()
        avoided = self._parts_called(reading.avoid)
        if reading.parts:
            named = self._parts_called(reading.parts)
            return (named - avoided) or None
        if reading.intent in self.tasks:
            return frozenset(self.tasks[reading.intent]) - avoided or None
        if avoided:
            return frozenset(self.part_words) - avoided
        return None

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


@dataclass(frozen=True)
class PartLabels:
    """The part that each collision geometry of the labelled objects belongs to."""

    part_of: dict[GeometryId, tuple[str, str]]  # -> (model instance, part)
    objects: dict[str, ObjectParts]  # by model instance

    @staticmethod
    def from_plant(
        plant: MultibodyPlant, scene_graph: SceneGraph, objects: dict[str, ObjectParts]
    ) -> "PartLabels":
        """Finds the labelled geometries of ``objects`` (by model instance) in a finalized plant.

        Raises:
            InputError: if an object has a collision geometry without a part.
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
        return PartLabels(part_of, objects)

    def closing_region(
        self, grasps: Grasps, query_object: QueryObject
    ) -> list[dict[tuple[str, str], float]]:
        """Returns the share of each (model instance, part) in what each grasp closes on.

        The box between the pads, a little wider than they are, is sampled; each sample counts for
        the part nearest to it, if one is near.
        """
        return [
            self._shares(_region_samples(X, p, w), query_object)
            for X, p, w in zip(grasps.X_WG, grasps.p_WContact, grasps.width, strict=True)
        ]

    def _shares(self, points: Array, query_object: QueryObject) -> dict[tuple[str, str], float]:
        nearest = []
        for point in points:
            near = [
                (found.distance, self.part_of[found.id_G])
                for found in query_object.ComputeSignedDistanceToPoint(point, _CONTACT_REACH)
                if found.id_G in self.part_of
            ]
            if near:
                nearest.append(min(near)[1])
        return {part: nearest.count(part) / len(nearest) for part in dict.fromkeys(nearest)}

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


_CONTACT_REACH = 0.02  # [m] a sample farther than this from every part counts for none


def _region_samples(X_WG: Array, p_WContact: Array, width: float) -> Array:
    """Points between the pads, (24, 3) [m]: across, along and beyond the pads' faces."""
    x, y, z = X_WG[:3, :3].T
    side = np.sign((p_WContact - X_WG[:3, 3]) @ y) or 1.0
    along = np.array([-0.7, 0.0, 0.7]) * PAD_WIDTH
    across = np.array([0.0, 1 / 3, 2 / 3, 1.0]) * -side * width
    deep = np.array([-0.4, 0.4]) * PAD_WIDTH
    grid = np.stack(np.meshgrid(along, across, deep), axis=-1).reshape(-1, 3)
    samples: Array = p_WContact + grid @ np.stack([x, y, z])
    return samples


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
