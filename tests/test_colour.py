import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tog_drake.lexicon import LEXICON
from tog_drake.selectors.colour import chromaticity, fit, rivals, white_balanced

NAMES = sorted(set(LEXICON.colours.values()))


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((190, 25, 30), "red"),
        ((110, 20, 28), "red"),
        ((230, 110, 30), "orange"),
        ((235, 200, 20), "yellow"),
        ((40, 140, 50), "green"),
        ((0, 130, 130), "cyan"),
        ((30, 60, 190), "blue"),
        ((110, 40, 160), "purple"),
        ((220, 60, 150), "pink"),
        ((120, 75, 40), "brown"),
        ((20, 20, 22), "black"),
        ((240, 240, 238), "white"),
        ((125, 127, 130), "grey"),
    ],
)
def test_a_colour_is_best_fitted_by_its_name(rgb, name):
    fits = {other: fit(np.array([rgb], np.uint8), other)[0] for other in NAMES}
    assert max(fits, key=fits.get) == name
    assert fits[name] > 0.5


@given(st.tuples(*[st.integers(0, 255)] * 3), st.sampled_from(NAMES))
def test_a_fit_is_a_share(rgb, name):
    assert 0.0 <= fit(np.array([rgb], np.uint8), name)[0] <= 1.0


def test_only_neighbouring_hues_are_rivals():
    assert set(rivals("red")) == {"orange", "yellow", "pink"}
    assert rivals("white") == []
    assert all(name not in rivals(name) for name in NAMES)


def test_a_bluish_lamp_is_taken_out_but_a_coloured_scene_is_left_alone():
    paper = np.array([[160, 185, 200]], np.uint8)
    image = np.zeros((40, 40, 3), np.uint8)
    image[:10] = paper
    assert np.ptp(white_balanced(paper, image)) <= 1
    image[:10] = (250, 200, 20)
    assert white_balanced(paper, image).tolist() == paper.tolist()


@given(st.tuples(*[st.integers(60, 120)] * 3))
def test_chromaticity_does_not_change_much_with_brightness(rgb):
    once, twice = chromaticity(np.array([rgb, [2 * c for c in rgb]], np.uint8))
    assert once.sum() == pytest.approx(1.0)
    assert np.abs(once - twice).max() < 0.05
