import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.selectors.discs import RADIUS, place_discs

NO_LINES, NO_THINGS = np.zeros((0, 2, 2)), np.zeros((0, 2))


def place(size, anchors, *, lines=NO_LINES, stems=None, things=NO_THINGS):
    return place_discs(size, anchors, lines=lines, stems=stems, things=things, thickness=6.0)


def gap(centers, lines):
    """The least distance of the centres (N, 2) from lines (M, 2, 2)."""
    along = np.linspace(0, 1, 200)[:, None, None]
    points = (lines[:, 0] + along * (lines[:, 1] - lines[:, 0])).reshape(-1, 2)
    return np.linalg.norm(centers[:, None] - points, axis=2).min()


@settings(max_examples=8)
@given(
    st.sampled_from([(672, 672), (896, 672), (672, 1120)]),
    st.integers(1, 12),
    st.integers(0, 2**32 - 1),
)
def test_discs_never_overlap_and_never_leave_the_picture(size, n, seed):
    rng = np.random.default_rng(seed)
    anchors = rng.uniform([-200, -200], np.array(size) + 200, (n, 5, 2))
    anchors[rng.random((n, 5)) < 0.2] = np.nan
    lines = rng.uniform(0, size[0], (3 * n, 2, 2))  # far longer than those of hands
    centers, named = place(size, anchors, lines=lines, stems=anchors[:, :2])
    assert (centers >= RADIUS).all() and (centers <= np.array(size) - 1 - RADIUS).all()
    apart = np.linalg.norm(centers[:, None] - centers, axis=2) + 1e3 * np.eye(n)
    assert apart.min() > 2 * RADIUS
    assert (named >= 0).all() and (named <= np.array(size) - 1).all()
    again, _ = place(size, anchors, lines=lines, stems=anchors[:, :2])
    assert (centers == again).all()


@settings(max_examples=6)
@given(st.integers(0, 2**32 - 1))
def test_discs_hide_no_line_where_there_is_room(seed):
    rng = np.random.default_rng(seed)
    start = rng.uniform(150, 500, (12, 1, 2))
    lines = start + np.concatenate([np.zeros((12, 1, 2)), rng.uniform(-60, 60, (12, 1, 2))], axis=1)
    centers, _ = place((672, 672), lines, lines=lines)
    assert gap(centers, lines) > RADIUS + 3.0


def test_a_disc_lies_on_what_it_names_where_that_hides_nothing():
    centers, named = place((672, 672), np.array([[[300.0, 200.0]]]))
    np.testing.assert_allclose(centers, [[300, 200]], atol=2)
    np.testing.assert_allclose(named, [[300, 200]])


def test_a_disc_lies_beside_the_things_rather_than_on_them():
    u, v = np.meshgrid(np.arange(200, 400, 8.0), np.arange(200, 320, 8.0))
    things = np.column_stack([u.ravel(), v.ravel()])
    centers, named = place((672, 672), np.array([[[320.0, 210.0]]]), things=things)
    assert gap(centers, np.repeat(things[:, None], 2, axis=1)) >= RADIUS - 2
    assert np.linalg.norm(centers - named) < 60  # yet near


def test_a_disc_may_hide_its_own_stem_and_no_other():
    stem = np.array([[300.0, 200.0], [300.0, 300.0]])
    anchors = np.stack([stem, stem + np.array([200, 0])])
    alone, _ = place((672, 672), anchors, stems=anchors)
    np.testing.assert_allclose(alone, anchors[:, 0], atol=2)
    crossed, _ = place((672, 672), anchors, stems=anchors[::-1])
    assert np.linalg.norm(crossed - anchors[:, 0], axis=1).min() > 15


def test_what_lies_out_of_the_picture_is_named_where_it_enters_it():
    anchors = np.array([[[100.0, -300.0], [100.0, -50.0], [100.0, 200.0]]])
    _, named = place((672, 672), anchors)
    np.testing.assert_allclose(named, [[100, 200]])
    _, named = place((672, 672), anchors[:, :2])
    np.testing.assert_allclose(named, [[100, 0]])  # the nearest that there is
    _, named = place((672, 672), np.array([[[900.0, -400.0], [700.0, 300.0], [-90.0, 671.0]]]))
    np.testing.assert_allclose(named, [[671, 300]])


def test_what_is_nowhere_gets_a_disc_that_names_nothing_in_the_picture():
    centers, named = place((672, 672), np.full((2, 3, 2), np.nan))
    assert np.isfinite(centers).all()
    np.testing.assert_array_equal(named, centers)  # the leader has no length


def test_discs_without_room_are_an_error_that_says_how_many_there_is_room_for():
    with pytest.raises(InputError, match=r"40 marks do not fit .* 224x224 pixels; \d+ do"):
        place((224, 224), np.full((40, 1, 2), 100.0))
