"""The ground on which scanned objects lie, in place of the table's box."""

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticPropertiesForHalfSpace,
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    HalfSpace,
    RoleAssign,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from tog_drake.assets.contact import material_of, modulus_of, prepare_contacts
from tog_drake.assets.model import CORE


def finalize(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Finalizes a world and readies its contacts.

    Where a mesh meets a half space, Drake finds sooner than where it meets the tetrahedra of a
    table (measured: a scene of five scans at rest is simulated about 1.5 times as fast). So the
    cores of scanned objects meet the *ground*, all that is below z = 0, in place of a box whose top
    that is; all else meets the box. A scanned object that is pushed over the table's edge does not
    fall.
    """
    cores = [g for g, name in _collision_shapes(plant, scene_graph) if name == CORE]
    if not cores:
        plant.Finalize()
        return
    ground = plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction()
    )
    plant.Finalize()
    prepare_contacts(plant, scene_graph)
    rest = GeometrySet([g for g, _ in _collision_shapes(plant, scene_graph) if g not in cores])
    manager = scene_graph.collision_filter_manager()
    manager.Apply(CollisionFilterDeclaration().ExcludeBetween(GeometrySet(ground), rest))
    table = _table(plant, scene_graph)
    instead = ground if table is None else table
    manager.Apply(
        CollisionFilterDeclaration().ExcludeBetween(GeometrySet(cores), GeometrySet(instead))
    )
    if table is not None:
        _make_as_firm(plant, scene_graph, ground, table)


def _collision_shapes(
    plant: MultibodyPlant, scene_graph: SceneGraph
) -> list[tuple[GeometryId, str]]:
    """Every geometry that collides, with its name in its model."""
    inspector = scene_graph.model_inspector()
    return [
        (geometry, inspector.GetName(geometry).rpartition("::")[2])
        for i in range(plant.num_bodies())
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(BodyIndex(i)))
    ]


def _table(plant: MultibodyPlant, scene_graph: SceneGraph) -> GeometryId | None:
    """An anchored compliant box whose top is the plane z = 0; None where there is none."""
    inspector, context = scene_graph.model_inspector(), plant.CreateDefaultContext()
    for geometry, _ in _collision_shapes(plant, scene_graph):
        shape = inspector.GetShape(geometry)
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        if not (isinstance(shape, Box) and plant.IsAnchored(body)):
            continue
        X_WG = plant.EvalBodyPoseInWorld(context, body) @ inspector.GetPoseInFrame(geometry)
        top = X_WG @ [0, 0, shape.height() / 2]
        upright = X_WG.rotation().matrix()[2, 2] > 1 - 1e-9
        if upright and abs(top[2]) < 1e-6 and np.isfinite(modulus_of(inspector, geometry)):
            return geometry
    return None


def _make_as_firm(
    plant: MultibodyPlant, scene_graph: SceneGraph, ground: GeometryId, table: GeometryId
) -> None:
    """Gives the ground the material of a table and its pressure at every depth."""
    inspector = scene_graph.model_inspector()
    properties = material_of(inspector, table)
    # That of a flat box grows as far as the middle.
    AddCompliantHydroelasticPropertiesForHalfSpace(
        inspector.GetShape(table).height() / 2, modulus_of(inspector, table), properties
    )
    scene_graph.AssignRole(plant.get_source_id(), ground, properties, RoleAssign.kReplace)
