"""Where a camera sits on the hand, found from simulated views of a board."""

import json
import time

import numpy as np
import pytest
from charuco_views import BOARD, CAMERA, MOUNT, image, pose, postures
from command import refused, tog
from PIL import Image
from pydrake.lcm import DrakeLcm

from tog_drake.errors import InputError
from tog_drake.hardware.calibration import Board, apart, calibrate, see_board
from tog_drake.hardware.calibration_views import load_views, save_views, take_views
from tog_drake.hardware.mount import mount_of, with_mount
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.stations.lcm_bus import PANDA_STATUS, ImagePair, RobotMode, arm_status_message
from tog_drake.values import Intrinsics

N = 12
HOSTILE_NAMES = ("../01.png", "/etc/passwd", "", None, 3)
SCENARIO = """# A lab's own scenario.
cameras:
  wrist: !L515  # ours
    X_PB:  # by hand
      base_frame: "hand::panda_hand"
      translation: [0.06, 0.0, 0.03]  # with a ruler
      # the last line of it
    resolution: 640x480
random_seed: 3  # the end
"""


@pytest.fixture(scope="module")
def views():
    """Images (480, 640, 3) and postures (7,)."""
    return [(image(q, seed=i), q) for i, q in enumerate(postures(N))]


@pytest.fixture(scope="module")
def sights(views):
    return [see_board(f"{i:02}.png", rgb, q, BOARD, CAMERA) for i, (rgb, q) in enumerate(views, 1)]


def off(X):
    shift, turn = apart(X, MOUNT)
    return 1e3 * shift, np.degrees(turn)


def test_the_mount_is_found_to_a_millimetre_and_a_tenth_of_a_degree(sights):
    found = calibrate(sights, CAMERA)
    shift, turn = off(found.X_HC)
    assert shift < 1.0 and turn < 0.1
    assert found.rms < 0.2
    assert set(found.error) == set(found.left_out) == {sight.name for sight in sights}


def test_an_arm_that_is_off_by_a_millimetre_is_told_by_the_uncertainty(sights):
    shifts, told = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        noisy = [shaken(sight, rng.normal(0, 5e-4, 7)) for sight in sights]
        found = calibrate(noisy, CAMERA)
        shifts.append(off(found.X_HC)[0])
        told.append(1e3 * found.uncertainty[0])
    assert max(shifts) < 3.0
    assert 0.5 < np.sqrt(np.mean(np.square(told)) / np.mean(np.square(shifts))) < 3.0


def shaken(sight, dq):
    return type(sight)(sight.name, sight.q + dq, sight.p_T, sight.pixel, sight.X_CT)


def test_too_few_views_are_refused(sights):
    with pytest.raises(InputError, match=r"5 views show the board; at least 6.*take more"):
        calibrate(sights[:5], CAMERA)


def test_views_that_differ_too_little_are_refused():
    alike = [seen(q) for q in postures(8, spread=0.08, around=postures(1)[0])]
    with pytest.raises(InputError, match="look at the board from all sides"):
        calibrate(alike, CAMERA)


def test_views_that_are_turned_about_one_axis_alone_are_refused():
    with pytest.raises(InputError, match=r"one axis alone.*tilt the camera"):
        calibrate(
            [seen(q) for q in postures(8, spread=0.6, joints=[6], around=postures(1)[0])], CAMERA
        )


def seen(q):
    return see_board("a view", image(q), q, BOARD, CAMERA)


def test_a_view_with_another_posture_than_was_said_is_named(sights):
    wrong = list(sights)
    wrong[4] = shaken(sights[4], np.full(7, 0.05))
    with pytest.raises(InputError, match=r"contradict one another.*most 05\.png"):
        calibrate(wrong, CAMERA)


def test_a_board_of_another_size_than_was_said_is_refused(views):
    board = Board(square=0.05, marker=0.0375)
    sights = [see_board(str(i), rgb, q, board, CAMERA) for i, (rgb, q) in enumerate(views)]
    with pytest.raises(InputError, match="is a square as large as was said"):
        calibrate(sights, CAMERA)


def test_where_no_board_is_seen_there_is_no_sight():
    assert (
        see_board("grey", np.full((480, 640, 3), 128, np.uint8), np.zeros(7), BOARD, CAMERA) is None
    )
    with pytest.raises(InputError, match="320x240 pixels, but"):
        see_board("small", np.zeros((240, 320, 3), np.uint8), np.zeros(7), BOARD, CAMERA)


@pytest.mark.parametrize(
    "text",
    [
        SCENARIO,
        "cameras: {wrist: !L515 {}}\n",
        "cameras: {wrist: !L515 {resolution: 640x480}}  # one\n",
        "cameras:\n  wrist: !L515\n    # here\n    resolution: 640x480\n# end\n",
        'cameras:\n  wrist: !L515 {X_PB: {base_frame: "hand::panda_hand"}, noise: true}\n',
        "cameras: {wrist: !L515 {}}\r\nrandom_seed: 3\r\n",
    ],
)
def test_the_mount_is_written_and_the_rest_of_the_file_kept(text):
    written = with_mount(text, "a file", "wrist", MOUNT)
    loaded, before = (parse_scenario(t, "a file", Scenario()) for t in (written, text))
    shift, turn = off(mount_of(loaded, "wrist"))
    assert shift < 2e-3 and turn < 1e-4
    assert loaded.random_seed == before.random_seed
    assert loaded.cameras["wrist"].resolution == before.cameras["wrist"].resolution
    assert loaded.cameras["wrist"].noise == before.cameras["wrist"].noise
    comments = [line.partition("#")[2] for line in text.splitlines() if "by hand" not in line]
    assert [c for c in comments if c and "ruler" not in c and c not in written] == []
    again = with_mount(written, "a file", "wrist", MOUNT)
    assert again == written


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("random_seed: 1\n", "says nothing of camera wrist"),
        ("cameras: {wrist: !CameraConfig {}}\n", "mounted on the world"),
        ("cameras: {side: !L515 {}}\n", "says nothing of camera wrist"),
    ],
)
def test_a_file_without_such_a_camera_is_refused_and_it_is_said_what_to_add(text, words):
    with pytest.raises(InputError, match=words):
        with_mount(text, "a file", "wrist", MOUNT)


def test_the_command_writes_a_copy_and_says_how_good_it_is(views, tmp_path):
    file, copy = tmp_path / "lab.yaml", tmp_path / "new.yaml"
    file.write_text(SCENARIO)
    blind = (np.full((480, 640, 3), 99, np.uint8), np.zeros(7))
    save_views(tmp_path / "views", CAMERA, [*views, blind])
    arguments = ("--scenario", file, "--views", tmp_path / "views")
    done = tog("hardware", "calibrate", *arguments, "--out", copy, "--json")
    assert done.status == 0, done.err
    told = json.loads(done.out)
    assert told["not_used"] == [f"{N + 1:02}.png"]
    assert "too little of the board" in done.err and "standard error" in done.err
    assert file.read_text() == SCENARIO
    shift, turn = off(mount_of(parse_scenario(copy.read_text(), "copy", Scenario()), "wrist"))
    assert shift < 1.0 and turn < 0.1
    done = tog("hardware", "calibrate", *arguments)
    assert done.status == 0, done.err
    assert file.read_text() == copy.read_text()


def test_the_board_to_print_is_as_large_as_it_says_and_is_found_in_its_own_picture(tmp_path):
    file = tmp_path / "board.png"
    size = ("--board", "9x6", "--square", "0.025", "--marker", "0.018")
    done = tog("hardware", "board", "--out", file, *size)
    assert done.status == 0, done.err
    assert "225 x 150 mm" in done.out
    with Image.open(file) as picture:
        printed = np.array(picture.size) / np.array(picture.info["dpi"]) * 0.0254
        rgb = np.array(picture.convert("RGB"))
    np.testing.assert_allclose(printed, [0.225, 0.150], atol=1e-4)
    # From a metre above it, a camera whose pixels are those of the print sees this very picture.
    height, width, _ = rgb.shape
    focal = width / 0.225
    camera = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    sight = see_board("it", rgb, np.zeros(7), Board(9, 6, 0.025, 0.018), camera)
    assert len(sight.pixel) == 8 * 5
    np.testing.assert_allclose(sight.X_CT[:3, 3], [-0.1125, -0.075, 1.0], atol=2e-3)
    refused(tog("hardware", "board", "--out", tmp_path / "board.jpg"), ".png")
    refused(tog("hardware", "board", "--out", file, "--square", "2"), "does not fit")


def test_what_cannot_be_calibrated_leaves_the_file_as_it_was(views, tmp_path):
    file = tmp_path / "lab.yaml"
    file.write_text(SCENARIO)
    save_views(tmp_path / "few", CAMERA, views[:3])
    arguments = ("hardware", "calibrate", "--scenario", file, "--views", tmp_path / "few")
    refused(tog(*arguments), "3 views show the board")
    refused(tog(*arguments, "--board", "7"), "COLUMNSxROWS")
    refused(tog(*arguments, "--dictionary", "9X9_9"), "unknown dictionary")
    refused(tog(*arguments, "--marker", "0.05"), "does not fit")
    refused(tog(*arguments, "--camera", "left"), "valid: wrist")
    refused(tog(*arguments, "--live"), "is not empty")
    refused(tog("hardware", "calibrate", "--scenario", "Hammer", "--views", tmp_path), "copy")
    assert file.read_text() == SCENARIO


@pytest.mark.parametrize(
    "view",
    [
        *({"image": name, "q": [0.0] * 7} for name in HOSTILE_NAMES),
        *({"image": "01.png", "q": q} for q in ([0.0] * 6, ["a"] * 7, None, [1e9] * 7, [[0]] * 7)),
        "01.png",
    ],
)
def test_a_view_that_is_no_image_beside_it_with_seven_angles_is_refused(view, tmp_path):
    (tmp_path / "views.json").write_text(json.dumps({"views": [view]}))
    with pytest.raises(InputError, match=r"views\.json"):
        load_views(tmp_path, BOARD, CAMERA)


class Bench:
    """An arm's driver and a camera that speak while somebody listens."""

    def __init__(self, views):
        self.lcm = DrakeLcm("memq://")
        self.views, self.at, self.v, self.silent = views, 0, 0.0, False
        self.intrinsics = CAMERA

    def HandleSubscriptions(self, milliseconds):
        if not self.silent:
            _, q = self.views[self.at]
            v, now = np.full(7, self.v), round(1e6 * time.time()) + 1
            message = arm_status_message(q, v, np.zeros(7), RobotMode.GUIDING, now)
            self.lcm.Publish(PANDA_STATUS, message)
        return self.lcm.HandleSubscriptions(0)

    def Subscribe(self, channel, handler):
        return self.lcm.Subscribe(channel, handler)

    def newest(self):
        return ImagePair(round(1e6 * time.time()), self.views[self.at][0], np.zeros((480, 640)))

    def problem(self):
        return ""


def test_views_are_taken_at_enter_where_the_arm_rests_and_the_board_is_seen(views, monkeypatch):
    monkeypatch.setattr("tog_drake.hardware.calibration_views._WAIT", 0.2)
    bench = Bench([*views[:2], (np.zeros((480, 640, 3), np.uint8), views[0][1])])
    turns = iter(
        [(0, 0.0, False), (1, 0.5, False), (2, 0.0, False), (1, 0.0, True), (1, 0.0, False)]
    )

    def press(question):
        turn = next(turns, None)
        if turn is None:
            return "d"
        bench.at, bench.v, bench.silent = turn
        return ""

    told = []
    taken = take_views(bench, bench, BOARD, press, told.append)
    assert [(q == given).all() for (_, q), (_, given) in zip(taken, views[:2], strict=True)] == [
        True
    ] * 2
    assert [line.split(":")[0] for line in told] == ["taken", *["not taken"] * 3, "taken"]
    assert "let it rest" in told[1] and "too little of the board" in told[2]
    assert "no image" in told[3] or "no PANDA_STATUS" in told[3]


def test_a_mount_is_the_camera_s_and_not_its_body_s():
    place = "translation: [0.01, 0, 0]"
    text = (
        'cameras: {wrist: !CameraConfig {X_PB: {base_frame: "hand::panda_hand"}, '
        f"X_BC: {{{place}}}, X_BD: {{{place}}}}}}}\n"
    )
    loaded = parse_scenario(text, "a file", Scenario())
    assert np.allclose(mount_of(loaded, "wrist"), pose([0, 0, 0], [0.01, 0, 0]))
    written = parse_scenario(with_mount(text, "a file", "wrist", MOUNT), "a file", Scenario())
    assert off(mount_of(written, "wrist"))[0] < 2e-3
