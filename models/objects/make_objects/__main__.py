"""Writes the SDF and the meshes of every object: ``python models/objects/make_objects [FOLDER]``.

Without FOLDER they go to their places beside this folder. The labels in ``parts.yaml`` are
written by hand and stay as they are; a test asserts that they name the pieces.
"""

import sys
from pathlib import Path

from brush import BRUSH
from hammer import HAMMER
from kit import write_thing
from mug import MUG
from screwdriver import SCREWDRIVER
from spatula import SPATULA
from spoon import SPOON
from toy_dinosaur import TOY_DINOSAUR

THINGS = (BRUSH, HAMMER, MUG, SCREWDRIVER, SPATULA, SPOON, TOY_DINOSAUR)


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent.parent
    for thing in THINGS:
        write_thing(folder, thing)


if __name__ == "__main__":
    main()
