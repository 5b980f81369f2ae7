"""Shows a recorded episode inside a notebook's cell, without a server.

Which Meshcat is which: Drake's own (C++, ``pydrake.geometry.Meshcat``) shows live scenes and the
replays of reports and ``tog replay``; the PyPI package ``meshcat`` shows the replay in a cell. It
is half the size there (of one object 1.3 MB, not 2.8; of five scans 5 MB, not 11), opens no port,
and the cell still plays when the kernel has ended. A scan's picture is shown at its vertices alone.
"""

import base64
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    Rgba,
    Role,
    SceneGraphInspector,
    Shape,
    Sphere,
)

from tog_drake.errors import InputError
from tog_drake.recording import Recording, load_recording
from tog_drake.replay import FRAME_RATE, Stage, set_stage
from tog_drake.values import Array
from tog_drake.visualization import EYE, TARGET, notebook_cell

if TYPE_CHECKING:
    from IPython.display import HTML

_GREY = Rgba(0.7, 0.7, 0.7, 1.0)
_PAGE = """<!DOCTYPE html>
<html><head><meta charset="utf-8"><title>Replay</title>
<style>body {{ margin: 0 }} #meshcat-pane {{ width: 100vw; height: 100vh; overflow: hidden }}
</style></head><body><div id="meshcat-pane"></div>
<script>{viewer}</script>
<script>
var viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
for (const command of {commands})
  viewer.handle_command_bytearray(Uint8Array.from(atob(command), c => c.charCodeAt(0)));
</script></body></html>
"""


def inline_replay(folder: Path, *, height: int = 400) -> "HTML":
    """Returns what plays an episode as the last value of a notebook's cell.

    Args:
        folder: of the episode, as given to ``tog run --out``.
        height: [pixel] of the cell.

    Raises:
        InputError: as ``load_recording`` and ``set_stage``, or PyPI's meshcat is not installed.
    """
    return notebook_cell("srcdoc", inline_page(load_recording(folder)), height)


def inline_page(recording: Recording) -> str:
    """Returns the page in that cell: 0.9 MB plus the scene and its motion.

    Raises:
        InputError: as ``set_stage``, or PyPI's meshcat is not installed.
    """
    try:
        from meshcat import Visualizer
        from meshcat.servers.zmqserver import VIEWER_ROOT
    except ImportError as error:
        raise InputError(
            f"a replay in a notebook needs PyPI's meshcat ({error}); install it with: "
            "pip install 'tog_drake[notebooks]'"
        ) from error
    commands = _Commands()
    _draw(Visualizer(window=commands), set_stage(recording))
    viewer = (Path(VIEWER_ROOT) / "main.min.js").read_text(encoding="utf-8")
    return _PAGE.format(viewer=viewer.replace("</script", "<\\/script"), commands=commands.packed)


class _Commands:
    """Stands where the package has its server: keeps what would be sent to it."""

    def __init__(self) -> None:
        self.packed: list[str] = []  # MessagePack as base64, in order

    def send(self, command: Any) -> None:
        import umsgpack

        self.packed.append(base64.b64encode(umsgpack.packb(command.lower())).decode())


def _draw(meshcat: Any, stage: Stage) -> None:
    """Draws the world, and animates the bodies that move."""
    from meshcat.animation import Animation
    from meshcat.transformations import translation_matrix

    offset = np.subtract(EYE, TARGET)
    meshcat["/Cameras/default"].set_transform(translation_matrix(TARGET))
    meshcat["/Cameras/default/rotated/<object>"].set_property(  # there y is up
        "position", [offset[0], offset[2], -offset[1]]
    )
    for name in ("/Grid", "/Axes"):
        meshcat[name].set_property("visible", False)
    bodies = _draw_shapes(meshcat, stage)
    poses = np.stack(
        [
            [
                X.GetAsMatrix4()
                for X in stage.station.GetOutputPort("cheat.body_poses").Eval(context)
            ]
            for context in stage.frames()
        ]
    )
    animation = Animation(default_framerate=FRAME_RATE)
    for body in bodies:
        meshcat[str(body)].set_transform(poses[0, body])
        if np.ptp(poses[:, body], axis=0).max() > 1e-6:
            for number, X_WB in enumerate(poses[:, body]):
                with animation.at_frame(meshcat[str(body)], number) as frame:
                    frame.set_transform(X_WB)
    meshcat.set_animation(animation, repetitions=20)


def _draw_shapes(meshcat: Any, stage: Stage) -> list[int]:
    """Draws what is to be seen of each body, and returns the indices of these bodies."""
    from meshcat.geometry import MeshLambertMaterial

    plant, inspector = stage.station.plant, stage.station.scene_graph.model_inspector()
    bodies = set()
    for number, geometry in enumerate(inspector.GetAllGeometryIds(Role.kIllustration)):
        body = int(plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).index())
        shape, X_local, colors = _shape(inspector.GetShape(geometry))
        rgba = _color(inspector, geometry)
        color = int.from_bytes(bytes(round(255 * c) for c in (rgba.r(), rgba.g(), rgba.b())), "big")
        material = MeshLambertMaterial(
            color=0xFFFFFF if colors else color, vertexColors=colors, opacity=rgba.a()
        )
        path = meshcat[f"{body}/{number}"]
        path.set_object(shape, material)
        path.set_transform(inspector.GetPoseInFrame(geometry).GetAsMatrix4() @ X_local)
        bodies.add(body)
    return sorted(bodies)


def _color(inspector: SceneGraphInspector, geometry: GeometryId) -> Rgba:
    properties = inspector.GetIllustrationProperties(geometry)
    color: Rgba = properties.GetPropertyOrDefault("phong", "diffuse", _GREY)
    return color


def _shape(shape: Shape) -> tuple[Any, Array, bool]:
    """Returns a shape in the package's terms, its pose, and whether it has colours of its own."""
    from meshcat import geometry

    if isinstance(shape, Box):
        return geometry.Box(shape.size()), np.eye(4), False
    if isinstance(shape, Sphere):
        return geometry.Sphere(shape.radius()), np.eye(4), False
    if isinstance(shape, Ellipsoid):
        return geometry.Ellipsoid([shape.a(), shape.b(), shape.c()]), np.eye(4), False
    if isinstance(shape, Cylinder):  # there along y
        upright = np.eye(4)[:, [0, 2, 1, 3]] * [1, 1, -1, 1]
        return geometry.Cylinder(shape.length(), shape.radius()), upright, False
    return _mesh(shape)


def _mesh(shape: Shape) -> tuple[Any, Array, bool]:
    import trimesh
    from meshcat.geometry import TriangularMeshGeometry

    if isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(shape.length(), shape.radius(), count=[20, 20])
        mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    elif isinstance(shape, Mesh | Convex):
        path = Path(shape.source().path())
        mesh = trimesh.load(path, force="mesh", process=False)
        if path.suffix.lower() in (".gltf", ".glb"):  # there y is up
            mesh.apply_transform([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
        mesh.apply_transform(np.diag([*np.broadcast_to(shape.scale3(), 3), 1.0]))
    else:
        raise InputError(f"a {type(shape).__name__} cannot be shown in a notebook")
    colors = None
    if mesh.visual.kind == "texture" and _has_texture(mesh):
        colors = mesh.visual.to_color().vertex_colors[:, :3] / 255.0
    return TriangularMeshGeometry(mesh.vertices, mesh.faces, colors), np.eye(4), colors is not None


def _has_texture(mesh: Any) -> bool:
    """Whether a mesh of trimesh has a picture on it, and not one colour."""
    material = mesh.visual.material
    return getattr(material, "baseColorTexture", getattr(material, "image", None)) is not None
