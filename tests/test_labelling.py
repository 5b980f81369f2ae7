import json

import cv2
import numpy as np
import pytest
from command import refused, tog
from scans import scanned_bar

from tog_drake.assets.labelling import labelled_faces
from tog_drake.assets.mesh import read_mesh, solid_of
from tog_drake.assets.surface import face_areas
from tog_drake.benchmark.suite import object_labels
from tog_drake.contact_sheet import PART_COLORS
from tog_drake.regions import region_of

LABELS = """
object: bar
words: [bar]
parts: {left: {words: [left]}, right: {words: [right]}, tip: {words: [tip]}}
regions:
  - {part: tip, half_space: {normal: [1, 0, 0], offset: 0.08}}
  - {part: right, half_space: {normal: [1, 0, 0], offset: 0}}
  - {part: left, half_space: {normal: [-1, 0, 0], offset: 0.06}}
tasks: {}
"""


@pytest.fixture
def bar(tmp_path, monkeypatch):
    """The folder of an imported bar of 20 × 3 × 3 cm, labelled but for a stretch of 6 cm."""
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path))
    scanned_bar(tmp_path / "bar")
    (tmp_path / "bar" / "parts.yaml").write_text(LABELS)
    return tmp_path / "bar"


def test_every_face_has_a_part_or_counts_as_unlabelled(bar):
    areas = labelled_faces("bar").areas()
    assert list(areas) == ["left", "right", "tip", "unlabelled"]
    girth, end = 4 * 0.03, 0.03**2
    assert areas["tip"] == pytest.approx(0.02 * girth + end, rel=0.05)
    assert areas["right"] == pytest.approx(0.08 * girth, rel=0.05)
    assert areas["left"] == pytest.approx(0.04 * girth + end, rel=0.05)
    assert areas["unlabelled"] == pytest.approx(0.06 * girth, rel=0.05)


def test_the_picture_shows_the_parts_in_their_colours_and_the_command_their_areas(bar, tmp_path):
    done = tog("assets", "label", "bar", "--out", tmp_path / "labels.png", "--json")
    assert done.status == 0, done.err
    areas = json.loads(done.out.splitlines()[-1])["bar"]
    assert areas["unlabelled"] == pytest.approx(0.06 * 0.12, rel=0.05)
    pixels = cv2.imread(str(tmp_path / "labels.png"))[:240, :, ::-1].reshape(-1, 3).astype(float)
    hue = pixels / np.maximum(pixels.sum(axis=1, keepdims=True), 1)
    for color in PART_COLORS[:3]:
        near = np.abs(hue - np.array(color) / sum(color)).max(axis=1) < 0.05
        assert near.sum() > 100, color


def test_the_page_of_one_object_is_written_whole(bar, tmp_path):
    done = tog("assets", "label", "bar", "--out", tmp_path / "labels.html")
    assert done.status == 0, done.err
    assert "</html>" in (tmp_path / "labels.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bar", "--out", "labels.jpg"], "must end in .png or .html"),
        (["bar", "bar", "--out", "labels.html"], "2 objects cannot be shown in one page"),
        (["mug", "--out", "labels.png"], "no imported object is called 'mug'"),
    ],
)
def test_what_cannot_be_shown_is_refused(bar, tmp_path, arguments, message):
    *names, option, out = arguments
    refused(tog("assets", "label", *names, option, tmp_path / out), message)


def test_an_object_without_labels_says_where_they_belong(bar, tmp_path):
    (bar / "parts.yaml").unlink()
    done = tog("assets", "label", "bar", "--out", tmp_path / "labels.png")
    refused(done, "no part labels yet", str(bar / "parts.yaml"))


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("gso_Schleich_Lion_Action_Figure", "model.obj"),
        ("ycb_048_hammer", "textured.obj"),
        ("ycb_035_power_drill", "textured.obj"),
    ],
)
def test_every_part_of_a_scan_is_somewhere_on_it(shared_data, name, file):
    labels = object_labels(name)
    solid = solid_of(read_mesh(shared_data / "objects" / name / file))
    region = region_of(labels.regions, solid.vertices[solid.faces].mean(axis=1))
    part = np.array([r.part for r in labels.regions])[region]
    area = face_areas(solid.vertices, solid.faces)
    assert (region >= 0).all()
    for name in labels.part_words:
        assert area[part == name].sum() > 0.1 * area.sum(), name
