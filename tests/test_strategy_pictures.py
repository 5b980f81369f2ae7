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
def shown(program):
    """The images of each strategy, by its name."""
    scene = program["look"]()
    return {name: program["shown"](name, scene) for name in program["CAPTIONS"]}


def colors_in(image):
    """The names of the six candidates' colours that an image holds enough of for a mark."""
    pixels = image.astype(np.int32) @ [1 << 16, 1 << 8, 1]
    return {
        name
        for name, rgb in CANDIDATE_COLORS[:6]
        if np.count_nonzero(pixels == np.dot(rgb, [1 << 16, 1 << 8, 1])) > 150
    }


def test_every_strategy_has_a_small_picture():
    assert sorted(path.stem for path in (FOLDER / "vlm").glob("*.png")) == sorted(NAMES)
    for name in NAMES:
        path = FOLDER / "vlm" / f"{name}.png"
        assert path.stat().st_size < 250_000
        assert min(cv2.imread(str(path)).shape[:2]) >= 450


def test_all_hands_or_contacts_are_in_one_image_or_each_in_its_own(shown):
    bare = colors_in(shown["cpg"][0])
    for together, separate in (("gsi", "gmi"), ("cpsi", "cpmi")):
        reference, marked = shown[together]
        assert reference.shape == marked.shape
        assert not np.array_equal(reference, marked)
        colors = colors_in(marked) - bare
        assert len(colors) == 6
        first, *single = shown[separate]
        assert np.array_equal(first, reference)
        assert [len(colors_in(image) - bare) for image in single] == 6 * [1]
        assert set().union(*(colors_in(image) - bare for image in single)) == colors


def test_the_pictures_are_those_that_the_program_makes_now(program, shown):
    made = program["pictures"](shown)
    assert list(made) == NAMES
    for name, image in made.items():
        committed = cv2.imread(str(FOLDER / "vlm" / f"{name}.png"))[..., ::-1]
        assert committed.shape == image.shape, name
        # Renderers and fonts differ by a shade; a disc elsewhere changes 3 in 1000 pixels.
        changed = np.abs(committed.astype(int) - image).max(axis=2) > 40
        assert changed.mean() < 1e-3, name
