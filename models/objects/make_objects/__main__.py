"""Writes the SDF and the meshes of every object: ``python models/objects/make_objects [FOLDER]``.

Without FOLDER they go to their places beside this folder. The labels in ``parts.yaml`` are
written by hand and stay as they are; a test asserts that they name the pieces.
"""

import sys
from pathlib import Path

from axe import AXE
from bottle import BOTTLE
from brush import BRUSH
from cup import CUP
from hammer import HAMMER
from kit import write_thing
from knife import KNIFE
from lotion_bottle import LOTION_BOTTLE
from muddler import MUDDLER
from mug import MUG
from pan import PAN
from pot import POT
from scissors import SCISSORS
from screwdriver import SCREWDRIVER
from spatula import SPATULA
from spoon import SPOON
from toy_dinosaur import TOY_DINOSAUR
from toy_elephant import TOY_ELEPHANT
from umbrella import UMBRELLA
from whisk import WHISK

THINGS = (
    AXE,
    BOTTLE,
    BRUSH,
    CUP,
    HAMMER,
    KNIFE,
    LOTION_BOTTLE,
    MUDDLER,
    MUG,
    PAN,
    POT,
    SCISSORS,
    SCREWDRIVER,
    SPATULA,
    SPOON,
    TOY_DINOSAUR,
    TOY_ELEPHANT,
    UMBRELLA,
    WHISK,
)


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent.parent
    for thing in THINGS:
        write_thing(folder, thing)


if __name__ == "__main__":
    main()
