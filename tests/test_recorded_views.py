"""`tog choose` on photographs of real tables, as a user runs it."""

import json

import pytest
from command import tog

# frame, task, depth units per metre, and a box around the object that is meant: u, v, u, v [pixel]
VIEWS = [
    ("red_mug_6dof", "hold the red mug by the handle", 1000, (240, 185, 410, 345)),
    ("ycb_table_1", "hold the red mug by the handle", 1000, (315, 170, 410, 275)),
    ("ycb_table_3", "hold the orange drill by the handle", 1000, (390, 125, 545, 325)),
    ("graspnet_clutter", "hold the orange drill by the handle", 1000, (405, 420, 665, 640)),
    ("ycbvideo_4", "hold the blue pitcher by the handle", 10000, (240, 65, 455, 350)),
    ("ycbvideo_4", "grab the yellow bottle by the cap", 10000, (335, 235, 440, 450)),
]


@pytest.mark.parametrize(("frame", "task", "units", "box"), VIEWS)
def test_the_grasp_lands_on_the_object_that_is_named(
    shared_data, tmp_path, frame, task, units, box
):
    folder = shared_data / "rgbd" / frame
    done = tog(
        "choose", "--rgb", folder / "color.png", "--depth", folder / "depth.png",
        "--intrinsics", folder / "info.json", "--depth-scale", units, "--task", task,
        "--out", tmp_path, "--json",
    )  # fmt: skip
    assert done.status == 0, done.err
    choice = json.loads(done.out.splitlines()[-1])["choice"]
    u, v = choice["pixel"]
    assert box[0] <= u <= box[2] and box[1] <= v <= box[3], choice
    grasps = json.loads((tmp_path / "grasps.json").read_text())
    assert grasps["choice"] == choice["index"]
    assert grasps["grasps"][choice["index"]]["contact"][2] > 0.2  # [m] in front of the camera
