"""A large file from a server that may be anything: complete and known, or not there at all."""

import hashlib
import random
import socket
import threading
from dataclasses import replace

import pytest
from asset_server import (
    AssetServer,
    chunked,
    claims,
    cut,
    cut_chunked,
    hang,
    html,
    redirect,
    status,
    trickle,
    wrong_range,
)

from tog_drake import download as downloading
from tog_drake import http_stream as stream
from tog_drake.assets.fetching import ARCHIVE
from tog_drake.download import Missing, discard, recorded_sha256
from tog_drake.errors import InputError
from tog_drake.http_stream import Unreachable

DATA = b"\x1f\x8b" + random.Random(0).randbytes(200_000)
OTHER = b"\x1f\x8b" + random.Random(1).randbytes(150_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
PATH = "/google/thing.tgz"


@pytest.fixture(autouse=True)
def _hurry(monkeypatch):
    monkeypatch.setattr(downloading, "FIRST_DELAY", 0.001)
    monkeypatch.setattr(stream, "CHUNK", 4096)


@pytest.fixture
def server():
    with AssetServer({PATH: DATA}) as running:
        yield running


@pytest.fixture
def file(tmp_path):
    return tmp_path / "downloads" / "thing.tgz"


def download(url, file, limit=ARCHIVE.limit, check=ARCHIVE.check, **options):
    """Of an archive."""
    wanted = replace(ARCHIVE, limit=limit, check=check)
    return downloading.download(url, file, wanted, **options)


def names(file):
    return sorted(path.name for path in file.parent.iterdir())


def ranges(server):
    return [asked for _, asked in server.asked]


def test_a_file_arrives_with_its_sha256_beside_it(server, file):
    told = []
    digest = download(server.url + PATH, file, progress=lambda *so_far: told.append(so_far))
    assert digest == SHA256
    assert file.read_bytes() == DATA
    assert names(file) == ["thing.tgz", "thing.tgz.sha256"]
    assert (file.parent / "thing.tgz.sha256").read_text() == f"{SHA256}  thing.tgz\n"
    assert told[-1] == (len(DATA), len(DATA))
    assert [done for done, _ in told] == sorted({done for done, _ in told})


def test_what_is_there_is_verified_and_not_asked_for_again(server, file):
    download(server.url + PATH, file)
    assert download(server.url + PATH, file) == SHA256
    assert len(server.asked) == 1


@pytest.mark.parametrize("change", [lambda data: data[:-1], lambda data: b"\0" + data[1:]])
def test_a_file_that_has_changed_on_this_machine_is_refused_until_forced(server, file, change):
    download(server.url + PATH, file)
    file.write_bytes(change(DATA))
    with pytest.raises(InputError, match=r"no longer what was downloaded.*--force"):
        download(server.url + PATH, file)
    assert download(server.url + PATH, file, force=True) == SHA256
    assert file.read_bytes() == DATA


def test_a_file_without_a_record_counts_as_none(server, file):
    file.parent.mkdir()
    file.write_bytes(b"half of it, perhaps")
    assert recorded_sha256(file) is None
    assert download(server.url + PATH, file) == SHA256
    discard(file)
    assert names(file) == []
    assert recorded_sha256(file) is None


def test_a_forced_download_that_fails_leaves_the_old_file(server, file):
    download(server.url + PATH, file)
    server.misbehave(status(404))
    with pytest.raises(Missing):
        download(server.url + PATH, file, force=True)
    assert download(server.url + PATH, file) == SHA256


def test_what_is_cut_off_goes_on_where_it_ended(server, file):
    server.misbehave(cut(100_000), cut(50_000))
    told = []
    assert download(server.url + PATH, file, progress=lambda *x: told.append(x)) == SHA256
    assert file.read_bytes() == DATA
    first, second, third = ranges(server)
    assert first is None
    starts = [int(asked.removeprefix("bytes=").removesuffix("-")) for asked in (second, third)]
    assert 90_000 < starts[0] <= 100_000 < starts[1] <= 150_000
    assert {total for _, total in told} == {len(DATA)}


def test_it_goes_on_in_the_next_run_too(server, file):
    server.misbehave(*[cut(40_000)] * downloading.ATTEMPTS)
    with pytest.raises(InputError, match=r"was cut before the end.*goes on from there"):
        download(server.url + PATH, file)
    assert not file.exists()
    begun = (file.parent / "thing.tgz.part").stat().st_size
    assert begun > 150_000
    assert download(server.url + PATH, file) == SHA256
    assert ranges(server)[-1] == f"bytes={begun}-"


@pytest.mark.parametrize("kind", [{"tags": False}, {"ranges": False}])
def test_where_nothing_can_go_on_it_begins_again(file, kind):
    with AssetServer({PATH: DATA}, **kind) as server:
        server.misbehave(cut(100_000))
        assert download(server.url + PATH, file) == SHA256
        assert len(server.asked) == 2


def test_the_rest_of_another_file_is_never_put_to_the_beginning_of_this_one(server, file):
    server.misbehave(*[cut(30_000)] * downloading.ATTEMPTS)
    with pytest.raises(InputError):
        download(server.url + PATH, file)
    server.files[PATH] = OTHER
    download(server.url + PATH, file)
    assert file.read_bytes() == OTHER


def test_nor_that_of_another_server(server, file):
    server.misbehave(*[cut(30_000)] * downloading.ATTEMPTS)
    with pytest.raises(InputError):
        download(server.url + PATH, file)
    with AssetServer({PATH: OTHER}) as mirror:
        download(mirror.url + PATH, file)
        assert ranges(mirror) == [None]
    assert file.read_bytes() == OTHER


def test_a_rest_that_ends_early_goes_on(server, file):
    def part_of_the_rest(handler):
        begun = int(handler.headers["Range"].removeprefix("bytes=").removesuffix("-"))
        told = {"Content-Range": f"bytes {begun}-{len(DATA) - 1}/{len(DATA)}"}
        handler.answer(206, DATA[begun : begun + 1000], told)

    server.misbehave(cut(100_000), part_of_the_rest)
    assert download(server.url + PATH, file) == SHA256
    assert len(server.asked) == 3


@pytest.mark.parametrize("answer", [wrong_range, status(416)])
def test_a_wrong_rest_begins_again(server, file, answer):
    server.misbehave(cut(100_000), answer)
    assert download(server.url + PATH, file) == SHA256
    assert ranges(server)[2] is None


def test_a_part_that_somebody_damaged_begins_again(server, file):
    server.misbehave(*[cut(30_000)] * downloading.ATTEMPTS)
    with pytest.raises(InputError):
        download(server.url + PATH, file)
    note = file.parent / "thing.tgz.part.json"
    for content in ("", "[]", "{", "{}", '{"url": 3, "validator": 4}', "[" * 100_000):
        note.write_text(content)
        server.misbehave(*[cut(30_000)] * downloading.ATTEMPTS)
        with pytest.raises(InputError):
            download(server.url + PATH, file)
    note.unlink()
    assert download(server.url + PATH, file) == SHA256


@pytest.mark.parametrize("mishap", [cut_chunked, claims(len(DATA) + 1000)])
def test_less_than_was_announced_is_a_failure_however_it_was_announced(server, file, mishap):
    server.misbehave(*[mishap] * downloading.ATTEMPTS)
    with pytest.raises(InputError, match=r"cut|begins|arrived"):
        download(server.url + PATH, file)
    assert not file.exists()


def test_a_length_that_is_not_told_or_no_number_is_done_without(server, file):
    for mishap in (claims(None), claims("many"), chunked):
        server.misbehave(mishap)
        assert download(server.url + PATH, file, force=True) == SHA256


@pytest.mark.parametrize("code", [408, 429, 500, 502, 503, 504])
def test_an_overloaded_server_is_asked_again(server, file, code):
    server.misbehave(status(code), status(code))
    assert download(server.url + PATH, file) == SHA256
    server.misbehave(*[status(code)] * downloading.ATTEMPTS)
    with pytest.raises(InputError, match=f"status {code}"):
        download(server.url + PATH, file, force=True)
    assert len(server.asked) == 3 + downloading.ATTEMPTS


def test_a_server_that_asks_to_be_left_alone_is(server, file, monkeypatch):
    waited = []
    monkeypatch.setattr(downloading.time, "sleep", waited.append)
    server.misbehave(status(429, {"Retry-After": "7"}), status(503, {"Retry-After": "soon"}))
    download(server.url + PATH, file)
    assert waited == [7.0, downloading.FIRST_DELAY * 2]
    server.misbehave(status(429, {"Retry-After": "86400"}))
    with pytest.raises(InputError, match="left alone for 86400 s"):
        download(server.url + PATH, file, force=True)
    assert waited == [7.0, downloading.FIRST_DELAY * 2]


@pytest.mark.parametrize("code", [403, 404, 410])
def test_what_is_not_there_is_missing_at_once(server, file, code):
    server.misbehave(status(code))
    with pytest.raises(Missing, match=rf"/google/thing\.tgz.*status {code}.*no such file"):
        download(server.url + PATH, file)
    assert len(server.asked) == 1
    assert names(file) == []


def test_a_page_in_place_of_an_archive_is_refused_and_quoted(server, file):
    server.misbehave(html)
    with pytest.raises(InputError, match=r"else than an archive.*Welcome to our hotel.*login"):
        download(server.url + PATH, file)
    assert names(file) == []


def test_a_file_that_does_not_pass_the_check_is_not_kept_and_does_not_replace_another(server, file):
    def none(part):
        assert part.read_bytes() == DATA
        raise InputError("not this one")

    for _ in range(2):
        with pytest.raises(InputError, match="not this one"):
            download(server.url + PATH, file, check=none)
        assert names(file) == []
    download(server.url + PATH, file)
    with pytest.raises(InputError, match="not this one"):
        download(server.url + PATH, file, check=none, force=True)
    assert download(server.url + PATH, file) == SHA256


@pytest.mark.parametrize("mishap", [None, chunked, claims(None)])
def test_too_large_is_refused_whether_announced_or_not(server, file, mishap):
    server.misbehave(mishap)
    told = []
    with pytest.raises(InputError, match="more than 50000 bytes"):
        download(server.url + PATH, file, limit=50_000, progress=lambda *x: told.append(x))
    assert names(file) == []
    assert all(done <= 50_000 for done, _ in told)
    if mishap is None:  # announced: nothing of it is taken
        assert told == []


@pytest.mark.parametrize("mishap", [hang, trickle])
def test_a_server_that_is_too_slow_is_given_up(server, file, monkeypatch, mishap):
    server.misbehave(mishap, mishap)
    with monkeypatch.context() as patch:
        patch.setattr(stream, "PATIENCE", 0.15)
        patch.setattr(downloading, "ATTEMPTS", 2)
        with pytest.raises(InputError, match=r"127\.0\.0\.1:\d+ is too slow"):
            download(server.url + PATH, file)
    assert download(server.url + PATH, file) == SHA256


def test_a_redirect_on_this_machine_is_followed(server, file):
    server.files["/elsewhere"] = server.files.pop(PATH)
    server.misbehave(redirect("/elsewhere"))
    assert download(server.url + PATH, file) == SHA256
    assert [path for path, _ in server.asked] == [PATH, "/elsewhere"]


@pytest.mark.parametrize(
    "location",
    ["http://example.com/x", "ftp://127.0.0.1/x", "file:///etc/passwd", "http://["],
)
def test_a_redirect_to_where_others_could_meddle_is_not(server, file, location):
    server.misbehave(redirect(location))
    with pytest.raises(InputError, match="only https is followed"):
        download(server.url + PATH, file)


def test_the_body_of_a_redirect_is_not_read(server, file, monkeypatch):
    monkeypatch.setattr(stream, "PATIENCE", 3.0)
    server.files["/elsewhere"] = DATA

    def endless(handler):
        handler.head(302, 10**12, {"Location": "/elsewhere"})
        handler.server.assets.closing.wait(20)

    server.misbehave(endless)
    assert download(server.url + PATH, file) == SHA256
    assert [path for path, _ in server.asked] == [PATH, "/elsewhere"]


def test_a_redirect_without_end_is_left(server, file):
    server.misbehave(*[redirect(PATH)] * 20)
    with pytest.raises(InputError, match="redirects more than 5 times"):
        download(server.url + PATH, file)


def test_without_a_network_it_says_where_nobody_answers(file):
    with socket.socket() as taken:  # a port where nobody answers
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(Unreachable) as refused:
            download(f"http://127.0.0.1:{port}{PATH}", file)
    assert f"http://127.0.0.1:{port}{PATH}" in str(refused.value)
    assert names(file) == []


def test_a_bad_url_is_wrong_input(file):
    for url in ("http://", "nonsense", "foo://127.0.0.1/x", "http://127.0.0.1:99999/x"):
        with pytest.raises(InputError):
            download(url, file)


def test_two_at_once_ask_once(server, file):
    digests = []
    threads = [
        threading.Thread(target=lambda: digests.append(download(server.url + PATH, file)))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert digests == [SHA256] * 3
    assert len(server.asked) == 1
