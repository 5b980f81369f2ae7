import numpy as np
import pytest

from tog_drake.denoising import denoised, inverse_depth_noise


def tilted_table(height=120, width=640):
    """The depth of a plane that falls away from the camera, 0.4 to 0.7 m."""
    q = np.linspace(1 / 0.4, 1 / 0.7, width, dtype=np.float32)  # linear in the pixel, as planes are
    return np.tile(1 / q, (height, 1))


def noisy(depth, sigma, seed=0):
    error = np.random.default_rng(seed).normal(0, sigma, depth.shape)
    return (depth + error).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.002, 0.008])  # [1/m]: 0.5 and 2 mm at 0.5 m
def test_the_noise_of_a_slanted_plane_is_measured(sigma):
    exact = tilted_table(height=480)
    assert inverse_depth_noise(exact) < 1e-6
    depth = 1 / noisy(1 / exact, sigma)
    assert inverse_depth_noise(depth) == pytest.approx(sigma, rel=0.05)


def test_the_noise_of_a_plane_seen_squarely_is_that_of_the_depth_over_its_square():
    depth = np.full((480, 640), 0.5, np.float32)
    assert inverse_depth_noise(noisy(depth, 0.001)) * 0.5**2 == pytest.approx(0.001, rel=0.05)


def test_things_on_the_plane_and_holes_do_not_count_as_noise():
    depth = noisy(np.full((480, 640), 0.5, np.float32), 0.001)
    expected = inverse_depth_noise(depth)
    depth[100:200, 100:300] -= 0.1
    depth[300:400, 100:300] = 0
    assert inverse_depth_noise(depth) == pytest.approx(expected, rel=0.05)
    assert inverse_depth_noise(np.zeros((480, 640), np.float32)) == 0


def test_an_exact_image_comes_back_as_it_is():
    depth = tilted_table()
    assert denoised(depth, inverse_depth_noise(depth)) is depth


def test_noise_shrinks_and_a_slanted_plane_is_not_bent():
    exact = tilted_table()
    depth = noisy(exact, 0.0017)
    error = denoised(depth, inverse_depth_noise(depth)) - exact
    assert np.std(error) < 0.3 * 0.0017
    assert np.max(np.abs(np.mean(error, axis=0)[20:-20])) < 0.0003


def test_an_edge_stays_sharp_and_a_thin_rod_stays():
    exact = np.full((120, 640), 0.5, np.float32)
    exact[:, 320:] = 0.47
    exact[:, 100:104] = 0.48
    depth = noisy(exact, 0.0017)
    error = np.abs(denoised(depth, inverse_depth_noise(depth)) - exact)
    assert np.mean(error[:, 310:330] > 0.005) < 0.01
    assert np.mean(error[:, 95:110] > 0.005) < 0.01


def test_holes_stay_holes_and_do_not_pull_at_their_neighbours():
    depth = noisy(np.full((120, 640), 0.5, np.float32), 0.0017)
    depth[50:60, 200:300] = 0
    result = denoised(depth, inverse_depth_noise(depth))
    np.testing.assert_array_equal(result == 0, depth == 0)
    assert np.abs(result[result > 0] - 0.5).max() < 0.006
