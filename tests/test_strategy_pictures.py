"""The pictures of `diagrams/vlm`, which show what a model is shown."""

import runpy

import cv2
import numpy as np
import pytest

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.resources import resource_dir

FOLDER = resource_dir("diagrams")
NAMES = ["gsi", "cpsi", "gmi", "cpmi", "cpg", "strategies"]


@pytest.fixture(scope="module")
def program():
    return runpy.run_path(str(FOLDER / "strategies.py"))


@pytest.fixture(scope="module")
def scene(program):
    return program["look"]()


def colors_in(image):
    """The names of the six candidates' colours that an image holds enough of for a mark."""
    colors = CANDIDATE_COLORS[:6]
    return {name for name, rgb in colors if (image == rgb).all(axis=2).sum() > 150}


def test_every_strategy_has_a_small_picture():
    assert sorted(path.stem for path in (FOLDER / "vlm").glob("*.png")) == sorted(NAMES)
    for name in NAMES:
        path = FOLDER / "vlm" / f"{name}.png"
        assert path.stat().st_size < 250_000
        assert min(cv2.imread(str(path)).shape[:2]) >= 450


def test_all_hands_or_contacts_are_in_one_image_or_each_in_its_own(program, scene):
    bare = colors_in(program["shown"]("cpg", scene)[0])
    for together, separate in (("gsi", "gmi"), ("cpsi", "cpmi")):
        reference, marked = program["shown"](together, scene)
        assert reference.shape == marked.shape
        assert not np.array_equal(reference, marked)
        colors = colors_in(marked) - bare
        assert len(colors) == 6
        first, *single = program["shown"](separate, scene)
        assert np.array_equal(first, reference)
        assert [len(colors_in(image) - bare) for image in single] == 6 * [1]
        assert set().union(*(colors_in(image) - bare for image in single)) == colors


def test_the_pictures_can_be_made_again(program, scene):
    made = program["pictures"](scene)
    assert list(made) == NAMES
    committed = cv2.imread(str(FOLDER / "vlm" / "strategies.png"))
    assert made["strategies"].shape == committed.shape
    for image in made.values():
        assert image.dtype == np.uint8 and image.std() > 10
