"""A cassette: what was asked once is answered again, exactly, and nothing secret is in it."""

import json
import logging
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError, Unanswered
from tog_drake.selectors.vlm.cassette import Cassette, NotRecorded
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.question import Message
from tog_drake.selectors.vlm.recorded import MAX_LINE, Recorded, read_entry
from tog_drake.selectors.vlm.request import (
    QuestionPending,
    Request,
    pixel_hash,
    question_key,
    read_image,
)

IMAGE = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)


@dataclass(frozen=True)
class Plain:
    """A provider whose bodies are easily read."""

    model: str = "any"
    base_url: str = "http://127.0.0.1:9/v1"
    provider: str = "openai"
    max_tokens: int = 4096
    effort: str | None = None

    def path(self):
        return "/v1/chat/completions"

    def body(self, message, encode):
        content = [part if isinstance(part, str) else encode(part) for part in message.parts]
        return {"model": self.model, "messages": content}


def request(text="which?", *, image=IMAGE, repeat=1, api=None, server="here"):
    message = Message((image, text), None, 100, prompt="gsi/1")
    return Request.make(
        api or Plain(),
        message,
        model=f"openai:any@http://{server}/v1",
        profile="pixels",
        repeat=repeat,
    )


def said(text):
    return {"choices": [{"message": {"content": text}}]}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "tape.jsonl"


def test_what_was_recorded_is_replayed(path):
    Cassette(path, "record").add(request(), said("2"), seconds=1.25)
    found = Cassette(path, "replay").lookup(request())
    assert (found.response, found.seconds, found.prompt) == (said("2"), 1.25, "gsi/1")
    model = OpenAi("any", "http://here/v1", "pixels")
    assert Cassette(path, "replay").model() == model


def test_the_model_of_a_cassette_has_the_settings_on_which_its_keys_depend(path):
    asked = OpenAi("any", "http://here/v1", "pixels", max_tokens=777, effort="low")
    Cassette(path, "record").add(request(api=asked), said("2"), seconds=0)
    model = Cassette(path, "replay").model()
    assert model == asked
    assert Cassette(path, "replay").lookup(request(api=model)).response == said("2")


def test_the_answer_of_one_server_is_not_recorded_as_that_of_another(path):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    with pytest.raises(InputError, match=r"http://here/v1 .*http://there/v1") as caught:
        Cassette(path, "record").lookup(request(server="there"))
    assert "--record" in str(caught.value)
    assert Cassette(path, "replay").lookup(request(server="there")).response == said("2")


def test_a_miss_names_another_opencv_where_it_drew_the_images(path, monkeypatch):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    with pytest.raises(NotRecorded) as caught:
        Cassette(path, "replay").lookup(request("another"))
    assert "OpenCV" not in str(caught.value)
    was = cv2.__version__
    monkeypatch.setattr(cv2, "__version__", "99.1.0")
    with pytest.raises(NotRecorded, match=f"OpenCV {was}; here is 99.1.0"):
        Cassette(path, "replay").lookup(request("another"))


def test_an_answer_by_hand_can_be_corrected_by_hand_alone(path):
    cassette = Cassette(path, "export")
    cassette.add_pending(request())
    (entry,) = cassette.questions
    for text, source, stays in [("1", "hand", "1"), ("9", "batch", "1"), ("2", "hand", "2")]:
        cassette.enter(replace(entry, response=said(text), source=source))
        assert Cassette(path, "replay").lookup(request()).response == said(stays)


def test_a_line_has_the_shape_of_a_batch_file_and_no_image_in_it(path):
    Cassette(path, "record").add(request(), said("2"), seconds=0.5)
    (line,) = [json.loads(line) for line in path.read_text().splitlines()]
    assert line["custom_id"] == request().key
    assert (line["method"], line["url"]) == ("POST", "/v1/chat/completions")
    assert line["body"]["messages"] == [f"sha256:{pixel_hash(IMAGE)}", "which?"]
    assert line["response"] == {"status_code": 200, "body": said("2")}


def test_a_question_that_is_known_is_not_asked_again(path):
    cassette = Cassette(path, "record")
    assert cassette.lookup(request()) is None
    cassette.add(request(), said("2"), seconds=0)
    assert cassette.lookup(request()).response == said("2")
    assert cassette.lookup(request("which now?")) is None
    assert cassette.lookup(request(repeat=2)) is None


def test_replaying_what_was_never_asked_says_key_prompt_file_and_what_to_do(path):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    with pytest.raises(NotRecorded) as caught:
        Cassette(path, "replay").lookup(request("another"))
    for word in (request("another").key, "gsi/1", str(path), "--record"):
        assert word in str(caught.value)
    assert isinstance(caught.value, InputError)


def test_a_missing_cassette_cannot_be_replayed_but_can_be_begun(path):
    with pytest.raises(InputError, match="--record"):
        Cassette(path, "replay")
    assert Cassette(path, "record").questions == ()


def test_what_was_asked_in_vain_is_asked_again_but_replayed_as_it_was(path):
    Cassette(path, "record").add_error(request(), Unanswered("timed_out", "after 3 s"), seconds=3)
    assert Cassette(path, "record").lookup(request()) is None
    with pytest.raises(Unanswered, match="after 3 s") as caught:
        Cassette(path, "replay").lookup(request())
    assert caught.value.status == "timed_out"
    Cassette(path, "record").add(request(), said("1"), seconds=1)
    assert Cassette(path, "replay").lookup(request()).response == said("1")


def test_a_response_is_final_whoever_comes_later(path):
    slow, fast = Cassette(path, "record"), Cassette(path, "record")
    fast.add(request(), said("fast"), seconds=0)
    assert slow.add(request(), said("slow"), seconds=0).response == said("fast")
    slow.add_error(request(), Unanswered("timed_out", ""), seconds=0)
    slow.add_pending(request())
    assert Cassette(path, "replay").lookup(request()).response == said("fast")
    assert len(path.read_text().splitlines()) == 1


def test_in_export_an_unanswered_question_is_raised_with_all_that_sends_it(path):
    cassette = Cassette(path, "export")
    with pytest.raises(QuestionPending) as caught:
        cassette.lookup(request())
    (pending,) = caught.value.requests
    assert pending == request() or pending.key == request().key
    cassette.add_pending(pending)
    (entry,) = Cassette(path, "export").questions
    assert entry.pending
    with pytest.raises(NotRecorded, match="tog vlm import"):
        Cassette(path, "replay").lookup(request())
    cassette.enter(replace(entry, response=said("3"), source="hand"))
    assert Cassette(path, "export").lookup(request()).response == said("3")


def test_two_models_in_one_cassette_must_be_told_apart(path):
    cassette = Cassette(path, "record")
    with pytest.raises(InputError, match=r"is empty.*--record"):
        cassette.model()
    cassette.add(request(), said("2"), seconds=0)
    cassette.add(replace(request("b"), model="gemini:x"), said("2"), seconds=0)
    with pytest.raises(InputError, match=r"2 models: gemini:x .*--vlm"):
        cassette.model()


def test_the_key_is_of_what_is_asked_not_of_where_or_in_which_order():
    assert request().key == request(api=Plain(base_url="http://127.0.0.1:7/v1")).key
    assert question_key("a", "/b", {"x": 1, "y": 2}) == question_key("a", "/b", {"y": 2, "x": 1})
    keys = {
        request().key,
        request("else").key,
        request(image=IMAGE + 1).key,
        request(api=Plain(model="other")).key,
        request(api=Plain(provider="other")).key,
        request(repeat=2).key,
    }
    assert len(keys) == 6
    assert request(repeat=2).key == f"{request().key}#2"


def test_the_hash_of_an_image_is_of_its_pixels_and_its_shape():
    assert pixel_hash(IMAGE) == pixel_hash(np.asfortranarray(IMAGE))
    assert pixel_hash(IMAGE) != pixel_hash(IMAGE.reshape(6, 4, 3))


def test_images_are_stored_once_and_checked_when_they_are_read(path):
    cassette = Cassette(path, "record")
    cassette.add(request(), said("2"), seconds=0)
    cassette.add(request("else"), said("2"), seconds=0)
    digest = pixel_hash(IMAGE)
    (file,) = cassette.image_folder.iterdir()
    assert file.name == f"{digest}.png"
    assert file.parent.name == "tape.images"
    np.testing.assert_array_equal(read_image(file.parent, digest), IMAGE)
    (file.parent / f"{'0' * 64}.png").write_bytes(file.read_bytes())
    with pytest.raises(InputError, match="pixels were changed"):
        read_image(file.parent, "0" * 64)
    with pytest.raises(InputError, match="cannot be read"):
        read_image(file.parent, "1" * 64)
    bomb = bytearray(file.read_bytes())
    bomb[16:24] = (60000).to_bytes(4, "big") * 2
    file.write_bytes(bomb)
    with pytest.raises(InputError, match="larger"):
        read_image(file.parent, digest)
    cassette.add(request("once more"), said("2"), seconds=0)
    np.testing.assert_array_equal(read_image(file.parent, digest), IMAGE)


@given(data=st.binary(max_size=200))
def test_no_file_of_an_image_raises_anything_but_an_input_error(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    (folder / "00.png").write_bytes(data)
    with pytest.raises(InputError):
        read_image(folder, "00")


def test_a_line_that_a_killed_process_left_is_left_out_and_said(path, caplog):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:-20])
    with caplog.at_level(logging.WARNING):
        cassette = Cassette(path, "record")
        Cassette(path, "replay")  # as where options are tried before the run
    assert caplog.text.count("line 2 is torn") == 1
    assert cassette.lookup(request()).response == said("2")
    cassette.add(request("next"), said("3"), seconds=0)
    assert len(Cassette(path, "replay").questions) == 2
    assert len(path.read_bytes().splitlines()) == 2


def test_a_miss_says_what_the_cassette_holds(path):
    path.write_text("")
    with pytest.raises(NotRecorded, match=r"is empty.*--record"):
        Cassette(path, "replay").lookup(request())
    cassette = Cassette(path, "record")
    for n in range(6):
        cassette.enter(replace(Recorded.of(request(f"first {n}")), model=f"openai:m{n}"))
    with pytest.raises(NotRecorded) as miss:
        Cassette(path, "replay").lookup(request("second"))
    held = "It holds gsi/1 of openai:m0, gsi/1 of openai:m1, gsi/1 of openai:m2, gsi/1 of openai:m3"
    assert f"{held} and 2 more" in str(miss.value)


def test_a_whole_line_without_its_newline_is_kept(path, caplog):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    path.write_bytes(path.read_bytes().rstrip())
    cassette = Cassette(path, "record")
    cassette.add(request("next"), said("3"), seconds=0)
    assert cassette.lookup(request()).response == said("2")
    assert [entry.response for entry in Cassette(path, "replay").questions] == [
        said("2"),
        said("3"),
    ]
    assert not caplog.records


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda line: b"{", "line 2 is not valid JSON"),
        (lambda line: b"\xff\xfe", "line 2 is not valid JSON"),
        (lambda line: b"[" * 100_000, "line 2 is not valid JSON"),
        (lambda line: b"NaN", "line 2 is not valid JSON"),
        (lambda line: b"[]", "line 2 is no line of a cassette"),
        (lambda line: line.replace(b'"openai:any', b'7, "x": "'), "model, profile or prompt"),
        (lambda line: line.replace(b'"custom_id": "', b'"custom_id": "../'), "custom_id"),
        (lambda line: line.replace(b": 200", b": 500"), "status 200"),
        (lambda line: line.replace(b'"asked"', b'"dreamt"'), "source"),
        (lambda line: line.replace(b'"seconds": 0', b'"seconds": -1'), "seconds"),
        (lambda line: line.replace(b'"seconds": 0', b'"seconds": 1e999'), "seconds"),
    ],
)
def test_any_other_broken_line_is_named(path, change, problem):
    Cassette(path, "record").add(request(), said("2"), seconds=0)
    line = path.read_bytes().rstrip()
    assert change(line) != line
    path.write_bytes(line + b"\n" + change(line) + b"\n" + line + b"\n")
    with pytest.raises(InputError, match=problem) as caught:
        Cassette(path, "replay")
    assert f"{path}, line 2" in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_a_line_without_an_end_is_not_read_into_memory(path):
    with path.open("wb") as file:
        file.truncate(2 * MAX_LINE)
    with pytest.raises(InputError, match="longer than"):
        Cassette(path, "replay")


def test_a_file_that_is_far_too_long_is_refused(path):
    with path.open("wb") as file:
        file.truncate(1_000_000_001)
    with pytest.raises(InputError, match="longer than"):
        Cassette(path, "replay")


def test_a_folder_is_no_cassette(tmp_path):
    with pytest.raises(InputError):
        Cassette(tmp_path, "replay")
    with pytest.raises(InputError):
        Cassette(tmp_path, "record")


@given(data=st.binary(max_size=300))
def test_no_bytes_raise_anything_but_an_input_error(data):
    try:
        read_entry(data, "here")
    except InputError as error:
        assert str(error).startswith("here ")


_JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)


@given(field=st.sampled_from(["custom_id", "url", "body", "response", "error", "tog"]), value=_JSON)
def test_no_value_of_a_field_raises_anything_but_an_input_error(field, value):
    line = {
        "custom_id": "0" * 64,
        "url": "/x",
        "body": {},
        "response": None,
        "error": None,
        "tog": {
            "model": "",
            "profile": "",
            "max_tokens": 1,
            "effort": None,
            "prompt": "",
            "source": "hand",
            "seconds": 0,
            "opencv": "4.10.0",
        },
    }
    read_entry(json.dumps(line).encode(), "here")
    try:
        read_entry(json.dumps(line | {field: value}).encode(), "here")
    except InputError as error:
        assert str(error).startswith("here ")


@settings(max_examples=60)
@given(
    data=st.binary(max_size=60),
    start=st.integers(0, 900),
    cut=st.integers(0, 40),
    mode=st.sampled_from(["record", "replay", "export"]),
)
def test_a_cassette_with_anything_in_it_is_read_or_refused(
    data, start, cut, mode, tmp_path_factory
):
    path = tmp_path_factory.mktemp("broken") / "tape.jsonl"
    writer = Cassette(path, "record")
    writer.add(request(), said("2"), seconds=0)
    writer.add(request("else"), said("1"), seconds=0)
    whole = path.read_bytes()
    path.write_bytes(whole[:start] + data + whole[start + cut :])
    try:
        cassette = Cassette(path, mode)
        if mode == "record":
            cassette.add(request("more"), said("3"), seconds=0)
            assert Cassette(path, "replay").lookup(request("more")).response == said("3")
    except InputError as error:
        assert str(path) in str(error)


def _record(path, worker):
    cassette = Cassette(path, "record")
    for n in range(8):
        cassette.add(request(f"shared {n}"), said(f"of {worker} {'x' * 5000}"), seconds=0)
        cassette.add(request(f"own {worker} {n}"), said("mine"), seconds=0)


def test_several_processes_share_a_cassette(path):
    with ProcessPoolExecutor(2, get_context("fork")) as pool:
        list(pool.map(_record, [path] * 2, range(2)))
    lines = path.read_bytes().splitlines()
    keys = [json.loads(line)["custom_id"] for line in lines]
    assert len(keys) == len(set(keys)) == 8 + 2 * 8
    assert len(Cassette(path, "replay").questions) == 8 + 2 * 8


def test_nothing_is_left_where_the_disk_is_full(path, monkeypatch):
    cassette = Cassette(path, "record")
    cassette.add(request(), said("2"), seconds=0)
    write = os.write

    def full(file, data):
        write(file, bytes(data)[:30])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"):
        cassette.add(request("more"), said("3"), seconds=0)
    monkeypatch.undo()
    cassette.add(request("more"), said("3"), seconds=0)
    assert len(Cassette(path, "replay").questions) == 2
