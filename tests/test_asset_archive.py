"""What an archive from elsewhere may not do: it lands in its folder, or is refused."""

import gzip
import io
import random
import stat
import struct
import tarfile
import zipfile

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tog_drake.assets.archive import Limits, extract
from tog_drake.errors import InputError

FILES = {"thing/mesh.obj": b"v 0 0 0\n" * 1000, "thing/look/skin.png": b"\x89PNG", "empty": b""}


def tgz(*entries, **kinds):
    """A .tgz of (name, bytes), or of ready TarInfos."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz", **kinds) as tar:
        for entry in entries:
            if isinstance(entry, tarfile.TarInfo):
                tar.addfile(entry)
                continue
            member = tarfile.TarInfo(entry[0])
            member.size = len(entry[1])
            tar.addfile(member, io.BytesIO(entry[1]))
    return packed.getvalue()


def zipped(*entries):
    """A .zip of (name or ZipInfo, bytes)."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return packed.getvalue()


def special(kind, name="x", link=""):
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, link
    return member


def zip_link():
    member = zipfile.ZipInfo("x")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    return member


def unpacked(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture
def room(tmp_path):
    """A folder with an empty one in it: what leaves the inner one shows."""
    inner = tmp_path / "room"
    inner.mkdir()
    return inner


def attempt(room, data, **limits):
    archive = room.parent / "thing.archive"
    archive.write_bytes(data)
    try:
        extract(archive, room / "out", Limits(**limits))
    finally:
        assert sorted(p.name for p in room.parent.iterdir()) == ["room", "thing.archive"]
        assert [p.name for p in room.iterdir()] in (["out"], [])
    return unpacked(room / "out")


@pytest.mark.parametrize("packed", [tgz, zipped])
def test_files_and_folders_come_out_as_they_went_in(room, packed):
    assert attempt(room, packed(*FILES.items())) == FILES


def test_long_names_of_every_dialect_of_tar_are_read(room):
    name = "/".join(["folder" * 10] * 4) + "/mesh.obj"
    for i, dialect in enumerate((tarfile.GNU_FORMAT, tarfile.PAX_FORMAT)):
        archive = room.parent / "long.tgz"
        archive.write_bytes(tgz((name, b"long"), format=dialect))
        extract(archive, room / str(i))
        assert unpacked(room / str(i)) == {name: b"long"}


def test_the_root_itself_and_folders_named_again_are_no_harm(room):
    folder = special(tarfile.DIRTYPE, "./")
    again = special(tarfile.DIRTYPE, "a/")
    assert attempt(room, tgz(folder, again, ("./a/b", b"1"), again)) == {"a/b": b"1"}


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("/etc/passwd", "not relative"),
        ("../out", "leads out"),
        ("a/../../out", "leads out"),
        ("a/..", "leads out"),
        ("..\\out", "not relative"),
        ("C:out", "not relative"),
        ("a\x1b[2J", "control characters"),
        ("a\nb", "control characters"),
        ("b" * 201, "too long"),
        ("/".join("c" * 20), "too long"),
        ("ä" * 110, "too long"),
    ],
)
@pytest.mark.parametrize("packed", [tgz, zipped])
def test_a_name_that_is_not_plain_is_refused(room, packed, name, complaint):
    with pytest.raises(InputError, match=complaint) as refused:
        attempt(room, packed(("good", b"1"), (name, b"2")))
    assert "\x1b" not in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_name_with_a_nul_is_refused(room):
    hidden = zipped(("a.obj0../../x", b"1")).replace(b"a.obj0", b"a.obj\0")
    with pytest.raises(InputError, match=r"control characters|leads out"):
        attempt(room, hidden)
    member = tarfile.TarInfo("x")
    member.pax_headers = {"path": "a.obj\0b"}
    with pytest.raises(InputError, match="control characters"):
        attempt(room, tgz(member, format=tarfile.PAX_FORMAT))


def test_a_tar_whose_name_is_no_text_is_refused(room):
    data = gzip.compress(gzip.decompress(tgz(("aXb", b""))).replace(b"aXb", b"a\xffb"))
    with pytest.raises(InputError, match=r"damaged|broken"):
        attempt(room, data)


@pytest.mark.parametrize(
    "entry",
    [
        special(tarfile.SYMTYPE, link="/etc"),
        special(tarfile.SYMTYPE, link="mesh.obj"),
        special(tarfile.LNKTYPE, link="mesh.obj"),
        special(tarfile.CHRTYPE),
        special(tarfile.BLKTYPE),
        special(tarfile.FIFOTYPE),
        special(b"Z"),
    ],
)
def test_links_and_devices_are_refused(room, entry):
    with pytest.raises(InputError, match="link, a device"):
        attempt(room, tgz(("mesh.obj", b"1"), entry, ("x/file", b"2")))


def test_a_link_in_a_zip_is_refused(room):
    with pytest.raises(InputError, match="link, a device"):
        attempt(room, zipped(("mesh.obj", b"1"), (zip_link(), b"/etc")))


@pytest.mark.parametrize(
    "names", [("a", "a"), ("a", "./a"), ("A", "a"), ("a", "a/b"), ("a/b", "a"), ("é", "e\u0301")]
)
@pytest.mark.parametrize("packed", [tgz, zipped])
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_files_under_one_name_are_refused(room, packed, names):
    with pytest.raises(InputError, match="twice"):
        attempt(room, packed(*((name, b"1") for name in names)))


@pytest.mark.parametrize("packed", [tgz, zipped])
def test_a_bomb_is_refused_by_its_ratio_and_by_its_size(room, packed):
    bomb = packed(*((f"z{i}", bytes(3_000_000)) for i in range(4)))
    assert len(bomb) < 50_000
    with pytest.raises(InputError, match="bomb"):
        attempt(room, bomb)
    with pytest.raises(InputError, match="bomb"):
        attempt(room, packed(("z", bytes(3000))), total=2999)
    assert attempt(room, packed(("z", bytes(3000))), total=3000) == {"z": bytes(3000)}


@pytest.mark.parametrize("packed", [tgz, zipped])
def test_too_many_files_are_refused(room, packed):
    with pytest.raises(InputError, match="more than 10 files"):
        attempt(room, packed(*((str(i), b"") for i in range(11))), files=10)


def test_what_hides_in_a_folder_s_size_or_behind_the_end_counts_too(room):
    folder = special(tarfile.DIRTYPE, "a")
    folder.size = 12_000_000
    whole = gzip.compress(folder.tobuf() + bytes(13_000_000))
    with pytest.raises(InputError, match="bomb"):
        attempt(room, whole)
    with pytest.raises(InputError, match="bomb"):
        attempt(room, gzip.compress(gzip.decompress(tgz(("a", b"1"))) + bytes(12_000_000)))


def test_a_file_whose_size_is_below_nothing_is_refused(room):
    member = tarfile.TarInfo("a")
    member.size = -512  # its end would be its beginning: readers have gone round for ever
    first = tarfile.TarInfo("first").tobuf()
    with pytest.raises(InputError, match="overlap"):
        attempt(room, gzip.compress(first + member.tobuf(tarfile.GNU_FORMAT) + bytes(1024)))


def test_the_holes_of_a_sparse_file_count(room):
    member = tarfile.TarInfo("a")
    member.pax_headers = {"GNU.sparse.map": "0,0", "GNU.sparse.size": str(10**12)}
    with pytest.raises(InputError, match="bomb"):
        attempt(room, tgz(member, format=tarfile.PAX_FORMAT))


def test_a_header_that_claims_gigabytes_is_not_read_into_memory(room):
    header = special(tarfile.XHDTYPE, "x")
    header.size = 4 * 2**30
    data = gzip.compress(header.tobuf(tarfile.GNU_FORMAT) + bytes(2_000_000))
    with pytest.raises(InputError, match="longer than any"):
        attempt(room, data)


def test_a_zip_with_a_directory_of_megabytes_is_refused(room):
    data = zipped(*((f"{i:0200}", b"") for i in range(6000)))
    with pytest.raises(InputError, match="longer than any"):
        attempt(room, data)


def test_an_encrypted_zip_and_a_rare_way_of_packing_are_refused(room):
    data = bytearray(zipped(("a", b"1")))
    at = data.index(b"PK\x01\x02")
    encrypted = bytearray(data)
    encrypted[at + 8] |= 1
    with pytest.raises(InputError, match="encrypted"):
        attempt(room, bytes(encrypted))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("a", b"1")
    with pytest.raises(InputError, match="packed in a way"):
        attempt(room, packed.getvalue())


@pytest.mark.parametrize("packed", [tgz, zipped])
def test_a_damaged_archive_leaves_nothing_behind(room, packed):
    data = packed(*FILES.items(), ("noise", random.Random(0).randbytes(20_000)))
    with pytest.raises(InputError, match=r"damaged|not unpacked"):
        attempt(room, data[: len(data) // 2])
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 0xFF
    with pytest.raises(InputError, match=r"damaged|not unpacked"):
        attempt(room, bytes(flipped))


def test_the_checksum_at_the_very_end_is_looked_at(room):
    data = tgz(*FILES.items())
    wrong = data[:-8] + struct.pack("<I", 1) + data[-4:]
    with pytest.raises(InputError, match="damaged"):
        attempt(room, wrong)


@pytest.mark.parametrize("data", [b"", b"PK", b"<!DOCTYPE html><html>", b"BZh91AY&SY"])
def test_what_is_no_archive_is_said_to_be_none(room, data):
    with pytest.raises(InputError, match=r"neither a \.tgz nor a \.zip"):
        attempt(room, data)


def test_a_folder_that_is_there_is_not_written_over(room):
    (room / "out").mkdir()
    archive = room.parent / "thing.archive"
    archive.write_bytes(tgz(("a", b"1")))
    with pytest.raises(FileExistsError):
        extract(archive, room / "out")
    assert list((room / "out").iterdir()) == []


NAMES = st.text(st.sampled_from("ab./\\:é\n"), min_size=1, max_size=12)
KINDS = st.sampled_from([b"0", b"5", b"1", b"2", b"3", b"6", b"7", b"x", b"L", b"S"])


@st.composite
def tars(draw):
    """Headers with any names, links and sizes, whose checksums are right, and any bytes between."""
    blocks = b""
    for _ in range(draw(st.integers(0, 4))):
        member = special(draw(KINDS), draw(NAMES), draw(NAMES))
        content = draw(st.binary(max_size=40))
        member.size = draw(st.sampled_from([0, 1, len(content), 512, 10**9, 8**11]))
        blocks += member.tobuf(tarfile.GNU_FORMAT) + content.ljust(512, b"\0")
    return gzip.compress(blocks + draw(st.sampled_from([b"", bytes(1024), b"x" * 600])), mtime=0)


@st.composite
def zips(draw):
    data = bytearray(zipped(*draw(st.lists(st.tuples(NAMES, st.binary(max_size=40)), max_size=4))))
    for _ in range(draw(st.integers(0, 3))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(data)


# Its directory lies before its beginning.
BEFORE = b"PK\x03\x04PK\x01\x02".ljust(50, b"\0") + b"PK\x05\x06".ljust(12, b"\0")
BEFORE += b"\x2f\0\0\0\0\0\0\x01\0\0"

ANY = st.one_of(
    st.binary(max_size=200),
    st.binary(max_size=200).map(lambda data: b"PK\x03\x04" + data),
    st.binary(max_size=200).map(lambda data: b"\x1f\x8b\x08\x00" + data),
    st.binary(max_size=1200).map(gzip.compress),
    tars(),
    zips(),
)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(data=BEFORE)
@given(data=ANY)
def test_any_bytes_land_in_their_folder_or_are_refused(tmp_path_factory, data):
    room = tmp_path_factory.mktemp("any") / "room"
    room.mkdir()
    try:
        attempt(room, data)
    except InputError:
        assert list(room.iterdir()) == []
        return
    out = room / "out"
    for path in out.rglob("*"):
        assert not path.is_symlink()
        assert path.is_file() or path.is_dir()
        assert path.resolve().is_relative_to(out.resolve())
