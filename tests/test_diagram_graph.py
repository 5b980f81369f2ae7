import re
import shutil
from itertools import pairwise
from xml.etree import ElementTree

import pytest

from tog_drake.diagram_graph import dot, svg
from tog_drake.errors import InputError
from tog_drake.scenario import load_scenario
from tog_drake.world import build_world

CHAIN = [
    "station", "camera", "cloud", "proposer", "feasibility", "candidates", "view_selector",
    "selector", "trajectory", "executor", "station_again",
]  # fmt: skip
CLASSES = [
    "SimulationStation", "Camera", "SceneCloud", "GraspProposer", "FeasibilityFilter",
    "CandidatePicker", "ViewSelector", "GraspSelector", "TrajectoryOptimizer", "GraspExecutor",
]  # fmt: skip


@pytest.fixture(scope="module")
def world():
    return build_world(load_scenario("Hammer"))


def _arrows(text):
    found = re.findall(r'(\w+) -> (\w+) \[label="([^"]*)"', text)
    return {(tail, head): label.split("\\n") for tail, head, label in found}


def _boxes(text):
    """What is written in each box: its class, then what it reads besides."""
    boxes = re.findall(r"^  (\w+) \[label=<(.*)>( |\])", text, flags=re.M)
    return {name: re.split(r"\+ ?", re.sub(r"<[^>]*>", "", label)) for name, label, _ in boxes}


def test_the_arrows_follow_the_data_from_station_to_station_and_the_task_joins(world):
    arrows = _arrows(dot(world))
    assert set(arrows) == {*pairwise(CHAIN), ("task", "selector")}
    assert arrows["station", "camera"] == ["wrist.X_WC", "wrist.depth_image", "wrist.rgb_image"]
    assert arrows["feasibility", "candidates"] == ["feasible_grasps"]
    assert arrows["executor", "station_again"] == ["hand.position", "panda.position"]


def test_every_stage_is_named_by_its_class(world):
    boxes = _boxes(dot(world))
    assert [boxes[name][0] for name in CHAIN] == [*CLASSES, "SimulationStation"]


def test_every_input_of_every_stage_is_drawn_as_an_arrow_or_named_in_its_box(world):
    arrows, boxes = _arrows(dot(world)), _boxes(dot(world))
    for stage in world.pipeline.GetSystems():
        name = stage.get_name()
        drawn = [port for (_, head), ports in arrows.items() if head == name for port in ports]
        drawn += boxes[name][1:]
        drawn = sorted(filter(None, drawn))
        ports = [stage.get_input_port(i).get_name() for i in range(stage.num_input_ports())]
        assert drawn == sorted(port for port in ports if port != "task")


def test_the_oracle_is_seen_to_read_ground_truth():
    world = build_world(load_scenario("Hammer", "pipeline: {selector: !Oracle {}}"))
    box = _boxes(dot(world))["selector"]
    assert box[0] == "OracleSelector"
    assert "cheat.query_object" in box


@pytest.mark.skipif(shutil.which("dot") is None, reason="graphviz is not installed")
def test_the_picture_is_svg_that_shows_the_stages_from_left_to_right(world):
    root = ElementTree.fromstring(svg(world))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    texts = root.iter("{http://www.w3.org/2000/svg}text")
    x = {text.text: float(text.get("x")) for text in texts if text.text in CLASSES[1:]}
    assert sorted(x, key=x.get) == CLASSES[1:]


def test_without_graphviz_it_says_what_to_install(world, monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="apt-get install graphviz"):
        svg(world)
