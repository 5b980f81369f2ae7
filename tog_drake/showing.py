"""What a run leaves to look at: the report, a live or a static scene."""

import time
from pathlib import Path

from pydrake.geometry import Meshcat
from rich.console import Console

from tog_drake.contact_sheet import contact_sheet
from tog_drake.decision import Decision
from tog_drake.drawing import Image, decision_image, encode_png
from tog_drake.episode import Episode
from tog_drake.files import write_atomically
from tog_drake.record import EpisodeRecord, save_record
from tog_drake.recording import Recording, save_recording
from tog_drake.report import EpisodeReport
from tog_drake.scenario import Scenario
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import View
from tog_drake.visualization import make_meshcat
from tog_drake.vlm_record import exchanges_of
from tog_drake.world import build_world, load_objects, look


def show_live(console: Console) -> Meshcat:
    """Starts Meshcat on localhost and says where."""
    meshcat = make_meshcat()
    console.print(f"live: {meshcat.web_url()}")
    return meshcat


def report_of(episode: Episode) -> EpisodeReport:
    """Returns what the report shows of an episode."""
    decision = episode.decision
    picture = None
    if decision.shown is not None and decision.candidates is not None:
        picture = decision_image(decision.shown, decision.candidates, decision.choice)
    return EpisodeReport(
        record=episode.record,
        view=decision.view,
        decision=picture,
        exchanges=exchanges_of(decision),
        exchanges_before=episode.exchanges_before,
        motion=decision.motion,
        replay=episode.replay,
        views=_views_of(decision),
    )


def save_episode(folder: Path, record: EpisodeRecord, recording: Recording | None = None) -> None:
    """Writes ``episode.json`` and, where anything moved, ``recording.npz`` for ``tog replay``."""
    save_recording(folder, None)  # that of an earlier episode does not belong to this record
    save_record(folder / "episode.json", record)
    save_recording(folder, recording)


def _views_of(decision: Decision) -> list[tuple[str, Image]]:
    """The views of several cameras, each with its camera's name and the candidates drawn in."""
    return [
        (each.camera, decision_image(each.view, decision.candidates)) for each in decision.views
    ]


def _scene(scenario: Scenario) -> Meshcat:
    meshcat = make_meshcat()
    station = SimulationStation(scenario, meshcat)
    station.ForcedPublish(station.CreateDefaultContext())
    return meshcat


def write_scene(scenario: Scenario, path: Path) -> None:
    """Writes the scene as it is at the start as a static page."""
    write_atomically(path, _scene(scenario).StaticHtml())


def first_view(scenario: Scenario) -> View:
    """Returns what the pipeline's camera sees before anything moves."""
    world = build_world(scenario, target=next(iter(load_objects(scenario)), None))
    context = look(world, scenario, "").get_context()
    pipeline = world.pipeline
    view: View = pipeline.GetOutputPort("view").Eval(pipeline.GetMyContextFromRoot(context))
    return view


def write_objects(path: Path) -> Path:
    """Draws all objects on one sheet and writes it as a PNG; returns where."""
    write_atomically(path, encode_png(contact_sheet(), compression=9))
    return path


def serve_scene(scenario: Scenario, console: Console) -> None:
    """Serves the scene on localhost until the user interrupts."""
    serve(_scene(scenario), console)


def serve(meshcat: Meshcat, console: Console) -> None:
    """Says where Meshcat is, and waits until the user interrupts."""
    console.print(f"live: {meshcat.web_url()} (Ctrl-C ends it)")
    while True:
        time.sleep(1.0)
