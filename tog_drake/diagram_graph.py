"""Draws a scenario's Diagram: station and stages as boxes, connections named by their ports."""

import shutil
import subprocess

from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex

from tog_drake.episode import World
from tog_drake.errors import InputError

_ENDS = ("station", "task")  # drawn apart from the stages


def svg(world: World) -> str:
    """Returns the picture as SVG text.

    Raises:
        InputError: if graphviz is not installed.
    """
    if shutil.which("dot") is None:
        raise InputError(
            "the program dot (graphviz) is missing; install it with: sudo apt-get install graphviz"
        )
    done = subprocess.run(
        ["dot", "-Tsvg"], input=dot(world), capture_output=True, text=True, check=True, timeout=60
    )
    return done.stdout


def dot(world: World) -> str:
    """Returns the picture in graphviz's language."""
    stages = [system.get_name() for system in world.pipeline.GetSystems()]
    edges = _inner_edges(world.pipeline) | _outer_edges(world)
    titles = {s.get_name(): type(s).__name__ for s in world.pipeline.GetSystems()}
    lines = [
        "digraph tog_drake {",
        '  rankdir=LR; nodesep=0.35; ranksep=0.7; fontname="sans-serif";',
        '  node [shape=box style="rounded,filled" fillcolor="#eef3fb" color="#33518a"'
        ' fontname="sans-serif" fontsize=13 margin="0.18,0.1"];',
        '  edge [fontname="sans-serif" fontsize=10 color="#666666" fontcolor="#333333"];',
        f'  station [label="{type(world.station).__name__}" fillcolor="#fdf1dc" color="#a8761b"];',
        '  task [label="task" shape=plaintext style="" fontsize=12];',
        *(f'  {name} [label="{titles[name]}"];' for name in stages),
    ]
    for (tail, head), labels in sorted(edges.items()):
        ports = "\\n".join(sorted(labels))
        # The way back to the station, and the measured position, must not bend the chain.
        loose = head == "station" or "panda.position_measured" in labels
        options = f'label="{ports}"' + (" constraint=false" if loose else "")
        lines.append(f"  {tail} -> {head} [{options}];")
    return "\n".join([*lines, "}"])


def _inner_edges(pipeline: Diagram) -> dict[tuple[str, str], set[str]]:
    edges: dict[tuple[str, str], set[str]] = {}
    for (head, port), (tail, _) in pipeline.connection_map().items():
        name = head.get_input_port(InputPortIndex(port)).get_name()
        edges.setdefault((tail.get_name(), head.get_name()), set()).add(name)
    return edges


def _outer_edges(world: World) -> dict[tuple[str, str], set[str]]:
    """Connections that cross the pipeline's border, drawn to the stage inside."""
    edges: dict[tuple[str, str], set[str]] = {}
    pipeline = world.pipeline
    for (head, port), (tail, source) in world.diagram.connection_map().items():
        if head is pipeline:
            name = tail.get_output_port(OutputPortIndex(source)).get_name()
            for stage, _ in pipeline.GetInputPortLocators(InputPortIndex(port)):
                edges.setdefault(("station", stage.get_name()), set()).add(name)
        else:
            stage, _ = pipeline.get_output_port_locator(OutputPortIndex(source))
            name = head.get_input_port(InputPortIndex(port)).get_name()
            edges.setdefault((stage.get_name(), "station"), set()).add(name)
    task = pipeline.GetInputPort("task").get_index()
    for stage, _ in pipeline.GetInputPortLocators(task):
        edges.setdefault(("task", stage.get_name()), set())
    return edges
