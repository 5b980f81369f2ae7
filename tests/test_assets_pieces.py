"""The shapes by which scanned objects touch, and their mass properties."""

import sys

import numpy as np
import pytest
import tiny_meshes
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.assets import collision
from tog_drake.assets.collision import (
    CORE_FACES,
    ROOM,
    SKIN_PIECES,
    core_faces,
    core_of,
    cut_in_file_order,
    decompose,
    find_pieces,
    fits,
    merged,
    read_pieces,
)
from tog_drake.assets.importing import name_for
from tog_drake.assets.mesh import Solid
from tog_drake.assets.model import inertia_of
from tog_drake.errors import InputError


def _solid(mesh, watertight=True):
    return Solid(mesh.vertices, mesh.faces, watertight, 0, mesh.convex_hull.volume)


def _half_ball():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    ball.update_faces(ball.triangles_center[:, 2] > 0)
    return ball


_SIDE = st.integers(1, 5)
_BOXES = st.lists(
    st.tuples(_SIDE, _SIDE, _SIDE, st.integers(-9, 9), st.integers(-9, 9)), min_size=1, max_size=6
)


@settings(max_examples=40)
@given(_BOXES, st.randoms())
def test_any_boxes_in_order_come_back_even_where_they_touch(boxes, random):
    meshes = [tiny_meshes.box(*size, at=(*at, 0)) for *size, a, b in boxes for at in [(a, b)]]
    for mesh in meshes:
        order = list(range(12))
        random.shuffle(order)
        mesh.update_faces(order)
    cut = cut_in_file_order(np.concatenate([mesh.triangles for mesh in meshes]))
    assert len(cut) == len(meshes)
    for piece, mesh in zip(cut, meshes, strict=True):
        np.testing.assert_array_equal(piece, mesh.triangles.reshape(-1, 3))


def test_what_is_left_open_at_the_end_is_dropped():
    whole, open_ = tiny_meshes.box(1, 1, 1), tiny_meshes.box(1, 1, 1, at=(3, 0, 0))
    triangles = np.concatenate([whole.triangles, open_.triangles[:-1]])
    assert len(cut_in_file_order(triangles)) == 1


def test_boxes_of_quads_in_one_obj_come_back_as_boxes(tmp_path):
    first = tiny_meshes.write_box_obj(tmp_path / "one.obj", size=0.02).read_text()
    second = tiny_meshes.write_box_obj(tmp_path / "two.obj", size=0.04).read_text()
    moved = "\n".join(
        "f " + " ".join(str(int(c.split("/")[0]) - 9) for c in line.split()[1:])  # from the end
        if line.startswith("f ")
        else line
        for line in second.splitlines()
    )
    (tmp_path / "all_col.obj").write_text(first + moved)
    pieces = read_pieces(find_pieces(tmp_path / "mesh.obj"), 0.5, np.eye(3))
    assert [round(float(np.ptp(v)), 9) for v, _ in pieces] == [0.01, 0.02]


def test_pieces_in_one_stl_are_scaled_and_turned(tmp_path):
    boxes = [tiny_meshes.box(1, 2, 3), tiny_meshes.box(2, 2, 2, at=(2, 0, 0))]
    trimesh.util.concatenate(boxes).export(tmp_path / "a_vhacd.stl")
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    first, _ = read_pieces(find_pieces(tmp_path / "a.obj"), 0.01, turn)
    np.testing.assert_allclose(np.ptp(first[0], axis=0), [0.01, 0.03, 0.02], atol=1e-9)


def test_of_many_pieces_the_largest_are_kept_and_more_files_are_refused(tmp_path, monkeypatch):
    boxes = [
        tiny_meshes.box(s, s, s, at=(i, 0, 0)) for i, s in enumerate(np.linspace(0.01, 0.5, 1000))
    ]
    trimesh.util.concatenate(boxes).export(tmp_path / "a_vhacd.stl")
    pieces = read_pieces([tmp_path / "a_vhacd.stl"], 1.0, np.eye(3))
    assert len(pieces) == collision.MAX_PIECES
    assert min(np.ptp(v[:, 2]) for v, _ in pieces) > 0.1
    monkeypatch.setattr(collision, "MAX_PIECE_FILES", 2)
    with pytest.raises(InputError, match="more than 2 collision pieces"):
        read_pieces([tmp_path / "a_vhacd.stl"] * 3, 1.0, np.eye(3))


@pytest.mark.parametrize("content", ["", "v 0 0 0\nf 1 1 1\nf 9 9 9\n", "v 0 0 x\n", "f 1 2 3\n"])
def test_pieces_that_cannot_be_read_are_refused_by_name(tmp_path, content):
    path = tmp_path / "a_col.obj"
    path.write_text(content)
    with pytest.raises(InputError, match=r"a_col\.obj"):
        read_pieces([path], 1.0, np.eye(3))


def test_pieces_outside_the_folder_are_not_taken(tmp_path):
    (tmp_path / "scan").mkdir()
    tiny_meshes.box(1, 1, 1).export(tmp_path / "b_vhacd.stl")
    (tmp_path / "scan" / "a_vhacd.stl").symlink_to(tmp_path / "b_vhacd.stl")
    assert find_pieces(tmp_path / "scan" / "a.obj") == []


def test_pieces_of_another_thing_do_not_fit():
    solid = _solid(tiny_meshes.l_shape())
    assert fits([(tiny_meshes.l_shape().vertices, None)], solid)
    assert not fits([(100 * tiny_meshes.l_shape().vertices, None)], solid)
    assert not fits([], solid)


@pytest.mark.parametrize("faces", [49, 20_001, -1])
def test_the_number_of_faces_has_a_range(faces):
    with pytest.raises(InputError, match=f"from 50 to 20000, not {faces}"):
        core_of(_solid(tiny_meshes.box(1, 1, 1)), faces)


def test_a_fine_surface_is_decimated_and_keeps_its_shape():
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    vertices, faces = core_of(_solid(ball), 500)
    assert 400 <= len(faces) <= 500
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, atol=6e-4)
    assert len(core_of(_solid(ball), 60)[1]) <= 60


def test_small_things_have_fewer_faces_than_large_ones_within_limits():
    sides = 0.01, 0.08, 1.0
    few, some, many = (core_faces(_solid(tiny_meshes.box(a, a, a))) for a in sides)
    assert (few, many) == CORE_FACES
    assert some == int(6 * 0.08**2 / collision.FACE)


def _as_pieces(meshes):
    return [(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in meshes]


def _fills(pieces):
    return sum(trimesh.Trimesh(*piece).volume for piece in pieces)


def test_the_slices_of_a_bar_are_merged_to_fewer_that_fill_it():
    slices = [tiny_meshes.box(0.01, 0.02, 0.02, at=(0.01 * i, 0, 0)) for i in range(40)]
    skin = merged(_as_pieces(slices))
    assert len(skin) == SKIN_PIECES
    assert _fills(skin) == pytest.approx(40 * 4e-6)
    few = _as_pieces(slices[:SKIN_PIECES])
    assert merged(few) == few


def test_the_pieces_of_a_thin_ring_are_merged_no_further_than_leaves_it_hollow():
    ring = []
    for turn in np.linspace(0, 2 * np.pi, 48, endpoint=False):
        piece = tiny_meshes.box(0.001, 0.0055, 0.02, at=(0.04, 0, 0))
        piece.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
        ring.append(piece)
    skin = merged(_as_pieces(ring))
    assert SKIN_PIECES < len(skin) < 48
    assert _fills(skin) <= ROOM * _fills(_as_pieces(ring))


def test_the_inertia_of_a_box_is_that_of_the_book():
    inertia = inertia_of(_solid(tiny_meshes.box(0.1, 0.2, 0.3)), [], mass=1.2, density=1)
    np.testing.assert_allclose(
        inertia.moments, 0.1 * np.diag([0.04 + 0.09, 0.01 + 0.09, 0.01 + 0.04]), atol=1e-9
    )


@pytest.mark.parametrize(
    "mesh",
    [
        _half_ball(),
        tiny_meshes.box(0.3, 0.0003, 0.0003),
        tiny_meshes.box(0.3, 0.2, 0.0003),
    ],
    ids=["open half ball", "needle", "sheet"],
)
def test_open_and_thin_things_have_the_inertia_of_a_body(mesh):
    inertia = inertia_of(_solid(mesh, bool(mesh.is_watertight)), [], mass=None, density=400)
    moments = np.linalg.eigvalsh(inertia.moments)
    assert 0 < moments[0] <= moments[1] <= moments[2] <= (moments[0] + moments[1]) * (1 + 1e-9)
    assert ("closed" in inertia.how) == (not mesh.is_watertight)


def test_a_surface_that_adds_up_to_no_body_falls_back_on_its_hull():
    inside_out = tiny_meshes.l_shape()
    inside_out.invert()
    assert "hull" in inertia_of(_solid(inside_out), [], mass=0.1, density=400).how


def test_without_coacd_the_way_to_install_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(InputError, match=r"pip install 'tog_drake\[assets\]'"):
        decompose(_solid(tiny_meshes.l_shape()))


def test_coacd_cuts_an_l_into_convex_pieces_that_fill_it():
    pytest.importorskip("coacd", reason="the extra [assets] is not installed")
    pieces = decompose(_solid(tiny_meshes.l_shape()))
    assert len(pieces) >= 2
    volume = sum(trimesh.Trimesh(*piece).volume for piece in pieces)
    assert volume == pytest.approx(5 * 0.03**3, rel=0.1)


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("red mug (1).obj", "red_mug_1"),
        ("048_hammer/google_16k/textured.obj", "google_16k"),
        ("Lion/meshes/model.obj", "Lion"),
        ("..strange..name...stl", "strange_name"),
        ("черпак.ply", "object"),
        ("x" * 150 + ".ply", "x" * 100),
    ],
)
def test_a_file_gives_a_name_fit_for_a_folder(path, name, tmp_path):
    from tog_drake.assets.library import checked_name

    assert name_for(tmp_path / path) == checked_name(name)
