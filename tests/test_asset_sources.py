"""Published scans by their names: what these mean, and all the way from a server into the library.

The archives are of the official layouts: around real scans where the data is there, else around a
block that is made here.
"""

import io
import json
import tarfile
import zipfile

import numpy as np
import pytest
from asset_server import AssetServer, status
from command import refused, tog
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tog_drake import download as downloading
from tog_drake.assets import fetching, importing
from tog_drake.assets.fetching import downloads_dir, fetch
from tog_drake.assets.library import asset_dir, checked_name, read_report, remove_asset
from tog_drake.assets.sources import SOURCES, read_spec
from tog_drake.errors import InputError

HAMMER = "ycb:048_hammer"
LION = "gso:Schleich_Lion_Action_Figure"


def block():
    """A textured block of 6 x 4 x 3 cm as OBJ, and its texture."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    sides = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
    lines = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in corners * [0.06, 0.04, 0.03]]
    lines += ["vt 0.1 0.1", "vt 0.9 0.1", "vt 0.9 0.9", "vt 0.1 0.9"]
    for side in sides:
        lines.append("f " + " ".join(f"{v}/{i}" for i, v in enumerate(side.split(), start=1)))
    return "\n".join(lines), Image.fromarray(np.full((8, 8, 3), [200, 40, 40], np.uint8))


def png(image, side=256):
    packed = io.BytesIO()
    image.convert("RGB").resize((side, side)).save(packed, "PNG")
    return packed.getvalue()


def obj(surface, material, library):
    """The OBJ as the collections have it: with the name of its material and of the library."""
    lines = [x for x in surface.splitlines() if not x.startswith(("mtllib", "usemtl", "#"))]
    return "\n".join([f"mtllib {library}", f"usemtl {material}", *lines, ""]).encode()


def mtl(texture):
    return f"newmtl material_0\n# shader_type beckmann\nmap_Kd {texture}\n\n".encode()


def ycb_archive(name, surface, image):
    """<name>_google_16k.tgz, as on the bucket."""
    files = {
        "kinbody.xml": b"<KinBody/>",
        "nontextured.ply": b"ply\n",
        "nontextured.stl": bytes(84),
        "texture_map.png": png(image),
        "textured.mtl": mtl("texture_map.png"),
        "textured.obj": obj(surface, "material_0", "./textured.mtl"),
    }
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as tar:
        for folder in (name, f"{name}/google_16k"):
            member = tarfile.TarInfo(folder)
            member.type, member.mode = tarfile.DIRTYPE, 0o755
            tar.addfile(member)
        for file, content in files.items():
            member = tarfile.TarInfo(f"{name}/google_16k/{file}")
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return packed.getvalue()


def gso_archive(surface, image, root=""):
    """<Name>.zip, as on Fuel: the texture lies elsewhere than its material says."""
    files = {
        "materials/textures/texture.png": png(image),
        "meshes/model.mtl": mtl("texture.png"),
        "meshes/model.obj": obj(surface, "material_0", "model.mtl"),
        "metadata.pbtxt": b"name: 'thing'",
        "model.config": b"<model/>",
        "model.sdf": b"<sdf/>",
        "thumbnails/0.jpg": b"\xff\xd8",
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for file, content in files.items():
            archive.writestr(root + file, content)
    return packed.getvalue()


@pytest.fixture(autouse=True)
def _own_library(tmp_path, monkeypatch):
    monkeypatch.setenv("TOG_ASSETS", str(tmp_path / "library"))
    monkeypatch.setattr(downloading, "FIRST_DELAY", 0.001)
    monkeypatch.setattr(importing, "write_preview", lambda *a: None)  # half of the time it takes


@pytest.fixture
def server(monkeypatch):
    """The two official servers, on this machine; without files."""
    with AssetServer({}) as running:
        monkeypatch.setenv("TOG_YCB_URL", running.url + "/data/google/")
        monkeypatch.setenv("TOG_GSO_URL", running.url + "/1.0/GoogleResearch/models")
        yield running


def hand_out(server, spec, archive):
    server.files[read_spec(spec).url.removeprefix(server.url)] = archive


@pytest.fixture
def scans(server):
    """The server hands out one object of each collection, made here."""
    hand_out(server, HAMMER, ycb_archive("048_hammer", *block()))
    hand_out(server, LION, gso_archive(*block()))
    return server


def statuses(done):
    return [fetched.status for fetched in done]


# What the names mean


def test_the_names_lead_to_the_official_servers(monkeypatch):
    for variable in ("TOG_YCB_URL", "TOG_GSO_URL"):
        monkeypatch.delenv(variable, raising=False)
    hammer, lion = read_spec(HAMMER), read_spec(LION)
    assert hammer.url == (
        "https://ycb-benchmarks.s3.amazonaws.com/data/google/048_hammer_google_16k.tgz"
    )
    assert hammer.mesh == "048_hammer/google_16k/textured.obj"
    assert (hammer.asset, hammer.mass) == ("ycb_048_hammer", 0.665)
    assert lion.url == (
        "https://fuel.gazebosim.org/1.0/GoogleResearch/models/Schleich_Lion_Action_Figure.zip"
    )
    assert (lion.asset, lion.mass) == ("gso_Schleich_Lion_Action_Figure", None)
    assert read_spec("ycb_048_hammer").url == hammer.url  # as it is called here


def test_the_pan_has_one_name_here_whichever_way_it_is_written():
    for spec in ("gso:chefmate_8_frypan", "gso:Chefmate_8_Frypan", "gso_chefmate_8_frypan"):
        pan = read_spec(spec)
        assert pan.asset == "gso_chefmate_8_frypan"
        assert pan.url.endswith("/Chefmate_8_Frypan.zip")


@pytest.mark.parametrize("spec", ["hope:ketchup", "hope:milk", "cy:glue_1"])
def test_what_no_server_hands_out_says_where_it_is_from_and_names_add_dir(spec):
    remote = read_spec(spec)
    with pytest.raises(InputError) as refused_:
        _ = remote.url
    for word in (spec, "github.com/", f"DIR/{remote.asset}/", "tog assets add-dir DIR"):
        assert word in str(refused_.value)


def test_what_is_not_for_commercial_use_says_so():
    assert "not for commercial use" in read_spec("hope:milk").source.licence


@pytest.mark.parametrize(
    "spec",
    ["", "ycb", "ycb:", "hammer", "048_hammer", "ftp:x", "ycb:../x", "gso:a/b", "gso:a b", "ycb:é"],
)
def test_a_name_that_is_none_is_refused(spec):
    with pytest.raises(InputError):
        read_spec(spec)


@given(st.sampled_from(["", "ycb:", "gso:", "gso_", "hope:"]), st.text(max_size=20))
def test_any_text_is_an_object_on_its_server_or_refused(start, rest):
    try:
        remote = read_spec(start + rest)
    except InputError:
        return
    assert checked_name(remote.asset) == remote.asset
    if remote.source.base is not None:
        folder, _, file = remote.url.rpartition("/")
        assert folder == remote.source.base
        assert not {"?", "#", "%", ":", "@"} & set(file)


def test_the_masses_are_those_of_the_data(shared_data):
    content = json.loads((shared_data / "objects" / "metadata.json").read_text())
    given_ = {k: v["mass_kg_ycb"] for k, v in content.items() if v["mass_kg_ycb"] is not None}
    assert {name: read_spec(name).mass for name in given_} == given_
    assert set(SOURCES) == {name.partition("_")[0] for name in content}


@pytest.mark.parametrize("url", ["ftp://mirror", "mirror", "http://", "http://[", "https://m/?x="])
def test_a_mirror_that_is_no_url_is_refused(monkeypatch, url):
    monkeypatch.setenv("TOG_YCB_URL", url)
    with pytest.raises(InputError, match="TOG_YCB_URL"):
        _ = read_spec(HAMMER).url


# From the server into the library


def test_objects_arrive_textured_with_their_mass_and_their_licence(scans):
    done = fetch([HAMMER, LION, HAMMER])
    assert statuses(done) == ["imported", "imported"]
    for spec, author in ((HAMMER, "B. Calli"), (LION, "Google LLC")):
        remote = read_spec(spec)
        report = read_report(remote.asset)
        sha256 = downloading.recorded_sha256(next(downloads_dir().glob(f"{remote.asset}.*[pz]")))
        assert report["textured"]
        assert report["source"] == remote.provenance(sha256)
        assert report["source"]["url"].startswith(scans.url)
        licence = (asset_dir(remote.asset) / "LICENSE.txt").read_text()
        for word in (author, "CC BY 4.0", "creativecommons.org", sha256, remote.url, "Changes"):
            assert word in licence
    assert read_report("ycb_048_hammer")["mass"] == pytest.approx(0.665)
    assert not list(downloads_dir().parent.glob(".*.tmp"))
    left = sorted(path.name for path in downloads_dir().iterdir())
    names = ["gso_Schleich_Lion_Action_Figure.zip", "ycb_048_hammer.tgz"]
    assert left == sorted([*names, *(f"{name}.sha256" for name in names)])


def test_what_is_there_is_left_alone_and_what_was_removed_needs_no_network(scans):
    fetch([HAMMER])
    asked = len(scans.asked)
    assert statuses(fetch([HAMMER])) == ["present"]
    remove_asset("ycb_048_hammer")
    scans.files.clear()
    assert statuses(fetch([HAMMER])) == ["imported"]
    assert len(scans.asked) == asked
    (failed,) = fetch([HAMMER], force=True)
    assert "no such file" in failed.message
    assert read_report("ycb_048_hammer")["textured"]


def test_what_fails_stops_nothing_else(scans):
    hand_out(scans, "gso:Broken", b"PK\x03\x04 and no more")
    hand_out(scans, "gso:Evil", zip_of({"../../evil": b"1", "meshes/model.obj": b"1"}))
    hand_out(scans, "gso:Empty", zip_of({"readme.txt": b"1"}))
    hand_out(scans, "gso:Twice", zip_of({"a/model.obj": b"1", "b/model.obj": b"1"}))
    hand_out(scans, "gso:Flat", zip_of({"meshes/model.obj": b"v 0 0 0\nf 1 1 1\n"}))
    told = []
    specs = ["gso:Broken", "gso:Evil", "gso:Empty", "gso:Twice", "gso:Flat", "gso:Nothing"]
    done = fetch([*specs, "hope:milk", LION], tell=told.append)
    assert told == done
    assert statuses(done) == ["failed"] * 7 + ["imported"]
    expected = (
        "damaged",
        "leads out",
        "holds 0 files model.obj; expected meshes/model.obj, given readme.txt",
        "holds 2 files model.obj",
        "",
        "no such file. Names: https://app.gazebosim.org",
        "add-dir",
    )
    for fetched, words in zip(done, expected, strict=False):
        assert words in fetched.message
    assert not list(downloads_dir().glob("gso_Evil*"))  # what is damaged is downloaded again
    assert not list(downloads_dir().parent.parent.rglob("evil"))
    assert [path.name for path in downloads_dir().parent.glob("[!.]*")] == [
        "gso_Schleich_Lion_Action_Figure"
    ]


def zip_of(files):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return packed.getvalue()


def test_a_mirror_may_pack_it_into_another_folder(server):
    hand_out(server, LION, gso_archive(*block(), root="models/lion/"))
    assert fetch([LION])[0].report["textured"]


def test_a_server_that_is_gone_is_tried_once_and_archives_still_serve(scans, monkeypatch):
    fetch([LION])
    remove_asset("gso_Schleich_Lion_Action_Figure")
    monkeypatch.setenv("TOG_YCB_URL", "http://127.0.0.1:9/x")
    monkeypatch.setenv("TOG_GSO_URL", "http://127.0.0.1:9/x")
    done = fetch([HAMMER, "ycb:025_mug", "gso:Dino_5", LION])
    assert statuses(done) == ["failed", "failed", "failed", "imported"]
    assert "still work" in done[0].message and "tog assets add-dir DIR" in done[0].message
    assert done[1].message == "not tried, because there is no connection to 127.0.0.1:9"
    assert "tog assets add-dir DIR" in done[2].message


def test_real_scans_in_the_official_layouts_become_objects(server, shared_data):
    Image.MAX_IMAGE_PIXELS = None
    for spec, mesh, skin in (
        (HAMMER, "textured.obj", "texture_map.jpg"),
        (LION, "model.obj", "texture.png"),
    ):
        folder = shared_data / "objects" / read_spec(spec).asset
        surface, image = (folder / mesh).read_text(), Image.open(folder / skin)
        pack = (lambda *x: ycb_archive("048_hammer", *x)) if spec == HAMMER else gso_archive
        hand_out(server, spec, pack(surface, image))
    done = fetch([HAMMER, LION])
    assert statuses(done) == ["imported", "imported"]
    hammer, lion = (fetched.report for fetched in done)
    assert hammer["extent"] == pytest.approx([0.1822, 0.3327, 0.0329], abs=1e-4)
    assert lion["extent"] == pytest.approx([0.115, 0.0417, 0.0704], abs=1e-4)
    for report in (hammer, lion):
        assert report["textured"]
        assert report["settled"]["ok"]


# The command


def test_the_command_says_what_became_of_each_and_prints_one_json_object(scans):
    done = tog("assets", "fetch", LION, "hope:milk", "--json")
    assert done.status == 1
    told = json.loads(done.out)
    assert told["gso_Schleich_Lion_Action_Figure"]["status"] == "imported"
    assert told["hope_milk"]["status"] == "failed"
    assert "gso_Schleich_Lion_Action_Figure: imported, 6.0 x 4.0 x 3.0 cm" in done.err
    assert "hope_milk: failed, hope:milk is on no server" in done.err
    again = tog("assets", "fetch", LION)
    assert (again.status, again.out) == (0, "gso_Schleich_Lion_Action_Figure: present\n")
    assert len(scans.asked) == 1


def test_a_name_that_is_none_is_wrong_input_and_nothing_is_done(scans):
    refused(tog("assets", "fetch", LION, "lion"), "'lion' is no object to fetch", "ycb:048_hammer")
    assert scans.asked == []


def test_pieces_are_cut_where_that_is_asked_for(scans, monkeypatch):
    asked = []
    cut = lambda path, name, options: asked.append(options.decompose) or {"notes": []}  # noqa: E731
    monkeypatch.setattr(fetching, "import_mesh", cut)
    assert tog("assets", "fetch", HAMMER, "--decompose").status == 0
    assert tog("assets", "fetch", HAMMER).status == 0
    assert asked == [True, False]


def test_a_suite_is_all_of_its_objects_each_once(server, monkeypatch):
    monkeypatch.setattr(downloading, "ATTEMPTS", 1)
    done = tog("assets", "fetch", "--suite", "tog29", "--json")
    assert done.status == 1
    told = json.loads(done.out)
    assert len(told) == 29
    assert {name for name, said in told.items() if "add-dir" in said["message"]} == {
        "hope_ketchup",
        "hope_milk",
        "cy_glue_1",
    }
    assert len({path for path, _ in server.asked}) == len(server.asked) == 26


def test_a_suite_that_is_none_and_nothing_at_all_are_wrong_input():
    refused(tog("assets", "fetch", "--suite", "tog30"), "unknown suite 'tog30'; valid:", "tog29")
    refused(tog("assets", "fetch"), "nothing to fetch", "--suite tog29")


def test_an_overloaded_server_is_one_line(scans):
    scans.misbehave(*[status(503)] * downloading.ATTEMPTS)
    done = tog("assets", "fetch", HAMMER)
    assert done.status == 1
    (line,) = done.out.splitlines()
    assert "status 503" in line
