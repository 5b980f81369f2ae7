"""From a mesh file to an object in the library: whole or not at all."""

import json
import os
import threading

import cv2
import numpy as np
import pytest
import tiny_meshes
from command import refused, tog
from PIL import Image

from tog_drake.assets import importing
from tog_drake.assets.importing import ImportOptions, import_mesh, sweep
from tog_drake.assets.library import asset_names, read_report


@pytest.fixture(autouse=True)
def library(tmp_path, monkeypatch):
    folder = tmp_path / "library"
    monkeypatch.setenv("TOG_ASSETS", str(folder))
    return folder


@pytest.fixture
def scan(tmp_path):
    """A red box with a JPG texture, in centimetres, with a licence and a piece beside it."""
    folder = tmp_path / "red box (1)"
    folder.mkdir()
    Image.new("RGB", (16, 16), (200, 20, 20)).save(folder / "paint.jpg")
    (folder / "LICENSE.txt").write_text("CC BY 4.0, by nobody")
    tiny_meshes.write_box_obj(folder / "model_col.obj", size=5)
    return tiny_meshes.write_box_obj(folder / "model.obj", size=5, texture="paint.jpg")


def test_a_scan_becomes_an_object_with_report_licence_and_a_picture(scan, library):
    done = tog("assets", "import", scan, "--scale", "0.01", "--mass", "0.2", "--json")
    assert done.status == 0, done
    report = json.loads(done.out)["red_box_1"]
    assert report == read_report("red_box_1")
    assert report["extent"] == [0.05, 0.05, 0.05]
    assert report["volume"] == pytest.approx(125e-6)
    assert report["mass"] == 0.2
    assert report["watertight"] and report["textured"] and report["settled"]["ok"]
    assert report["pieces"] == 1
    assert "125.0 cm³, closed, textured, 1 convex pieces" in " ".join(done.err.split())
    assert 500 <= report["faces"]["core"] <= 3000  # of twelve: subdivided, else it would tip
    assert (library / "red_box_1" / "LICENSE.txt").read_text() == "CC BY 4.0, by nobody"
    picture = cv2.imread(str(library / "red_box_1" / "preview.png")).astype(int)
    for half in np.hsplit(picture, 2):
        red = (half[..., 2] > 2 * half[..., 0]) & (half[..., 2] > 60)
        assert red.mean() > 0.1
    assert sorted(path.name for path in library.iterdir()) == ["red_box_1"]


def test_list_show_and_remove_know_an_imported_object(scan, tmp_path):
    import_mesh(scan, "red_box", ImportOptions(scale=0.01))
    sheet, page = tmp_path / "sheet.png", tmp_path / "page.html"
    done = tog("assets", "list", "--sheet", sheet)
    assert "red_box" in done.out and "1 objects" in done.out
    assert cv2.imread(str(sheet)).shape == (198, 1600, 3)
    done = tog("assets", "show", "red_box", "--out", page)
    assert done.status == 0
    assert "by its surface" in done.out and "penetration" in done.out
    assert page.stat().st_size > 500_000
    picture = tmp_path / "box.png"
    assert f"picture: {picture}" in tog("assets", "show", "red_box", "--out", picture).out
    assert cv2.imread(str(picture)).shape == (300, 800, 3)
    refused(tog("assets", "show", "red_box", "--out", "box.jpg"), ".png or .html", "box.jpg")
    assert tog("assets", "remove", "red_box").status == 0
    assert asset_names() == []
    refused(tog("assets", "show", "red_box"), "red_box", "tog assets list")
    refused(tog("assets", "remove", "../red_box"), "no name for an object")
    refused(tog("assets", "list", "--sheet", sheet), "no object is imported yet")


def test_an_import_over_an_object_replaces_all_of_it_but_its_part_labels(scan, library):
    _put(library)
    (library / "thing" / "parts.yaml").write_text("mine")
    import_mesh(scan, "thing", ImportOptions(scale=0.02))
    assert read_report("thing")["extent"] == [0.1, 0.1, 0.1]
    assert (library / "thing" / "parts.yaml").read_text() == "mine"
    assert not (library / "thing" / "stale.obj").exists()


def test_the_command_says_that_it_replaces_an_object_and_what_changes(scan, library):
    first = tog("assets", "import", scan, "--scale", "0.01", "--mass", "0.2")
    assert "replaces" not in first.out
    done = tog("assets", "import", scan, "--scale", "0.01")
    assert done.status == 0
    said = " ".join(done.out.split())
    assert (
        "it replaces the red_box_1 imported before: mass 0.2 kg, by its surface -> 0.05 kg" in said
    )
    again = tog("assets", "import", scan, "--scale", "0.01")
    assert "imported before: same file, extent and mass" in " ".join(again.out.split())


def _put(library):
    """An object that is there already."""
    (library / "thing").mkdir(parents=True)
    for name in ("model.sdf", "stale.obj"):
        (library / "thing" / name).write_text("old")


@pytest.mark.parametrize("where", ["write_visual", "write_preview"])
def test_an_import_that_is_interrupted_leaves_what_was_there(scan, library, monkeypatch, where):
    _put(library)

    def interrupt(*_args):
        raise KeyboardInterrupt

    monkeypatch.setattr(importing, where, interrupt)
    with pytest.raises(KeyboardInterrupt):
        import_mesh(scan, "thing", ImportOptions(scale=0.02))
    assert (library / "thing" / "stale.obj").read_text() == "old"
    assert [path.name for path in library.iterdir()] == ["thing"]


def test_one_name_given_at_the_same_time_leaves_one_whole_object(library, tmp_path):
    """Only the last step, of which many may meet; what comes before is in a folder of its own."""
    folders = [tmp_path / f"work_{i}" / "thing" for i in range(8)]
    for i, folder in enumerate(folders):
        folder.mkdir(parents=True)
        (folder / "model.sdf").write_text(str(i))
    library.mkdir()
    threads = [
        threading.Thread(target=importing._put_in_place, args=(folder, library / "thing"))
        for folder in folders
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (library / "thing" / "model.sdf").read_text() in "01234567"
    assert not any(folder.exists() for folder in folders)


def test_what_a_killed_import_has_left_is_swept_away_and_nothing_else(library):
    dead, alive = library / ".4194305-ab.tmp", library / f".{os.getpid()}-cd.tmp"
    for folder in (dead, alive, library / "thing", library / ".mine"):
        folder.mkdir(parents=True)
    sweep()
    assert sorted(p.name for p in library.iterdir()) == sorted([alive.name, ".mine", "thing"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--scale", "0"], ["--scale", "above 0"]),
        (["--scale", "1"], ["5 m long", "--scale 0.01"]),
        (["--scale", "0.01", "--mass", "0"], ["--mass", "0.001 to 20"]),
        (["--scale", "0.01", "--density", "1e9"], ["--density"]),
        (["--scale", "0.01", "--friction", "nan"], ["--friction"]),
        (["--scale", "0.01", "--faces", "3"], ["--faces", "from 50 to 20000"]),
        (["--up", "x"], ["--up", "z or y"]),
        (["--name", "a/b"], ["no name for an object"]),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(scan, library, options, words):
    refused(tog("assets", "import", scan, *options), *words)
    assert not library.exists() or not list(library.iterdir())


def test_a_disk_that_takes_no_more_is_told_with_the_folder_and_leaves_nothing(
    scan, library, monkeypatch
):
    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(importing, "write_visual", full)
    with pytest.raises(OSError, match=r"library: No space left.*TOG_ASSETS"):
        import_mesh(scan, "thing", ImportOptions(scale=0.02))
    assert list(library.iterdir()) == []


def test_a_folder_is_no_mesh_and_add_dir_is_named(scan):
    refused(tog("assets", "import", scan.parent), "is a folder", "add-dir")


def test_two_meshes_of_one_name_or_one_name_for_two_are_refused(scan):
    refused(tog("assets", "import", scan, scan.parent / "." / scan.name), "only 1 names")
    refused(tog("assets", "import", scan, "other.obj", "--name", "a"), "one name for 2")


def test_of_a_folder_the_good_are_imported_and_the_broken_told(scan, tmp_path):
    folder = scan.parent.parent / "scans"
    folder.mkdir()
    scan.parent.rename(folder / "good")
    (folder / "bad").mkdir()
    (folder / "bad" / "mesh.ply").write_bytes(b"ply\n")
    metadata = {
        "good": {"mesh": "model.obj", "scale_to_m": 0.01, "up_axis": "y", "mass_kg_ycb": 0.3,
                 "licence": "CC BY 4.0"},
        "bad": {},
        "away": {"mesh": "../../x.obj"},
        "odd": {"mesh": "model.obj", "scale_to_m": "1"},
        "a/b": {},
    }  # fmt: skip
    (folder / "metadata.json").write_text(json.dumps(metadata))
    done = tog("assets", "add-dir", folder, "--workers", "1", "--json")
    assert done.status == 1
    reports = json.loads(done.out)
    assert list(reports) == list(metadata)
    assert reports["good"]["mass"] == 0.3
    assert reports["good"]["source"] == {"licence": "CC BY 4.0"}
    assert asset_names() == ["good"]
    for name, word in (
        ("bad", "mesh.ply"),
        ("away", "outside"),
        ("odd", "number"),
        ("a/b", "name"),
    ):
        assert word in reports[name]["error"]
    assert "1 of 5 are imported" in done.err


def test_a_folder_without_metadata_gives_an_object_for_each_folder_with_one_mesh(scan):
    from tog_drake.assets.adding import find_jobs

    folder = scan.parent.parent / "scans"
    folder.mkdir()
    refused(tog("assets", "add-dir", folder), "no folder with a mesh")
    scan.parent.rename(folder / "red box (1)")
    (folder / "none").mkdir()
    none, good = find_jobs(folder)
    assert (good.name, good.mesh.name, good.error) == ("red_box_1", "model.obj", "")
    assert none.mesh is None and "none" in none.error
    (folder / "metadata.json").write_text("[")
    refused(tog("assets", "add-dir", folder), "metadata.json")


@pytest.mark.parametrize(
    ("name", "mesh", "options"),
    [
        ("gso_Schleich_Lion_Action_Figure", "model.obj", ImportOptions()),
        ("ycb_037_scissors", "textured.obj", ImportOptions(mass=0.082)),
        ("hope_ketchup", "textured.obj", ImportOptions(scale=0.01, up="y")),
    ],
)
def test_a_published_scan_is_imported_textured_and_lies_still(shared_data, name, mesh, options):
    report = import_mesh(shared_data / "objects" / name / mesh, name, options)
    assert report["settled"]["ok"] and report["textured"]
    assert report["pieces"] >= 12
    assert 590 <= report["faces"]["core"] <= 1500  # as its surface is large
