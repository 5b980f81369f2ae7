"""Walking over profiles drawn by hand: one character is a bin of 1 cm."""

import numpy as np
import pytest

from tog_drake.proposers.profile import REACH, profiles, walk_outwards

BIN = 0.01
BINS = 2 * int(REACH / BIN) + 1


def drawn(picture):
    """The profile (1, B) of a picture: '#' a surface 1 cm above the tips, '_' 1 cm below them.

    The anchor's bin is marked by '@', a surface as well.
    """
    profile = np.full((1, BINS), np.inf)
    anchor = picture.index("@")
    for i, mark in enumerate(picture):
        if mark != " ":
            profile[0, BINS // 2 + i - anchor] = 0.01 if mark == "_" else -0.01
    return profile


def walk(picture, clearance=0.0):
    return walk_outwards(
        drawn(picture), np.zeros(1), width=BIN, max_gap=2 * BIN, clearance=clearance
    )


@pytest.mark.parametrize(
    ("picture", "low", "high"),
    [
        ("@", -0.005, 0.005),
        ("#@##", -0.015, 0.025),
        ("#  @", -0.035, 0.005),  # two empty bins are a gap that is bridged
        ("#   @", -0.005, 0.005),  # three are not
        ("#@ # #   ##", -0.015, 0.045),
    ],
)
def test_the_stretch_ends_where_a_gap_begins(picture, low, high):
    stretch = walk(picture)
    assert stretch.found.all()
    assert (stretch.low[0], stretch.high[0]) == pytest.approx((low, high))


def test_room_is_what_is_free_on_the_side_that_has_less():
    assert walk("#    @###     #").room[0] == pytest.approx(0.04)
    assert walk("     @###     #").room[0] == pytest.approx(0.05)
    assert walk("@").room[0] > 1


def test_what_lies_below_the_tips_is_no_part_of_the_stretch_but_may_take_its_room():
    assert walk("__@__").high[0] == pytest.approx(0.005)
    assert walk("__@__").room[0] > 1
    assert walk("__@__", clearance=0.02).room[0] == 0


def test_the_top_is_the_first_surface_of_the_stretch_alone():
    profile = drawn("#@#    #")
    profile[0, BINS // 2 + 1] = -0.03
    profile[0, BINS // 2 + 6] = -0.08  # not in it
    stretch = walk_outwards(profile, np.zeros(1), width=BIN, max_gap=BIN, clearance=0.0)
    assert stretch.top[0] == pytest.approx(-0.03)


def test_tips_that_stay_above_the_anchor_find_nothing():
    stretch = walk_outwards(drawn("#@#"), np.full(1, -0.02), width=BIN, max_gap=BIN, clearance=0.0)
    assert not stretch.found.any()


def test_a_profile_keeps_the_first_surface_in_each_bin():
    attempt = np.array([0, 0, 0, 1, 1])
    y = np.array([0.0, 0.004, 0.02, -0.03, 5.0])  # the last is out of reach
    z = np.array([0.03, 0.01, 0.02, 0.04, 0.0])
    profile = profiles(attempt, y, z, 2, BIN)
    assert profile.shape == (2, BINS)
    middle = BINS // 2
    assert profile[0, middle] == 0.01
    assert profile[0, middle + 2] == 0.02
    assert profile[1, middle - 3] == 0.04
    assert np.count_nonzero(np.isfinite(profile)) == 3
