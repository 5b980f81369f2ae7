"""What an imported object looks like: a picture from two sides, and a sheet of such pictures."""

from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from tog_drake.assets.library import PREVIEW, asset_dir, read_report
from tog_drake.assets.model import MODEL
from tog_drake.assets.reporting import line_of
from tog_drake.drawing import Image, encode_png
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.portrait import (
    AZIMUTH,
    FAINT_INK,
    GROUND,
    INK,
    blank,
    in_rows,
    picture,
    write_words,
)
from tog_drake.rendering import make_render_engine
from tog_drake.values import Array

VIEW = (400, 300)  # [pixel] width and height; there are two, side by side
COLUMNS = 4  # of a sheet
TILE = (400, 198)  # [pixel]


def write_preview(folder: Path, vertices: Array) -> None:
    """Renders the model in ``folder`` from two opposite sides, and writes ``preview.png``.

    Args:
        folder: of an imported object.
        vertices: (V, 3) [m] of its surface, in its frame.

    Raises:
        InputError: this machine cannot render.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.001)
    scene_graph.AddRenderer("vtk", make_render_engine(Rgba(*(c / 255 for c in GROUND))))
    (model,) = Parser(plant).AddModels(str(folder / MODEL))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", model), RigidTransform())
    plant.Finalize()
    diagram = builder.Build()
    context = scene_graph.GetMyContextFromRoot(diagram.CreateDefaultContext())
    query = scene_graph.get_query_output_port().Eval(context)
    corners = vertices[:: max(1, len(vertices) // 20_000)]
    views = [picture(query, corners, VIEW, azimuth) for azimuth in (AZIMUTH, AZIMUTH + np.pi)]
    write_atomically(folder / PREVIEW, encode_png(np.hstack(views)))


def sheet(names: list[str]) -> Image:
    """Returns the previews of imported objects on one sheet, with their names.

    Raises:
        InputError: there is none.
    """
    if not names:
        raise InputError("no object is imported yet; `tog assets import` brings one in")
    return in_rows([_tile(name) for name in names], COLUMNS)


def _tile(name: str) -> Image:
    import cv2

    image = blank(TILE)
    preview: Any = cv2.imread(str(asset_dir(name) / PREVIEW))
    if preview is not None:
        small = cv2.resize(preview, (TILE[0], 150), interpolation=cv2.INTER_AREA)
        image[:150] = small[..., ::-1]
    write_words(image, name, 168, INK, 0.42)
    write_words(image, line_of(read_report(name)), 186, FAINT_INK, 0.4)
    image[-1:] = image[:, -1:] = (225, 225, 222)  # a thin line between tiles
    return image
