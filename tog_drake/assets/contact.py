"""What a scanned object's shapes may touch, and how soft that must be."""

from itertools import product

import numpy as np
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    Box,
    CollisionFilterDeclaration,
    Convex,
    GeometryId,
    GeometrySet,
    ProximityProperties,
    Role,
    RoleAssign,
    SceneGraph,
    SceneGraphInspector,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from tog_drake.assets.model import CORE, SKIN
from tog_drake.panda import FINGER_BODIES

MODULUS = 1e7
"""[Pa] of what cores lie on and are held by. Measured with 29 scans at steps of 5 ms: they sink in
by 0.1-0.9 mm, one of thin legs by 1.2 mm, and lie still; at 1e6 up to 6 mm, at 5e7 some rock."""
_RESOLUTION = 0.01  # [m] of the fingers' meshes; boxes need no more


def prepare_contacts(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Readies a world for scanned objects; one without any is left as it is.

    Skins touch skins alone, and cores whatever is compliant. Two rigid cores would fall back,
    unsaid, to points between their convex hulls: where both objects have skins, these take their
    place. A core is rigid, so what it meets must not be: the fingers, rigid otherwise, become
    compliant, of as few tetrahedra as will do, and what is anchored and softer than ``MODULUS``
    becomes that firm, since a core sinks deeper into a soft table than a compliant object does.

    To be called after ``Finalize``, before the Diagram is built.
    """
    inspector = scene_graph.model_inspector()
    cores, skins, others = GeometrySet(), GeometrySet(), GeometrySet()
    has_core, to_meet_cores, of_fingers = False, [], []
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        geometries = plant.GetCollisionGeometriesForBody(body)
        names = {g: inspector.GetName(g).rpartition("::")[2] for g in geometries}
        skin = [g for g, name in names.items() if name.startswith(f"{SKIN}_")]
        for geometry, name in names.items():
            has_core = has_core or name == CORE
            if geometry in skin:
                skins.Add(geometry)
                continue
            others.Add(geometry)
            if name == CORE and skin:
                cores.Add(geometry)
            soft = plant.IsAnchored(body) and modulus_of(inspector, geometry) < MODULUS
            if soft or body.name() in FINGER_BODIES:
                to_meet_cores.append(geometry)
            if body.name() in FINGER_BODIES:
                of_fingers.append(geometry)
    if not has_core:
        return
    for geometry in of_fingers:
        _mesh_coarsely(plant, scene_graph, geometry)
    for geometry in to_meet_cores:
        _make_compliant(plant, scene_graph, geometry)
    manager = scene_graph.collision_filter_manager()
    manager.Apply(CollisionFilterDeclaration().ExcludeBetween(skins, others).ExcludeWithin(cores))


def _mesh_coarsely(plant: MultibodyPlant, scene_graph: SceneGraph, geometry: GeometryId) -> None:
    """Makes a box the hull of its corners, which is the same body of fewer tetrahedra.

    Of a hull Drake makes a star of 12 about its middle, of a box 44 about its medial axis. Pressure
    rises as steeply from each side, but every tetrahedron cuts the faces of a core that it meets,
    and each piece is a point of contact to solve for.
    """
    inspector = scene_graph.model_inspector()
    shape = inspector.GetShape(geometry)
    if not isinstance(shape, Box):
        return
    others = set(inspector.GetAllGeometryIds(Role.kProximity)) - {geometry}
    filtered = [other for other in others if inspector.CollisionFiltered(geometry, other)]
    corners = np.array(list(product((-0.5, 0.5), repeat=3))).T * shape.size()[:, None]
    hull = Convex(points=corners, label="finger")
    scene_graph.ChangeShape(plant.get_source_id(), geometry, hull)  # and forgets its filters
    scene_graph.collision_filter_manager().Apply(
        CollisionFilterDeclaration().ExcludeBetween(GeometrySet(geometry), GeometrySet(filtered))
    )


def modulus_of(inspector: SceneGraphInspector, geometry: GeometryId) -> float:
    """The hydroelastic modulus [Pa]; infinite for what is rigid or has none."""
    properties = inspector.GetProximityProperties(geometry)
    return float(
        properties.GetPropertyOrDefault("hydroelastic", "hydroelastic_modulus", float("inf"))
    )


def material_of(inspector: SceneGraphInspector, geometry: GeometryId) -> ProximityProperties:
    """What remains of a geometry's properties without those of hydroelastic contact."""
    before, after = inspector.GetProximityProperties(geometry), ProximityProperties()
    for name, value in before.GetPropertiesInGroup("material").items():
        after.AddProperty("material", name, value.get_value())
    return after


def _make_compliant(plant: MultibodyPlant, scene_graph: SceneGraph, geometry: GeometryId) -> None:
    after = material_of(scene_graph.model_inspector(), geometry)
    AddCompliantHydroelasticProperties(_RESOLUTION, MODULUS, after)
    scene_graph.AssignRole(plant.get_source_id(), geometry, after, RoleAssign.kReplace)
