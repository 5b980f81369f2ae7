"""What the noise does to views of boxes whose exact depth is known."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.sensors import ImageDepth32F
from tabletop import RED, TABLE, look

from tog_drake.cameras import D435, L515
from tog_drake.scenario import load_scenario
from tog_drake.stations.depth_noise import DepthSensor, noisy_depth
from tog_drake.stations.simulation import SimulationStation

PRESETS = (L515, D435)
VGA = "640x480"
BOX = ((0.45, -0.05, 0.0), (0.55, 0.05, 0.10), RED)


def measured(preset, exact, seed=0):
    noise, focal = preset.depth_noise[VGA], preset.focal[VGA]
    return noisy_depth(exact.astype(np.float32), noise, focal, np.random.default_rng(seed))


def wall(distance):
    return np.full((480, 640), distance, np.float32)


def slanted(degrees, distance=0.6):
    """A plane about the vertical axis, seen at that angle in the middle of the image."""
    x = (np.arange(640) - 319.5) / 610
    depth = distance / (1 + x * np.tan(np.radians(degrees)))
    return np.broadcast_to(np.where((depth > 0.2) & (depth < 5), depth, 0), (480, 640))


def box_view():
    return look([TABLE, BOX], eye=(0.5, 0.0, 0.5), target=(0.5001, 0, 0), width=640, height=480)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("distance", [0.5, 1.0])
def test_the_error_on_a_wall_has_the_spread_that_the_preset_says(preset, distance):
    s0, s1, s2 = preset.depth_noise[VGA].sigma
    sigma = s0 + s1 * distance + s2 * distance**2
    error = measured(preset, wall(distance)) - distance
    rounding = preset.depth_noise[VGA].quantum / 12**0.5
    assert np.std(error) == pytest.approx(np.hypot(sigma, rounding), rel=0.05)
    assert abs(np.mean(error)) < 0.1 * sigma


def test_the_presets_are_as_noisy_as_the_real_cameras():
    spread = {
        (preset, z): np.std(measured(preset, wall(z))) for preset in PRESETS for z in (0.5, 1.0)
    }
    assert spread[L515, 1.0] == pytest.approx(0.0025, rel=0.05)  # the data sheet's
    for preset in PRESETS:
        assert 0.001 < spread[preset, 0.5] < 0.003
    assert spread[L515, 1.0] / spread[L515, 0.5] < 1.7
    assert spread[D435, 1.0] / spread[D435, 0.5] == pytest.approx(4.0, rel=0.1)  # quadratic


def test_stereo_errors_are_alike_over_several_pixels_and_a_lasers_are_not():
    alike = {}
    for preset in PRESETS:
        error = measured(preset, wall(0.8)) - 0.8
        alike[preset] = np.mean(error[:, :-4] * error[:, 4:]) / np.var(error)
    assert alike[D435] > 0.7
    assert alike[L515] < 0.1


def test_depth_comes_in_the_cameras_steps():
    for preset in PRESETS:
        steps = measured(preset, wall(0.6)) / preset.depth_noise[VGA].quantum
        np.testing.assert_allclose(steps, np.rint(steps), atol=2e-3)


def test_pixels_fly_at_depth_edges_and_nowhere_else():
    exact = box_view().depth
    top, table = exact.min(), np.median(exact)
    assert table - top == pytest.approx(0.1, abs=0.002)
    edge = np.zeros(exact.shape, bool)
    edge[:, 1:] |= np.abs(np.diff(exact, axis=1)) > 0.05
    edge[1:] |= np.abs(np.diff(exact, axis=0)) > 0.05
    for preset, least in ((L515, 200), (D435, 30)):
        depth = measured(preset, exact)
        flying = (depth > 0) & (np.abs(depth - top) > 0.02) & (np.abs(depth - table) > 0.02)
        assert flying.sum() > least
        assert all(
            edge[r - 8 : r + 9, c - 8 : c + 9].any()
            for r, c in zip(*np.nonzero(flying), strict=True)
        )


@pytest.mark.parametrize("preset", PRESETS)
def test_a_surface_seen_at_a_grazing_angle_gets_holes_and_one_seen_squarely_none(preset):
    lost = {}
    for degrees in (0, 50, 65, 80):
        exact = slanted(degrees)
        middle = np.s_[:, 300:340]
        lost[degrees] = np.mean(measured(preset, exact)[middle] == 0)
    assert lost[0] == lost[50] == lost[65] == 0
    assert 0.2 < lost[80] < 1


def test_a_stereo_camera_has_a_shadow_left_of_what_is_near_as_wide_as_the_baseline_makes_it():
    exact = box_view().depth
    row = 240
    box = np.flatnonzero(exact[row] < 0.45)
    width = D435.focal[VGA] * 0.05 * (1 / exact[row, 320] - 1 / np.median(exact))
    for preset, shadow in ((D435, width), (L515, 0.0)):
        rows = measured(preset, exact)[200:280]
        left = np.mean(np.sum(rows[:, : box[0]] == 0, axis=1))
        right = np.mean(np.sum(rows[:, box[-1] + 1 :] == 0, axis=1))
        assert left - right == pytest.approx(shadow, abs=2.0)


@pytest.mark.parametrize("preset", PRESETS)
def test_what_had_no_depth_stays_as_it_was(preset):
    exact = wall(0.7)
    exact[100:150, 200:300] = 0
    exact[300:350, 200:300] = np.inf
    depth = measured(preset, exact)
    assert np.all(depth[100:150, 200:300] == 0)
    assert np.all(np.isinf(depth[300:350, 200:300]))
    np.testing.assert_allclose(depth[400:], 0.7, atol=0.02)


def test_an_image_without_any_depth_is_returned():
    for preset in PRESETS:
        assert not measured(preset, wall(0)).any()
        assert np.all(np.isinf(measured(preset, wall(np.inf))))


def sensed(*, seed=0, camera="wrist", time=0.0):
    sensor = DepthSensor(D435.depth_noise[VGA], focal=620.8, seed=seed, camera=camera)
    image = ImageDepth32F(640, 480)
    image.mutable_data[:] = 0.6
    context = sensor.CreateDefaultContext()
    context.SetTime(time)
    sensor.GetInputPort("exact_depth_image").FixValue(context, Value(image))
    return sensor.GetOutputPort("depth_image").Eval(context).data.copy()


def test_seed_camera_and_time_decide_the_noise_and_nothing_else_does():
    first = sensed(time=0.4)
    np.testing.assert_array_equal(first, sensed(time=0.4))
    for other in (sensed(time=0.5), sensed(time=0.4, seed=1), sensed(time=0.4, camera="side")):
        assert np.mean(other != first) > 0.5


def test_the_station_exports_the_noisy_image_where_the_scenario_asks_for_it():
    depth = {}
    for noise in ("false", "true"):
        scenario = load_scenario("Hammer", f"cameras: {{wrist: !L515 {{noise: {noise}}}}}")
        station = SimulationStation(scenario)
        context = station.CreateDefaultContext()
        depth[noise] = station.GetOutputPort("wrist.depth_image").Eval(context).data[..., 0].copy()
    error = (depth["true"] - depth["false"])[depth["true"] > 0]
    assert 0.001 < np.median(np.abs(error)) / 0.6745 < 0.003
