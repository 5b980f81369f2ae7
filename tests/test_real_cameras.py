"""The cameras of the real robot: over LCM within this process, and a RealSense in software."""

import sys
import time

import cv2
import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import CameraConfig

from tog_drake.errors import InputError
from tog_drake.stations import realsense
from tog_drake.stations.camera_feed import UPDATE_PERIOD, CameraFeed
from tog_drake.stations.lcm_bus import ImagePair, images_message
from tog_drake.stations.lcm_camera import LcmImages
from tog_drake.stations.realsense import RealSense, RealSenseFeed

SETUP = CameraConfig(width=64, height=48, focal=CameraConfig.FocalLength(x=60.0), depth=True)


def pictures(seed=0, height=48, width=64):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
    return rgb, rng.uniform(0.3, 1.0, (height, width)).astype(np.float32)


def outputs(system, context):
    """What the ports say: colour (H, W, 3), depth (H, W) and the stamp."""
    rgba, depth = (
        system.GetOutputPort(name).Eval(context).data for name in ("rgb_image", "depth_image")
    )
    assert (rgba[..., 3] == 255).all()
    return (
        rgba[..., :3].copy(),
        depth[..., 0].copy(),
        system.GetOutputPort("stamp").Eval(context)[0],
    )


def test_images_that_arrive_over_lcm_are_on_the_ports_with_their_time():
    lcm = DrakeLcm("memq://")
    feed = LcmImages(channel="TOG_WRIST").open(lcm, SETUP)
    assert (feed.intrinsics.width, feed.intrinsics.fx, feed.intrinsics.cx) == (64, 60.0, 31.0)
    system = CameraFeed(feed)
    simulator = Simulator(system)
    simulator.AdvanceTo(UPDATE_PERIOD)
    rgb, _, stamp = outputs(system, simulator.get_context())
    assert (rgb.shape, stamp) == ((0, 0, 3), 0.0)  # nothing has arrived

    for seed in (1, 2):
        sent, metres = pictures(seed)
        now = time.time()
        lcm.Publish("TOG_WRIST", images_message(sent, metres, round(1e6 * now)))
        lcm.HandleSubscriptions(0)
        simulator.AdvanceTo(simulator.get_context().get_time() + UPDATE_PERIOD)
        rgb, depth, stamp = outputs(system, simulator.get_context())
        assert (rgb == sent).all() and (depth == metres).all()
        assert stamp == pytest.approx(now, abs=1e-5)


def test_the_outputs_are_of_the_state_and_not_of_what_arrived_meanwhile():
    lcm = DrakeLcm("memq://")
    system = CameraFeed(LcmImages(channel="TOG_WRIST").open(lcm, SETUP))
    simulator = Simulator(system)
    simulator.AdvanceTo(UPDATE_PERIOD)
    before = simulator.get_context().Clone()
    lcm.Publish("TOG_WRIST", images_message(*pictures(), round(1e6 * time.time())))
    lcm.HandleSubscriptions(0)
    assert outputs(system, simulator.get_context())[2] == 0.0
    simulator.AdvanceTo(2 * UPDATE_PERIOD)
    assert outputs(system, simulator.get_context())[2] > 0.0
    assert outputs(system, before)[2] == 0.0


def test_a_message_that_holds_no_images_is_said_to_be_refused():
    lcm = DrakeLcm("memq://")
    feed = LcmImages(channel="TOG_WRIST").open(lcm, SETUP)
    assert feed.problem() == ""
    lcm.Publish("TOG_WRIST", b"nothing of the kind")
    lcm.HandleSubscriptions(0)
    assert feed.newest() is None
    assert "1 messages were refused" in feed.problem()


def test_a_camera_over_lcm_without_a_channel_is_refused():
    with pytest.raises(InputError, match="channel: TOG_WRIST"):
        LcmImages().open(DrakeLcm("memq://"), SETUP)


def test_without_its_module_a_realsense_comes_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(InputError, match=r"pip install 'tog_drake\[realsense\]'"):
        RealSense().open(None, SETUP)


@pytest.fixture
def rs():
    return pytest.importorskip("pyrealsense2", reason=f"needs a module: {realsense.INSTALL}")


def newest(feed, seconds=20.0):
    """Waits for images of which the first few frames, which have no partner, are over."""
    end = time.monotonic() + seconds
    while feed.newest() is None and time.monotonic() < end:
        time.sleep(0.01)
    assert feed.newest() is not None, feed.problem()
    return feed.newest()


def test_a_realsense_gives_depth_in_metres_aligned_to_its_colour(rs):
    from software_camera import SCALE, SoftwareCamera

    height, width = 240, 320
    depth = np.full((height, width), round(1.0 / SCALE), np.uint16)
    depth[100:140, 140:180] = round(0.5 / SCALE)  # of the depth imager
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[:, :, 1], rgb[0, 0] = 7, (255, 0, 1)
    camera = SoftwareCamera(depth, rgb)
    feed = RealSenseFeed(camera, camera.stop, camera.color)
    try:
        images = newest(feed)
        assert (images.rgb == rgb).all()
        assert images.depth.dtype == np.float32
        assert set(np.unique(images.depth).round(6)) <= {0.0, 0.5, 1.0}
        v, u = np.nonzero(images.depth == 0.5)
        # Of 600 / 400 the size, and 15 mm nearer to the left: 600 · 0.015 / 0.5 pixels.
        assert np.ptp(v) + 1 == pytest.approx(60, abs=2)
        assert u.mean() == pytest.approx(159.5 - 18, abs=1)
        assert abs(time.time() - images.utime / 1e6) < 30
        camera_model = feed.intrinsics
        assert (camera_model.width, camera_model.height, camera_model.fx) == (320, 240, 600.0)
    finally:
        feed.close()
    last = feed.newest()
    time.sleep(0.1)
    assert feed.newest() is last  # closed is closed


def test_a_lens_that_distorts_is_straightened(rs):
    from software_camera import SCALE, SoftwareCamera

    coeffs = (0.15, -0.4, 0.001, -0.002, 0.3)
    rgb = pictures(3, 240, 320)[0]
    rgb = cv2.GaussianBlur(rgb, (0, 0), 4)
    camera = SoftwareCamera(np.full((240, 320), round(1 / SCALE), np.uint16), rgb, coeffs=coeffs)
    feed = RealSenseFeed(camera, camera.stop, camera.color)
    try:
        images = newest(feed)
    finally:
        feed.close()
    K = np.array([[600, 0, 159.5], [0, 600, 119.5], [0, 0, 1]])
    expected = cv2.undistort(rgb, K, np.array(coeffs)).astype(int)
    assert np.abs(rgb.astype(int) - expected).max() > 8  # there is something to straighten
    assert np.abs(images.rgb - expected)[5:-5, 5:-5].max() < 5


def test_a_camera_that_gives_nothing_more_is_said_and_ends_quickly(rs):
    class Unplugged:
        def wait_for_frames(self, milliseconds):
            raise RuntimeError("Frame didn't arrive within 500")

    from software_camera import _intrinsics

    stopped = []
    feed = RealSenseFeed(Unplugged(), lambda: stopped.append(True), _intrinsics(64, 48, 60.0))
    end = time.monotonic() + 20
    while not feed.problem() and time.monotonic() < end:
        time.sleep(0.01)
    assert "didn't arrive" in feed.problem()
    assert feed.newest() is None
    feed.close()
    assert stopped == [True] and not feed._thread.is_alive()


def test_where_no_realsense_is_connected_it_is_said_at_once_and_of_the_l515_too(rs):
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense camera is connected")
    with pytest.raises(InputError, match=r"no RealSense camera is connected.*2\.54\.2"):
        RealSense(serial="1").open(None, SETUP)


def test_images_are_never_copied_with_the_state_of_a_diagram():
    from copy import deepcopy

    images = ImagePair(1, *pictures())
    assert deepcopy(images) is images
