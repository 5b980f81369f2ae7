"""The part labels of an imported object, to be looked at: its surface in the colours of its parts.

Labels are simulated ground truth; they are shown to people here, and go to no stage.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryInstance,
    InMemoryMesh,
    MakePhongIllustrationProperties,
    Mesh,
    Meshcat,
    MeshcatVisualizer,
    PerceptionProperties,
    RenderLabel,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder
from rich.console import Console

from tog_drake.assets.library import asset_dir
from tog_drake.assets.mesh import Faces
from tog_drake.assets.model import CORE_FILE, MODEL
from tog_drake.assets.surface import face_areas, read_core
from tog_drake.contact_sheet import PART_COLORS, TONES
from tog_drake.drawing import Image
from tog_drake.errors import InputError
from tog_drake.labelled_surface import UNLABELLED
from tog_drake.object_parts import labels_file, load_parts
from tog_drake.portrait import AZIMUTH, GROUND, INK, blank, in_rows, picture, write_words
from tog_drake.regions import region_of
from tog_drake.rendering import make_render_engine
from tog_drake.values import Array
from tog_drake.visualization import make_meshcat

_EDGE = 0.004  # [m] edges are no longer, so that parts end where their regions do
_NONE = (120, 120, 120)  # the colour of what has no label
VIEW = (320, 240)  # [pixel] there are two, side by side
LINE = 17  # [pixel]
COLUMNS = 3


@dataclass(frozen=True)
class LabelledFaces:
    """The surface of an object, cut into small triangles, and the part that each belongs to."""

    name: str
    vertices: Array  # (V, 3) [m]
    faces: Faces  # (F, 3)
    parts: tuple[str, ...]  # as labelled; the last is what has no label
    part: NDArray[np.int64]  # (F,) row of ``parts``

    def areas(self) -> dict[str, float]:
        """Returns the area of each part [m²]."""
        area = face_areas(self.vertices, self.faces)
        return {part: float(area[self.part == i].sum()) for i, part in enumerate(self.parts)}


def labelled_faces(name: str) -> LabelledFaces:
    """Labels the faces of an imported object by their middles.

    Raises:
        InputError: there is no such object, or no labels for it.
    """
    import trimesh

    folder = asset_dir(name)
    path = labels_file(folder / MODEL)
    if path is None:
        raise InputError(
            f"{name} has no part labels yet; write them into {folder / 'parts.yaml'} (its form is "
            "described in models/README.md)"
        )
    labels = load_parts(path)
    vertices, faces = trimesh.remesh.subdivide_to_size(
        *read_core(folder / CORE_FILE), max_edge=_EDGE, max_iter=30
    )
    parts = [*labels.part_words, UNLABELLED]
    # The last row is that of region -1.
    row = np.array([*(parts.index(region.part) for region in labels.regions), len(parts) - 1])
    part = row[region_of(labels.regions, vertices[faces].mean(axis=1))]
    return LabelledFaces(name, vertices, faces, tuple(parts), part)


def label_sheet(names: list[str]) -> Image:
    """Draws the labels of objects from two sides, with the area of each part.

    Raises:
        InputError: as ``labelled_faces``, or this machine cannot render.
    """
    tiles = [_tile(labelled_faces(name)) for name in names]
    height = max(len(tile) for tile in tiles)
    even = [np.pad(t, ((0, height - len(t)), (0, 0), (0, 0)), mode="edge") for t in tiles]
    return np.asarray(in_rows(even, min(COLUMNS, len(even))) & TONES, dtype=np.uint8)


def serve_labels(name: str, console: Console) -> None:
    """Serves the labels of an object on localhost until the user interrupts."""
    meshcat = labels_in_meshcat(labelled_faces(name))
    console.print(f"live: {meshcat.web_url()} (Ctrl-C ends it)")
    while True:
        time.sleep(1.0)


def labels_in_meshcat(labelled: LabelledFaces) -> Meshcat:
    """Shows the labels of an object in Meshcat."""
    meshcat, builder = make_meshcat(), DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    _add_parts(scene_graph, labelled)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    diagram = builder.Build()
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    lower, upper = labelled.vertices.min(axis=0), labelled.vertices.max(axis=0)
    middle = (lower + upper) / 2
    reach = 2.0 * float(np.linalg.norm(upper - lower))
    meshcat.SetCameraPose(middle + reach * np.array([0.45, -0.75, 0.5]), middle)
    return meshcat


def _tile(labelled: LabelledFaces) -> Image:
    scene_graph = SceneGraph()
    scene_graph.AddRenderer("vtk", make_render_engine(Rgba(*(c / 255 for c in GROUND))))
    _add_parts(scene_graph, labelled)
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    corners = labelled.vertices[:: max(1, len(labelled.vertices) // 20_000)]
    views = [picture(query, corners, VIEW, azimuth) for azimuth in (AZIMUTH, AZIMUTH + np.pi)]
    areas = labelled.areas()
    words = blank((2 * VIEW[0], LINE * (len(areas) + 2)))
    write_words(words, labelled.name, LINE, INK, 0.5)
    for i, (part, area) in enumerate(areas.items(), 2):
        words[LINE * i - 10 : LINE * i, 12:22] = _color(labelled, i - 2)
        share = area / sum(areas.values())
        write_words(words, f"{part}: {1e4 * area:.0f} cm2, {share:.0%}", LINE * i, INK, 0.44, x=28)
    return np.vstack([np.hstack(views), words])


def _color(labelled: LabelledFaces, row: int) -> tuple[int, int, int]:
    return _NONE if row == len(labelled.parts) - 1 else PART_COLORS[row % len(PART_COLORS)]


def _add_parts(scene_graph: SceneGraph, labelled: LabelledFaces) -> None:
    source = scene_graph.RegisterSource("labels")
    for row, part in enumerate(labelled.parts):
        faces = labelled.faces[labelled.part == row]
        if not len(faces):
            continue
        rgba = Rgba(*(c / 255 for c in _color(labelled, row)))
        file = MemoryFile(_obj(labelled.vertices, faces), ".obj", part)
        mesh = Mesh(InMemoryMesh(mesh_file=file))
        instance = GeometryInstance(RigidTransform(), mesh, part)
        instance.set_illustration_properties(MakePhongIllustrationProperties(rgba.rgba))
        seen = PerceptionProperties()
        seen.AddProperty("phong", "diffuse", rgba)
        seen.AddProperty("label", "id", RenderLabel.kDontCare)
        instance.set_perception_properties(seen)
        scene_graph.RegisterAnchoredGeometry(source, instance)


def _obj(vertices: Array, faces: Faces) -> bytes:
    """An OBJ with a normal for each face, which Drake's renderer asks for."""
    used, row = np.unique(faces, return_inverse=True)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in vertices[used]]
    lines += ["vn {:.4f} {:.4f} {:.4f}".format(*n) for n in normal]
    corners = enumerate(row.reshape(-1, 3) + 1, 1)
    lines += [f"f {p}//{n} {q}//{n} {r}//{n}" for n, (p, q, r) in corners]
    return ("\n".join(lines) + "\n").encode()
