"""Reading scanned meshes: what strangers write, and what is made of it."""

import json

import numpy as np
import pytest
import tiny_meshes
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tog_drake.assets import foreign
from tog_drake.assets.foreign import Beside
from tog_drake.assets.mesh import FORMATS, read_mesh, solid_of
from tog_drake.assets.visual import write_visual
from tog_drake.errors import InputError


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "glb", "gltf"])
def test_a_box_is_the_same_box_in_every_format(tmp_path, kind):
    path = tmp_path / f"box.{kind}"
    if kind == "gltf":
        files = trimesh.exchange.gltf.export_gltf(trimesh.Scene(tiny_meshes.box(0.02, 0.04, 0.06)))
        for name, content in files.items():
            (tmp_path / (path.name if name.endswith("gltf") else name)).write_bytes(content)
    else:
        tiny_meshes.box(0.02, 0.04, 0.06).export(path)
    solid = solid_of(read_mesh(path, up="z"))
    assert solid.watertight
    assert solid.volume == pytest.approx(48e-6)
    np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), [0.02, 0.04, 0.06], atol=1e-6)


def test_gltf_is_y_up_unless_said_otherwise_and_the_others_z_up(tmp_path):
    for kind, up in (("glb", [0.02, 0.06, 0.04]), ("ply", [0.02, 0.04, 0.06])):
        path = tmp_path / f"box.{kind}"
        tiny_meshes.box(0.02, 0.04, 0.06, at=(0, 0.02, 0)).export(path)
        mesh = read_mesh(path)
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), up, atol=1e-6)
        if kind == "glb":  # what was up is up: y from 0 to 4 cm
            np.testing.assert_allclose(mesh.vertices[:, 2].min(), 0.0, atol=1e-6)
        turned = read_mesh(path, up="y" if kind == "ply" else "z")
        assert np.ptp(turned.vertices, axis=0)[2] == pytest.approx(0.1 - up[2])


@pytest.mark.parametrize("texture", ["paint.jpg", "my paint.png"])
def test_the_texture_of_an_obj_is_found_beside_it(tmp_path, texture):
    Image.new("RGB", (8, 8), (200, 10, 10)).save(tmp_path / texture)
    mesh = read_mesh(tiny_meshes.write_box_obj(tmp_path / "box.obj", texture=texture))
    assert mesh.texture.size == (8, 8)
    assert mesh.uv.shape == (len(mesh.vertices), 2)
    assert mesh.notes == ()


@pytest.mark.parametrize(
    "name",
    [
        *("../secret.png", "{}/secret.png", "http://127.0.0.1:9/secret.png", "~/secret.png"),
        *("link.png", "file:///etc/passwd", "..\\secret.png", "%2e%2e/secret.png", "a\x00b"),
    ],
)
def test_what_lies_outside_the_folder_is_not_read(tmp_path, name):
    folder = tmp_path / "scan"
    folder.mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "secret.png")
    (folder / "link.png").symlink_to(tmp_path / "secret.png")
    name = name.format(tmp_path)
    path = tiny_meshes.write_box_obj(folder / "box.obj", texture=name)
    mesh = read_mesh(path)
    assert mesh.texture is None
    assert "left out" in mesh.notes[0]
    with pytest.raises(FileNotFoundError):
        Beside(path).get(name)


@pytest.mark.parametrize(
    "name", ["C:\\scans\\paint.png", "/home/me/paint.png", "../paint.png", "-s 1 1 1 paint.png"]
)
def test_a_path_of_another_machine_stands_for_the_file_beside_the_mesh(tmp_path, name):
    Image.new("RGB", (8, 8)).save(tmp_path / "paint.png")
    assert (
        read_mesh(tiny_meshes.write_box_obj(tmp_path / "b.obj", texture=name)).texture is not None
    )


def test_a_material_that_refers_to_itself_or_is_missing_leaves_a_grey_mesh(tmp_path):
    path = tiny_meshes.write_box_obj(tmp_path / "box.obj", texture="box.mtl")
    assert read_mesh(path).texture is None
    missing = read_mesh(tiny_meshes.write_box_obj(tmp_path / "other.obj", mtl="none.mtl"))
    assert missing.texture is None
    assert "none.mtl" in missing.notes[0]
    assert (
        read_mesh(tiny_meshes.write_box_obj(tmp_path / "self.obj", mtl="self.obj")).texture is None
    )


def _gltf(path, change):
    """Writes a box as one glTF file with its buffer in it, changed."""
    files = trimesh.exchange.gltf.export_gltf(
        trimesh.Scene(tiny_meshes.box(0.05, 0.05, 0.05)), merge_buffers=True
    )
    tree = json.loads(files["model.gltf"])
    (name,) = (name for name in files if name.endswith(".bin"))
    (path.parent / name).write_bytes(files[name])
    change(tree)
    path.write_text(json.dumps(tree))
    return path


def _outside(tree):
    tree["buffers"][0]["uri"] = "../../../../etc/passwd"


def _bomb(tree):
    tree["accessors"].append({"count": 10**11, "componentType": 5126, "type": "VEC3"})


def _instances(tree):
    (mesh,) = (i for i, node in enumerate(tree["nodes"]) if "mesh" in node)
    tree["nodes"] += [dict(tree["nodes"][mesh]) for _ in range(10)]
    tree["accessors"][0]["count"] = 3 * foreign.MAX_FACES


def _shared_child(tree):
    tree["nodes"] = [{"children": [1, 1]}, {"mesh": 0}]


@pytest.mark.parametrize("change", [_outside, _bomb, _instances, _shared_child])
def test_hostile_gltf_is_refused(tmp_path, change):
    assert len(read_mesh(_gltf(tmp_path / "good.gltf", lambda tree: None)).faces) == 12
    with pytest.raises(InputError, match=r"bad\.gltf"):
        read_mesh(_gltf(tmp_path / "bad.gltf", change))


def test_a_texture_of_too_many_pixels_or_of_a_strange_format_is_refused(tmp_path, monkeypatch):
    path = tiny_meshes.write_box_obj(tmp_path / "box.obj", texture="paint.png")
    Image.new("RGB", (8, 8)).save(tmp_path / "paint.png")
    monkeypatch.setattr(foreign, "MAX_TEXTURE_PIXELS", 63)
    with pytest.raises(InputError, match="64 pixels"):
        read_mesh(path)
    monkeypatch.undo()
    Image.new("RGB", (8, 8)).save(tmp_path / "paint.png", format="EPS")  # would start Ghostscript
    with pytest.raises(InputError, match=r"texture is EPS.*PNG, JPEG"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("length", "hint"), [(147.0, "--scale 0.001 or --scale 0.01"), (0.0005, "--scale 100")]
)
def test_a_suspicious_unit_is_asked_and_never_guessed(tmp_path, length, hint):
    tiny_meshes.box(length, length / 2, length / 2).export(tmp_path / "box.stl")
    with pytest.raises(InputError, match=f"{length:.3g} m long.*centimetres.*Try {hint}"):
        read_mesh(tmp_path / "box.stl")
    scale = float(hint.split()[1])
    assert np.ptp(read_mesh(tmp_path / "box.stl", scale=scale).vertices) <= 2


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.obj", b""),
        ("empty.stl", b""),
        ("empty.glb", b""),
        ("points.obj", b"v 0 0 0\nv 1 0 0\n"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("inf.obj", b"v 0 0 1e999\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("mesh.dae", b"<COLLADA/>"),
    ],
)
def test_a_file_without_a_surface_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        read_mesh(tmp_path / name)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FORMATS), st.data())
def test_any_bytes_are_a_mesh_or_refused(tmp_path, kind, data):
    start = {
        ".obj": b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nf 1 2 3\n",
        ".ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\n",
        ".stl": b"solid a\n",
        ".gltf": b'{"asset": {"version": "2.0"}, "accessors": [{"count": 3}], "nodes": [',
        ".glb": b"glTF\x02\x00\x00\x00",
    }[kind]
    path = tmp_path / f"any{kind}"
    path.write_bytes(data.draw(st.sampled_from([b"", start])) + data.draw(st.binary(max_size=200)))
    try:
        mesh = read_mesh(path)
    except InputError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(mesh.vertices).all()


def test_debris_is_dropped_and_what_is_left_is_closed():
    body = tiny_meshes.l_shape()
    sliver = trimesh.Trimesh([[0.2, 0, 0], [0.21, 0, 0], [0.2, 0.01, 0], [0.21, 0, 0.01]],
                             [[0, 1, 2], [1, 0, 3]], process=False)  # fmt: skip
    solid = solid_of(_scanned(trimesh.util.concatenate([body, sliver])))
    assert solid.dropped == 2
    assert solid.watertight
    assert solid.volume == pytest.approx(5 * 0.03**3)


def _scanned(mesh):
    from tog_drake.assets.mesh import ScannedMesh

    return ScannedMesh(mesh.vertices, mesh.faces, None, None, (0, 0, 0))


def test_a_surface_that_winds_inwards_is_turned_over():
    inwards = tiny_meshes.l_shape()
    inwards.invert()
    solid = solid_of(_scanned(inwards))
    assert solid.watertight
    assert trimesh.Trimesh(solid.vertices, solid.faces).volume > 0


def test_a_tetrahedron_is_no_debris_but_loose_and_flat_triangles_are_refused():
    corners = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    tetrahedron = trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    assert solid_of(_scanned(tetrahedron)).volume == pytest.approx(0.05**3 / 6)
    loose = trimesh.Trimesh(np.arange(18.0).reshape(6, 3) ** 2 / 1000, [[0, 1, 2], [3, 4, 5]])
    with pytest.raises(InputError, match="2 loose triangles"):
        solid_of(_scanned(loose))
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0.1], [0.1, 0.1, 0.1], [0, 0.1, 0]],
                           [[0, 1, 2], [0, 2, 3]])  # fmt: skip
    with pytest.raises(InputError, match="flat"):
        solid_of(_scanned(flat))


def _material(**look):
    return trimesh.visual.TextureVisuals(
        uv=np.full((8, 2), 0.5), material=trimesh.visual.material.PBRMaterial(**look)
    )


def test_what_several_gltf_materials_show_stays_when_they_become_one_image(tmp_path):
    colors = {"white": (250, 250, 250), "brown": (150, 80, 20)}
    scene = trimesh.Scene()
    for i, (name, color) in enumerate(colors.items()):
        cube = tiny_meshes.box(0.03, 0.03, 0.03, at=(0.04 * i, 0, 0))
        image = Image.new("RGB", (16, 16), color)
        cube.visual = _material(baseColorTexture=image, baseColorFactor=[255] * 4)
        scene.add_geometry(cube, node_name=name)
    scene.export(tmp_path / "two.glb")
    mesh = read_mesh(tmp_path / "two.glb")
    seen = trimesh.visual.color.uv_to_color(mesh.uv, mesh.texture)[:, :3].astype(int)
    of = np.where(mesh.vertices[:, 0] < 0.02, 0, 1)
    np.testing.assert_allclose(seen, np.array(list(colors.values()))[of], atol=3)


def test_a_tinted_texture_and_a_plain_colour_of_gltf_are_turned_from_linear_to_srgb(tmp_path):
    half = [128, 128, 128, 255]  # linear: 188 of sRGB
    for look in ({}, {"baseColorTexture": Image.new("RGB", (16, 16), (255, 255, 255))}):
        cube = tiny_meshes.box(0.03, 0.03, 0.03)
        cube.visual = _material(baseColorFactor=half, **look)
        cube.export(tmp_path / "cube.glb")
        mesh = read_mesh(tmp_path / "cube.glb")
        color = mesh.texture.getpixel((3, 3)) if look else mesh.color
        np.testing.assert_allclose(color, [186] * 3, atol=2)


def test_a_grey_texture_of_16_bits_keeps_its_levels(tmp_path):
    levels = np.tile(np.linspace(0, 65535, 16).astype(np.uint16), (16, 1))
    Image.fromarray(levels).save(tmp_path / "paint.png")
    mesh = read_mesh(tiny_meshes.write_box_obj(tmp_path / "box.obj", texture="paint.png"))
    seen = np.asarray(mesh.texture)[0]
    np.testing.assert_allclose(seen, np.linspace(0, 255, 16)[:, None] * np.ones(3), atol=1)


@pytest.mark.parametrize("name", ["textures/Paint.PNG", "D:\\scans\\textures\\paint.png"])
def test_a_texture_in_a_folder_beside_the_mesh_is_found_whatever_its_capitals(tmp_path, name):
    (tmp_path / "textures").mkdir()
    Image.new("RGB", (8, 8)).save(tmp_path / "textures" / "paint.png")
    mesh = read_mesh(tiny_meshes.write_box_obj(tmp_path / "box.obj", texture=name))
    assert mesh.texture is not None and mesh.notes == ()


def test_a_surface_too_fine_to_feel_is_decimated_and_its_volume_that_of_the_file(monkeypatch):
    monkeypatch.setattr("tog_drake.assets.mesh.FINEST", 500)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    solid = solid_of(_scanned(ball))
    assert len(ball.faces) == 5120 and len(solid.faces) <= 500
    assert solid.watertight and solid.volume == pytest.approx(ball.volume)
    np.testing.assert_allclose(np.linalg.norm(solid.vertices, axis=1), 0.04, atol=0.002)


@pytest.mark.parametrize("all_of_them", [False, True])
def test_what_winds_inwards_is_seen_from_outside_in_the_visual(tmp_path, all_of_them):
    shape = tiny_meshes.l_shape()
    wrong = slice(None) if all_of_them else slice(0, None, 3)
    shape.faces[wrong] = shape.faces[wrong, ::-1].copy()
    mesh = _scanned(shape)
    write_visual(mesh, solid_of(mesh), tmp_path)
    seen = trimesh.load(tmp_path / "visual.gltf", force="mesh", process=False)
    assert seen.is_winding_consistent
    assert seen.volume == pytest.approx(5 * 0.03**3)
    assert seen.visual.material.doubleSided  # what is open is seen from inside
