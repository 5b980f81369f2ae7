import numpy as np
import pytest
import things

from tog_drake.errors import NoChoice
from tog_drake.selectors.targets import find_target
from tog_drake.task import read_task


def target(task, *parts):
    cloud = things.cloud(*parts)
    arrays = [cloud.xyzs().T.astype(float), cloud.normals().T.astype(float), cloud.rgbs().T]
    return find_target(read_task(task), *arrays, things.view().rgb)


def which(task, *parts):
    """The number of the part that is the target, all of it and nothing else."""
    mask = target(task, *parts).mask
    owner = np.repeat(np.arange(len(parts)), [len(p) for p, _ in parts])
    (found,) = set(owner[mask].tolist())
    assert mask.sum() > 0.95 * (owner == found).sum()
    return found


MUG, BOTTLE = things.mug((0.0, 0.0))[0], things.bottle((0.0, 0.2))[0]
HAMMER = things.turned(things.hammer()[0], 0.3, (0.0, -0.2))


def test_one_object_needs_no_name():
    assert which("grab it", (MUG, things.RED)) == 0


@pytest.mark.parametrize(("colour", "expected"), [("red", 0), ("blue", 1), ("yellow", 2)])
def test_a_colour_tells_objects_apart(colour, expected):
    parts = (MUG, things.RED), (BOTTLE, things.BLUE), (HAMMER, things.YELLOW)
    assert which(f"hand me the {colour} one", *parts) == expected


@pytest.mark.parametrize(("noun", "expected"), [("mug", 0), ("bottle", 1), ("hammer", 2)])
def test_a_noun_tells_objects_apart_by_their_shape(noun, expected):
    parts = (MUG, things.STEEL), (BOTTLE, things.STEEL), (HAMMER, things.STEEL)
    assert which(f"hand me the {noun}", *parts) == expected


def test_colour_and_noun_together_tell_what_neither_tells_alone():
    other_mug = things.mug((0.0, 0.4))[0]
    parts = (MUG, things.RED), (BOTTLE, things.RED), (other_mug, things.BLUE)
    assert which("hand me the red mug", *parts) == 0


def test_two_objects_that_the_words_do_not_tell_apart_are_no_choice():
    parts = (MUG, things.RED), (things.mug((0.0, 0.4))[0], things.RED)
    with pytest.raises(NoChoice, match="2 objects in view are red"):
        target("hand me the red mug", *parts)
    with pytest.raises(NoChoice, match="2 could be a mug"):
        target("hand me the mug", *parts)
    with pytest.raises(NoChoice, match="no shape of 'gizmo' is known"):
        target("hand me the gizmo", *parts)


def test_what_is_in_view_is_said_where_the_noun_fits_nothing():
    parts = (MUG, things.STEEL), (HAMMER, things.STEEL)
    with pytest.raises(NoChoice, match=r"none has the shape of a umbrella. .*hammer"):
        target("hand me the umbrella", *parts)


def test_tools_are_told_apart_by_their_size():
    driver = things.turned(things.screwdriver()[0], 1.0, (0.0, 0.3))
    parts = (HAMMER, things.STEEL), (driver, things.STEEL)
    assert which("hand me the hammer", *parts) == 0
    assert which("hand me the screwdriver", *parts) == 1


def test_a_colour_that_is_not_there_is_no_choice_that_says_what_is():
    with pytest.raises(NoChoice, match="Nothing in view is green; what is there is red"):
        target("hand me the green mug", (MUG, things.RED))


def test_an_empty_table_is_no_choice():
    speck = things.box((0.3, 0.0, 0.004), (0.306, 0.006, 0.015))
    with pytest.raises(NoChoice, match="large enough"):
        target("grab it", (speck, things.RED))
