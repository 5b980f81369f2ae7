import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.saved_view import load_intrinsics, load_pose, load_view, save_view
from tog_drake.values import Intrinsics, View

CAMERA = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}


@pytest.fixture
def files(tmp_path):
    """A view in three files; returns them by name."""
    rgb, depth, camera = (tmp_path / n for n in ("rgb.png", "depth.png", "camera.json"))
    color = np.zeros((48, 64, 3), np.uint8)
    color[..., 0] = 200  # red
    cv2.imwrite(str(rgb), color[..., ::-1])
    cv2.imwrite(str(depth), np.full((48, 64), 500, np.uint16))
    camera.write_text(json.dumps(CAMERA))
    return {"rgb": rgb, "depth": depth, "intrinsics": camera}


def test_a_png_of_millimetres_becomes_metres_and_colours_stay_red(files):
    view = load_view(**files)
    assert view.depth.dtype == np.float32
    assert view.depth[10, 10] == pytest.approx(0.5)
    assert view.rgb[10, 10].tolist() == [200, 0, 0]
    assert (view.intrinsics.fx, view.intrinsics.width) == (60.0, 64)


@pytest.mark.parametrize("suffix", [".npy", ".tiff"])
def test_float_depth_is_metres_and_its_nan_and_inf_are_holes(files, suffix):
    metres = np.full((48, 64), 0.7, np.float32)
    metres[0, :3] = [np.nan, np.inf, 0]
    path = files["depth"].with_suffix(suffix)
    if suffix == ".npy":
        np.save(path, metres)
    else:
        cv2.imwrite(str(path), metres)
    view = load_view(**{**files, "depth": path})
    assert view.depth[0, :4].tolist() == pytest.approx([0, 0, 0, 0.7])


def test_the_scale_can_be_given(files):
    cv2.imwrite(str(files["depth"]), np.full((48, 64), 5000, np.uint16))
    assert load_view(**files, units_per_metre=10000).depth[0, 0] == pytest.approx(0.5)


def _write_depth(files, image):
    cv2.imwrite(str(files["depth"]), image)


def _write_camera(files, **changes):
    files["intrinsics"].write_text(json.dumps({**CAMERA, **changes}))


BAD = {
    "no rgb": (lambda f: f["rgb"].unlink(), "there is no file"),
    "rgb is text": (lambda f: f["rgb"].write_text("hello"), "as a colour image"),
    "rgb has 16 bits": (
        lambda f: cv2.imwrite(str(f["rgb"]), np.full((48, 64), 40000, np.uint16)),
        "8 bits a channel",
    ),
    "depth is text": (lambda f: f["depth"].write_text("hello"), "as depth"),
    "all holes": (lambda f: _write_depth(f, np.zeros((48, 64), np.uint16)), "all holes"),
    "sizes differ": (
        lambda f: _write_depth(f, np.full((24, 64), 500, np.uint16)),
        "differ in size",
    ),
    "8-bit depth": (lambda f: _write_depth(f, np.ones((48, 64), np.uint8)), "uint16 or float32"),
    "colour depth": (lambda f: _write_depth(f, np.ones((48, 64, 3), np.uint16)), "one channel"),
    "wrong scale": (lambda f: _write_depth(f, np.full((48, 64), 60000, np.uint16)), "depth-scale"),
    "no JSON": (lambda f: f["intrinsics"].write_text("{"), "as JSON"),
    "JSON list": (lambda f: f["intrinsics"].write_text("[1]"), "JSON object"),
    "no fx": (lambda f: f["intrinsics"].write_text('{"width": 64}'), "must be a number"),
    "fx is text": (lambda f: _write_camera(f, fx="wide"), "fx must be a number.*'wide'"),
    "fx negative": (lambda f: _write_camera(f, fx=-3), "fx = -3"),
    "fx in mm": (lambda f: _write_camera(f, fx=1.9), "focal length in pixels"),
    "cx outside": (lambda f: _write_camera(f, cx=900), "cx = 900 lies outside"),
    "other size": (lambda f: _write_camera(f, width=65), "65×48"),
    "half pixels": (lambda f: _write_camera(f, width=64.5), "whole numbers"),
    "infinite": (lambda f: f["intrinsics"].write_text('{"width": Infinity}'), "width must be"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_named_with_the_reason(files, case):
    spoil, message = BAD[case]
    spoil(files)
    with pytest.raises(InputError, match=message):
        load_view(**files)


def test_a_pickle_in_an_npy_file_is_not_opened(files, tmp_path):
    path = tmp_path / "depth.npy"
    np.save(path, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot read depth"):
        load_view(**{**files, "depth": path})


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_no_content_of_the_intrinsics_file_makes_it_fail_otherwise(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("camera") / "camera.json"
    path.write_bytes(content)
    with pytest.raises(InputError):
        load_intrinsics(path)


def test_a_pose_must_be_rigid(tmp_path):
    path = tmp_path / "pose.json"
    X = np.eye(4)
    X[:3, 3] = [1, 2, 3]
    path.write_text(json.dumps({"X_WC": X.tolist()}))
    np.testing.assert_array_equal(load_pose(path), X)
    path.write_text(json.dumps((2 * X).tolist()))
    with pytest.raises(InputError, match="no rigid transform"):
        load_pose(path)
    path.write_text("[[1, 2], [3]]")
    with pytest.raises(InputError, match="4×4"):
        load_pose(path)


def test_a_view_that_was_written_is_read_as_it_was(tmp_path):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 2.0, (48, 64)).astype(np.float32)
    depth[0, 0], depth[1, 1] = 0.0, 70.0
    X_WC = np.diag([1.0, -1.0, -1.0, 1.0])
    X_WC[2, 3] = 0.8
    camera = Intrinsics(width=64, height=48, fx=60.0, fy=61.0, cx=31.5, cy=23.5)
    rgb = rng.integers(0, 255, (48, 64, 3), np.uint8)
    save_view(tmp_path, View(rgb, depth, camera, X_WC))
    paths = [tmp_path / name for name in ("color.png", "depth.png", "camera.json")]
    read = load_view(*paths)
    np.testing.assert_array_equal(read.rgb, rgb)
    assert read.intrinsics == camera
    assert read.depth[0, 0] == read.depth[1, 1] == 0.0  # holes, and too far to be written
    rest = depth < 3.0
    np.testing.assert_allclose(read.depth[rest], depth[rest], atol=5.1e-4)
    np.testing.assert_allclose(load_pose(tmp_path / "pose.json"), X_WC)
