"""Draws a scenario's Diagram: station and stages as boxes, connections named by their ports."""

import shutil
import subprocess

from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex

from tog_drake.errors import InputError
from tog_drake.world import World


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
    """Returns the picture in graphviz's language.

    Arrows lead from each stage to the next, as the data flows. What a stage reads besides is named
    inside its box, which keeps the chain a chain.
    """
    stages = [system.get_name() for system in world.pipeline.GetSystems()]
    titles = {system.get_name(): type(system).__name__ for system in world.pipeline.GetSystems()}
    edges = _inner_edges(world.pipeline) | _outer_edges(world)
    drawn = {*zip(["station", *stages], [*stages, "station"], strict=True), ("task", "selector")}
    besides: dict[str, set[str]] = {name: set() for name in stages}
    for (_, head), ports in edges.items():
        if (_, head) not in drawn:
            besides[head] |= ports
    station = type(world.station).__name__
    lines = [
        "digraph tog_drake {",
        "  rankdir=LR; nodesep=0.3; ranksep=0.35;",
        '  node [shape=box style="rounded,filled" fillcolor="#eef3fb" color="#33518a"'
        ' fontname="sans-serif" fontsize=13 margin="0.15,0.1"];',
        '  edge [fontname="sans-serif" fontsize=10 color="#555555" fontcolor="#333333"];',
        *(
            f'  {name} [label=<{station}> fillcolor="#fdf1dc" color="#a8761b"];'
            for name in ("station", "station_again")
        ),
        '  task [label="task" shape=plaintext style="" fontsize=12];',
        *(f"  {name} [label=<{_title(titles[name], besides[name])}>];" for name in stages),
    ]
    for tail, head in sorted(edges.keys() & drawn):
        label = "\\n".join(sorted(edges[tail, head]))
        to = "station_again" if head == "station" else head
        lines.append(f'  {tail} -> {to} [label="{label}" weight={1 if tail == "task" else 10}];')
    return "\n".join([*lines, "}"])


def _title(title: str, besides: set[str]) -> str:
    also = "".join(f"<br/>+ {port}" for port in sorted(besides))
    return title + (f'<font point-size="10" color="#555555">{also}</font>' if also else "")


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
