import pytest
import things

from tog_drake.lexicon import LEXICON
from tog_drake.selectors.likeness import kind_likeness, likeness, most_like

MADE = {"tool": things.hammer()[0], "vessel": things.mug()[0], "bottle": things.bottle()[0]}


@pytest.mark.parametrize("kind", MADE)
def test_each_kind_is_most_like_itself(kind):
    like = {name: kind_likeness(points, kind) for name, points in MADE.items()}
    assert max(like, key=like.get) == kind
    assert sorted(like.values())[-2] < like[kind]


@pytest.mark.parametrize("noun", ["hammer", "mug", "bottle"])
def test_a_thing_is_most_like_its_noun(noun):
    points = dict(zip(["hammer", "mug", "bottle"], MADE.values(), strict=True))
    like = {name: likeness(p, LEXICON.rules[noun]) for name, p in points.items()}
    assert max(like, key=like.get) == noun
    assert sorted(like.values())[-2] < 0.2 * like[noun]


def test_size_tells_a_spoon_from_a_hammer():
    points = things.hammer()[0]
    assert likeness(points, LEXICON.rules["hammer"]) > 0.5
    assert likeness(points, LEXICON.rules["spoon"]) < 0.1
    assert most_like(points) in {"hammer", "mallet", "gavel", "sledgehammer"}
    assert likeness(0.4 * points, LEXICON.rules["hammer"]) < 0.01


def test_a_noun_without_a_size_goes_by_its_kind():
    assert likeness(things.hammer()[0], LEXICON.rules["wrench"]) == 0.5
    assert likeness(things.mug()[0], LEXICON.rules["wrench"]) == 0.0
