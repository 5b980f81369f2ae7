"""Draws what each strategy shows to a model: `python diagrams/strategies.py FOLDER`.

The pictures are those of the questions themselves; no model is asked.
"""

import sys
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from pydrake.systems.analysis import Simulator

from tog_drake.drawing import Image, encode_png
from tog_drake.errors import Unanswered
from tog_drake.files import write_atomically
from tog_drake.scenario import load_scenario
from tog_drake.selectors.scene import Scene
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.question import Answer, Question
from tog_drake.world import build_world

TASK = "hammer in a nail"
SCENARIO = "{random_seed: 4, pipeline: {candidates: {k: 6}}}"  # the hammer lies across the image
CAPTIONS = {
    "gsi": ("every hand in one image", '"which number?"'),
    "cpsi": ("every contact in one image", '"which number?"'),
    "gmi": ("one image for each hand: 4 of 6", '"which image?"'),
    "cpmi": ("one image for each: 4 of 6", '"which image?"'),
    "cpg": ("nothing is marked", '"point at the place to hold"'),
}
TILE, LINE, GAP = 400, 34, 12  # [pixel] a strategy's picture, a line of its caption, the space
GROUND, INK, FAINT_INK = (255, 255, 255), (25, 25, 25), (95, 95, 95)


def look() -> Scene:
    """Returns what the strategies know of a simulated hammer at the moment of the look."""
    world = build_world(load_scenario("Hammer", SCENARIO))
    simulator = Simulator(world.diagram)
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    context = world.pipeline.GetMyContextFromRoot(simulator.get_context())
    view, cloud, candidates = (
        world.pipeline.GetOutputPort(port).Eval(context) for port in ("view", "cloud", "candidates")
    )
    points = cloud.xyzs().T.astype(float)
    return Scene(view, points, candidates, TASK, rendering="marked", seed=0)


def shown(strategy: str, scene: Scene) -> list[Image]:
    """Returns the images of the first question that a strategy asks."""
    images: list[Image] = []

    def ask(question: Question) -> Answer:
        images.extend(part for part in question.parts if not isinstance(part, str))
        raise Unanswered("empty", "nobody is asked")

    with suppress(Unanswered):
        STRATEGIES[strategy](scene, ask)
    return images


def grid(images: list[Image], columns: int) -> Image:
    """Sets images of one size beside and below each other, at half their size."""
    small = [cv2.resize(i, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for i in images]
    edge = [cv2.copyMakeBorder(i, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=GROUND) for i in small]
    rows = [np.hstack(edge[i : i + columns]) for i in range(0, len(edge), columns)]
    return np.asarray(np.vstack(rows), np.uint8)


def tile(strategy: str, image: Image) -> Image:
    """Draws an image with the strategy's name above and its caption below."""
    scale = TILE / max(image.shape[:2])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    canvas = np.full((TILE + 3 * LINE, TILE + GAP, 3), GROUND, np.uint8)
    canvas[LINE : LINE + small.shape[0], : small.shape[1]] = small
    words = (strategy.upper(), *CAPTIONS[strategy])
    looks = ((0.9, INK, LINE - 10), (0.68, INK, TILE + 2 * LINE - 8), (0.62, FAINT_INK, -12))
    for text, (size, ink, y) in zip(words, looks, strict=True):
        where = (0, y % canvas.shape[0])
        cv2.putText(canvas, text, where, cv2.FONT_HERSHEY_DUPLEX, size, ink, 1, cv2.LINE_AA)
    return canvas


def pictures(shown_by: dict[str, list[Image]]) -> dict[str, Image]:
    """Returns one picture of what each strategy has shown, and one of all, ``strategies``."""
    made, tiles = {}, []
    for name, images in shown_by.items():
        marked = images[1:] or images  # the first is the one without marks
        several = len(marked) > 1
        made[name] = grid(marked, 3) if several else marked[0]
        tiles.append(tile(name, grid(marked[:4], 2) if several else marked[0]))
    return {**made, "strategies": np.hstack(tiles)}


if __name__ == "__main__":
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "diagrams/vlm")
    scene = look()
    for name, image in pictures({name: shown(name, scene) for name in CAPTIONS}).items():
        write_atomically(folder / f"{name}.png", encode_png(image, compression=9))
