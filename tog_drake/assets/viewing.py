"""An imported object in Meshcat."""

import time
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from rich.console import Console

from tog_drake.assets.library import PREVIEW, read_report
from tog_drake.assets.model import MODEL
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.visualization import make_meshcat


def write_page(folder: Path, path: Path) -> None:
    """Writes the object in ``folder`` as a static page."""
    write_atomically(path, _shown(folder).StaticHtml())


def copy_picture(folder: Path, path: Path) -> None:
    """Writes the picture that the import drew of the object in ``folder``.

    Raises:
        InputError: there is none, because the machine that imported it could not render.
    """
    picture = folder / PREVIEW
    if not picture.is_file():
        raise InputError(
            f"{folder.name} has no picture ({picture}); import it again, or --out a page (.html)"
        )
    write_atomically(path, picture.read_bytes())


def serve_asset(folder: Path, console: Console) -> None:
    """Serves the object in ``folder`` on localhost until the user interrupts."""
    meshcat = _shown(folder)
    console.print(f"live: {meshcat.web_url()} (Ctrl-C ends it)")
    while True:
        time.sleep(1.0)


def _shown(folder: Path) -> Meshcat:
    meshcat = make_meshcat()
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.001)
    (model,) = Parser(plant).AddModels(str(folder / MODEL))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", model), RigidTransform())
    plant.Finalize()
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    diagram = builder.Build()
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    lower, upper = np.array(read_report(folder.name).get("bounds", [[-0.1] * 3, [0.1] * 3]))
    middle, reach = (lower + upper) / 2, 1.1 * float(np.linalg.norm(upper - lower))
    direction = np.array([0.45, -0.75, 0.5])
    meshcat.SetCameraPose(middle + reach * direction, middle)
    return meshcat
