import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tog_drake import showing
from tog_drake.contact_sheet import (
    COLUMNS,
    PART_COLORS,
    PICTURE,
    TILE,
    object_names,
    object_tiles,
    tile_image,
)
from tog_drake.object_parts import load_parts
from tog_drake.resources import resource_dir


def test_every_object_is_on_the_sheet_and_only_objects(tmp_path: Path):
    folder = resource_dir("models") / "objects"
    assert object_names() == sorted(path.stem for path in folder.glob("*/*.sdf"))
    sheet = cv2.imread(str(showing.write_objects(tmp_path / "objects.png")))
    assert sheet.shape[1] == COLUMNS * TILE[0] == 1600
    for i in range(COLUMNS * (sheet.shape[0] // TILE[1])):
        row, column = divmod(i, COLUMNS)
        tile = sheet[row * TILE[1] :, column * TILE[0] :][: TILE[1] - 2, : TILE[0] - 2]
        drawn = np.abs(tile.astype(int) - tile[0, 0]).max(axis=2) > 20
        assert drawn[: PICTURE[1]].any() == drawn[PICTURE[1] :].any() == (i < len(object_names()))


def test_a_tile_shows_size_mass_and_every_part_in_its_colour():
    (tile,) = object_tiles(["bottle"])
    np.testing.assert_allclose(tile.size, [0.056, 0.056, 0.183], atol=0.001)
    assert tile.mass == pytest.approx(0.348, abs=0.001)
    image = tile_image(tile)[PICTURE[1] :].reshape(-1, 3)
    for color in PART_COLORS[: len(tile.labels.part_words)]:
        assert (image == color).all(axis=1).sum() >= 100  # in the legend
    hue = np.argmax(tile.parts[tile.parts.max(axis=2) < 200], axis=1)
    assert {1, 2} <= set(hue)  # and on the bottle: its cap green, its body blue


def test_there_is_a_colour_for_every_part():
    folder = resource_dir("models") / "objects"
    for name in object_names():
        assert len(load_parts(folder / name / "parts.yaml").part_words) <= len(PART_COLORS)


def test_a_sheet_that_cannot_be_finished_leaves_the_old_one(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(showing, "contact_sheet", lambda: np.zeros((4, 4, 3), np.uint8))
    path = tmp_path / "objects.png"
    path.write_text("old")

    def fail(*_args):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="disk full"):
        showing.write_objects(path)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["objects.png"]
