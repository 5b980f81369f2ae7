import numpy as np
import pytest
from pydrake.systems.sensors import CameraConfig

from tog_drake.cameras import D435, L515, drake_config, noise_of, with_noise
from tog_drake.errors import InputError
from tog_drake.scenario import Scenario, camera_configs, parse_scenario


def _parse(text):
    return parse_scenario(text, "test.yaml", Scenario())


@pytest.mark.parametrize("preset", ["L515", "D435"])
@pytest.mark.parametrize("resolution", ["640x480", "1280x720"])
def test_a_preset_sees_as_wide_and_as_near_as_the_data_sheet_says(preset, resolution):
    scenario = _parse(f"cameras: {{wrist: !{preset} {{resolution: {resolution}}}}}")
    color, depth = camera_configs(scenario)["wrist"].MakeCameras()
    info = color.core().intrinsics()
    wide, high = {"L515": (70, 43), "D435": (69, 42.3)}[preset]
    assert f"{info.width()}x{info.height()}" == resolution
    assert np.degrees(info.fov_y()) == pytest.approx(high, abs=0.1)
    if resolution == "1280x720":
        assert np.degrees(info.fov_x()) == pytest.approx(wide, abs=0.1)
    nearest = {("D435", "1280x720"): 0.28, ("D435", "640x480"): 0.175}.get((preset, resolution))
    assert depth.depth_range().min_depth() == pytest.approx(nearest or 0.25)


@pytest.mark.parametrize("preset", ["L515", "D435"])
def test_an_unknown_resolution_names_the_presets(preset):
    with pytest.raises(InputError, match=rf"{preset} has no resolution '9x9'.*1280x720, 640x480"):
        camera_configs(_parse(f"cameras: {{wrist: !{preset} {{resolution: 9x9}}}}"))


def test_depth_is_exact_unless_noise_is_asked_for():
    text = "cameras: {a: !L515 {}, b: !D435 {noise: true}, c: !CameraConfig {}}"
    cameras = _parse(text).cameras
    assert noise_of(cameras["a"]) is None
    assert noise_of(cameras["b"]) == D435.depth_noise["640x480"]
    assert noise_of(cameras["c"]) is None


def test_noise_can_be_switched_on_in_all_presets_and_nothing_else_changes():
    scenario = _parse("cameras: {a: !L515 {resolution: 1280x720}, b: !D435 {}}")
    noisy = with_noise(scenario.cameras)
    assert noise_of(noisy["a"]) == L515.depth_noise["1280x720"]
    assert noise_of(noisy["b"]) == D435.depth_noise["640x480"]
    assert not scenario.cameras["a"].noise
    assert drake_config(noisy["a"]).width == 1280


def test_nobody_knows_the_noise_of_a_camera_that_is_no_preset():
    with pytest.raises(InputError, match=r"camera mine .* valid with noise: !L515 \{\}, !D435"):
        with_noise({"wrist": L515(), "mine": CameraConfig()})
