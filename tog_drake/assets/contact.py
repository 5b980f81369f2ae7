"""Which of a scanned object's shapes may touch which."""

from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from tog_drake.assets.model import CORE, SKIN


def filter_contacts(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Lets skins touch skins alone, and cores whatever is compliant.

    Two rigid cores would fall back, unsaid, to points between their convex hulls: where both
    objects have skins, these take their place. To be called after ``Finalize``, before the Diagram
    is built; models without cores are left as they are.
    """
    inspector = scene_graph.model_inspector()
    cores, skins, others = GeometrySet(), GeometrySet(), GeometrySet()
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        geometries = plant.GetCollisionGeometriesForBody(body)
        names = {g: inspector.GetName(g).rpartition("::")[2] for g in geometries}
        skin = [g for g, name in names.items() if name.startswith(f"{SKIN}_")]
        for geometry, name in names.items():
            if geometry in skin:
                skins.Add(geometry)
            else:
                others.Add(geometry)
                if name == CORE and skin:
                    cores.Add(geometry)
    manager = scene_graph.collision_filter_manager()
    manager.Apply(CollisionFilterDeclaration().ExcludeBetween(skins, others).ExcludeWithin(cores))
