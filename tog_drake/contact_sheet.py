"""One picture of all objects that come with the package: ``tog show objects``.

Each has a tile: as it looks, its size and mass, and its labelled parts in colours. Labels are
simulated ground truth; they are shown to people here, and go to no stage.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    GeometryId,
    PerceptionProperties,
    RenderLabel,
    Rgba,
    Role,
    RoleAssign,
    SceneGraph,
    VolumeMesh,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder

from tog_drake.drawing import Image
from tog_drake.object_parts import ObjectParts, load_parts
from tog_drake.portrait import (
    FAINT_INK,
    GROUND,
    INK,
    blank,
    in_rows,
    picture,
    write_words,
)
from tog_drake.rendering import make_render_engine
from tog_drake.resources import make_package_map, resource_dir
from tog_drake.values import Array

COLUMNS = 5
TILE = (320, 336)  # [pixel] width and height
PICTURE = (TILE[0], 196)  # of the object, at the top of its tile
INSET = (150, 112)  # of its parts, at the bottom right
# The colours of parts, in the order of the labels: those of Okabe and Ito (2008), which people
# with any colour vision tell apart.
PART_COLORS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (204, 121, 167))

TONES = 0xFC  # 64 tones of each colour: no eye tells them from 256, and the file is a third smaller
APART = 2.0  # [m] between objects, so that none is in another's picture


@dataclass(frozen=True)
class Tile:
    """What the sheet shows of one object."""

    labels: ObjectParts
    size: Array  # (3,) [m] along x, y and z of the object's frame
    mass: float  # [kg]
    look: Image  # as it looks
    parts: Image  # its contact geometry, in the colours of the parts


def object_names() -> list[str]:
    """Returns the objects that come with the package, those that have labels."""
    folder = resource_dir("models") / "objects"
    return sorted(path.parent.name for path in folder.glob("*/parts.yaml"))


def contact_sheet() -> Image:
    """Draws all objects, five in a row.

    Raises:
        InputError: if this machine cannot render.
    """
    tiles = [tile_image(tile) for tile in object_tiles(object_names())]
    return np.asarray(in_rows(tiles, COLUMNS) & TONES, dtype=np.uint8)


def object_tiles(names: list[str]) -> list[Tile]:
    """Renders and measures the objects named."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.001)
    scene_graph.AddRenderer("vtk", make_render_engine(Rgba(*(c / 255 for c in GROUND))))
    folder = resource_dir("models") / "objects"
    labels = [load_parts(folder / name / "parts.yaml") for name in names]
    looks, parts = (
        [_add(plant, name, (x, i * APART)) for i, name in enumerate(names)] for x in (0.0, APART)
    )
    plant.Finalize()
    for model, label in zip(parts, labels, strict=True):
        _show_parts(plant, scene_graph, model, label)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    tiles = []
    for i, label in enumerate(labels):
        points = _points(plant, scene_graph, looks[i])
        tiles.append(
            Tile(
                labels=label,
                size=np.ptp(points, axis=0),
                mass=plant.CalcTotalMass(plant.GetMyContextFromRoot(context), [looks[i]]),
                look=picture(query, points + np.array([0.0, i * APART, 0.0]), PICTURE),
                parts=picture(query, points + np.array([APART, i * APART, 0.0]), INSET),
            )
        )
    return tiles


def _add(plant: MultibodyPlant, name: str, xy: tuple[float, float]) -> ModelInstanceIndex:
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    parser.package_map().AddMap(make_package_map())
    (model,) = parser.AddModelsFromUrl(f"package://tog_drake/objects/{name}/{name}.sdf")
    body = plant.GetBodyByName("base", model)
    plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform([*xy, 0.0]))
    return model


def _contact_geometries(plant: MultibodyPlant, model: ModelInstanceIndex) -> list[GeometryId]:
    return list(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("base", model)))


def _show_parts(
    plant: MultibodyPlant, scene_graph: SceneGraph, model: ModelInstanceIndex, labels: ObjectParts
) -> None:
    """Gives a model the look of its contact geometry, in the colours of its parts."""
    source = plant.get_source_id()
    inspector = scene_graph.model_inspector()
    for visual in plant.GetVisualGeometriesForBody(plant.GetBodyByName("base", model)):
        if inspector.GetPerceptionProperties(visual) is not None:
            scene_graph.RemoveRole(source, visual, Role.kPerception)
    color = dict(zip(labels.part_words, PART_COLORS, strict=False))
    for geometry in _contact_geometries(plant, model):
        name = inspector.GetName(geometry).split("::")[-1]
        properties = PerceptionProperties()
        rgb = (c / 255 for c in color[labels.geometries[name]])
        properties.AddProperty("phong", "diffuse", Rgba(*rgb))
        properties.AddProperty("label", "id", RenderLabel.kDontCare)
        scene_graph.AssignRole(source, geometry, properties, RoleAssign.kNew)


def _points(plant: MultibodyPlant, scene_graph: SceneGraph, model: ModelInstanceIndex) -> Array:
    """The corners (N, 3) [m] of the meshes of an object's contact geometry, in its frame."""
    inspector = scene_graph.model_inspector()
    points = []
    for geometry in _contact_geometries(plant, model):
        mesh = inspector.maybe_get_hydroelastic_mesh(geometry)
        assert isinstance(mesh, VolumeMesh)  # every object is compliant (see models/README.md)
        corners = np.array(mesh.vertices())
        points.append((inspector.GetPoseInFrame(geometry) @ corners.T).T)
    return np.vstack(points)


def tile_image(tile: Tile) -> Image:
    """Draws the tile of one object."""
    image = blank(TILE)
    image[: PICTURE[1]] = tile.look
    image[-INSET[1] - 8 : -8, -INSET[0] - 8 : -8] = tile.parts
    length, width, height = 100 * tile.size
    write_words(image, tile.labels.object.replace("_", " "), PICTURE[1] + 22, INK, 0.62)
    facts = f"{length:.1f} x {width:.1f} x {height:.1f} cm, {1000 * tile.mass:.0f} g"
    write_words(image, facts, PICTURE[1] + 42, FAINT_INK, 0.44)
    for i, (part, color) in enumerate(zip(tile.labels.part_words, PART_COLORS, strict=False)):
        y = PICTURE[1] + 62 + 17 * i
        image[y - 10 : y, 12:22] = color
        write_words(image, part, y, INK, 0.44, x=28)
    image[-1:] = image[:, -1:] = (225, 225, 222)  # a thin line between tiles
    return image
