"""Questions go out in files and answers come back, in any order and as many as there are."""

import base64
import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tog_drake.errors import InputError
from tog_drake.selectors.vlm import batch
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.batch import Export, batch_entry, custom_id, how_to_send
from tog_drake.selectors.vlm.batch_answers import import_answers, read_answers
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.client import Client
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import OpenAi, Qwen
from tog_drake.selectors.vlm.question import Message
from tog_drake.selectors.vlm.request import QuestionPending, Request, pixel_hash
from tog_drake.selectors.vlm.specification import specification

IMAGE = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(8, 6, 3)
APIS = {
    "openai": OpenAi("any", "http://127.0.0.1:9/v1", "pixels"),
    "gemini": Gemini("gemini-3.8-flash"),
    "anthropic": Anthropic("claude-sonnet-5-5"),
}


def message(text="which?"):
    return Message((text, IMAGE, "Answer with a number."), None, 100, prompt="gsi/1")


def request(text="which?", *, api=APIS["openai"], repeat=1):
    return Request.make(
        api, message(text), model=specification(api), profile="pixels", repeat=repeat
    )


def result(provider, name, text):
    """A line of a provider's results, as its documentation shows it."""
    if provider == "gemini":
        candidate = {
            "content": {"parts": [{"text": text}], "role": "model"},
            "finishReason": "STOP",
        }
        return {"key": name, "response": {"candidates": [candidate], "modelVersion": "g-1"}}
    if provider == "anthropic":
        said = {
            "content": [{"type": "text", "text": text}],
            "stop_reason": "end_turn",
            "model": "c",
        }
        return {"custom_id": name, "result": {"type": "succeeded", "message": said}}
    choice = {"index": 0, "message": {"content": text}, "finish_reason": "stop"}
    body = {"choices": [choice], "model": "o-1"}
    response = {"status_code": 200, "request_id": "r", "body": body}
    return {"id": "batch_req_1", "custom_id": name, "response": response, "error": None}


def write(path, *lines):
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return path


@pytest.fixture
def cassette(tmp_path):
    return Cassette(tmp_path / "tape.jsonl", "export")


def exported(folder, *requests):
    export = Export(folder)
    for one in requests:
        export.add(one, "Hammer, seed 0: use the hammer")
    export.finish()
    return export


@pytest.mark.parametrize("provider", APIS)
def test_a_batch_file_holds_each_question_whole_in_the_shape_of_its_provider(provider, tmp_path):
    questions = [request("a", api=APIS[provider]), request("b", api=APIS[provider], repeat=2)]
    (file,) = exported(tmp_path, *questions, questions[0]).files
    if provider == "anthropic":
        lines = json.loads(file.read_text())["requests"]
        bodies = [line["params"] for line in lines]
    else:
        assert file.suffix == ".jsonl"
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        bodies = [line["request" if provider == "gemini" else "body"] for line in lines]
    names = [line.get("custom_id") or line["key"] for line in lines]
    assert names == [custom_id(question.key) for question in questions]
    png = base64.b64decode(_find_image(bodies[0]))
    decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(decoded, IMAGE)
    assert how_to_send(questions[0])


def test_an_export_takes_away_its_own_earlier_batches_and_no_other_file(tmp_path):
    mine = ["batch-1-results.jsonl", "batch-notes.json", "batch-output.jsonl", "batch-01.json"]
    for name in (*mine, "batch-1.jsonl", "batch-2.jsonl", "batch-3.json"):
        (tmp_path / name).write_text("mine")
    exported(tmp_path, request())
    assert {path.name for path in tmp_path.glob("batch-*")} == {*mine, "batch-1.jsonl"}
    assert all((tmp_path / name).read_text() == "mine" for name in mine)


def test_an_answer_is_read_for_a_model_whose_profile_had_to_be_named(cassette, tmp_path):
    api = Qwen("my-own", "http://127.0.0.1:9/v1", "qwen3-vl")
    question = Request.make(api, message(), model=specification(api), profile="qwen3-vl")
    cassette.add_pending(question)
    file = write(tmp_path / "a.jsonl", {"custom_id": custom_id(question.key), "answer": "2"})
    imported = import_answers(cassette, read_answers(file))
    assert (imported.added, imported.problems) == (1, [])


def test_an_answer_by_hand_is_corrected_where_that_is_asked_for(cassette, tmp_path):
    cassette.add_pending(request())
    name = custom_id(request().key)
    for answer in ("1", "2"):
        file = write(tmp_path / f"{answer}.jsonl", {"custom_id": name, "answer": answer})
        imported = import_answers(cassette, read_answers(file))
    assert (imported.added, imported.replaced) == (0, 0)
    assert "another answer, which stays; --replace" in imported.problems[0]
    imported = import_answers(cassette, read_answers(file), replace_by_hand=True)
    assert (imported.added, imported.replaced, imported.problems) == (0, 1, [])
    asked = Client(
        APIS["openai"], profile="pixels", cassette=Cassette(cassette.path, "replay")
    ).ask(message(), 0.0)
    assert asked.reply.text == "2"
    file = write(tmp_path / "b.jsonl", result("openai", name, "3"))  # no person's correction
    imported = import_answers(cassette, read_answers(file), replace_by_hand=True)
    assert "which stays" in imported.problems[0]
    assert imported.replaced == 0


def test_a_batch_of_gemini_goes_without_the_schema_that_it_mishandles():
    asked = Message(("which?",), {"type": "object"}, 100)
    for api in APIS.values():
        question = Request.make(api, asked, model=specification(api), profile="pixels")
        assert ("schema" in json.dumps(batch_entry(question)).lower()) == (api.provider != "gemini")


def _find_image(value):
    """The base64 of the one image in a body, wherever it is."""
    if isinstance(value, str):
        text = value.removeprefix("data:image/png;base64,")
        return text if text.startswith("iVBOR") else None
    children = value.values() if isinstance(value, dict) else value
    children = children if isinstance(value, dict | list) else ()
    return next((found for child in children if (found := _find_image(child))), None)


def test_the_name_of_a_question_is_one_that_every_provider_takes():
    names = {custom_id(request(repeat=n).key) for n in (1, 2, 12)}
    assert len(names) == 3
    for name in names:
        assert len(name) <= 64
        assert name.replace("-", "").isalnum()


def test_a_batch_that_is_too_long_is_split(tmp_path, monkeypatch):
    monkeypatch.setattr(batch, "MAX_BATCH", 1200)
    export = exported(tmp_path, *[request(f"{n}") for n in range(5)])
    assert len(export.files) > 1
    lines = [line for file in export.files for line in file.read_text().splitlines()]
    assert len(lines) == 5
    assert all(file.stat().st_size <= 1200 for file in export.files)
    with pytest.raises(InputError, match="longer than"):
        exported(tmp_path, request("x" * 2000))


def test_an_export_takes_the_place_of_an_earlier_one(tmp_path):
    exported(tmp_path, request("a"))
    exported(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"answers.jsonl", "index.html", "images"}
    assert (tmp_path / "answers.jsonl").read_text() == ""


def test_the_page_shows_each_question_with_its_pictures_and_runs_nothing(tmp_path):
    exported(tmp_path, request('<script>alert("x")</script> \u202e \x1b[2J'))
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert "\u202e" not in page
    assert "\x1b" not in page
    assert f'src="images/{pixel_hash(IMAGE)}.png"' in page
    assert (tmp_path / "images" / f"{pixel_hash(IMAGE)}.png").is_file()
    assert "Answer with a number." in page
    assert "default-src 'none'" in page


@pytest.mark.parametrize("provider", APIS)
@pytest.mark.parametrize("by_hand", [True, False], ids=["by hand", "batch"])
def test_what_is_imported_is_what_the_client_is_told(provider, by_hand, cassette, tmp_path):
    question = request(api=APIS[provider])
    cassette.add_pending(question)
    name = custom_id(question.key)
    line = {"custom_id": name, "answer": "2 \n"} if by_hand else result(provider, name, "2")
    imported = import_answers(cassette, read_answers(write(tmp_path / "answers.jsonl", line)))
    assert (imported.added, imported.answered, imported.pending) == (1, 1, 0)
    assert imported.problems == []
    replay = Cassette(cassette.path, "replay")
    (entry,) = replay.questions
    assert entry.source == ("hand" if by_hand else "batch")
    asked = Client(APIS[provider], profile="pixels", cassette=replay).ask(message(), 0.0)
    assert asked.reply.text == "2"
    assert asked.reply.finish == "stop"
    assert (asked.reply.model == "by hand") == by_hand


@pytest.mark.parametrize(
    ("written", "said"),
    [("2", "2"), (2, "2"), ({"choice": "2"}, '{"choice": "2"}'), ([448, 336], "[448, 336]")],
)
def test_people_may_write_text_or_plain_json(written, said, cassette, tmp_path):
    cassette.add_pending(request())
    line = {"custom_id": custom_id(request().key), "answer": written}
    import_answers(cassette, read_answers(write(tmp_path / "answers.jsonl", line)))
    assert APIS["openai"].read(cassette.lookup(request()).response).text == said


def test_answers_come_in_any_order_and_some_at_a_time(cassette, tmp_path):
    questions = [request(f"{n}") for n in range(4)]
    for question in questions:
        cassette.add_pending(question)
    names = [custom_id(question.key) for question in questions]
    file = write(
        tmp_path / "answers.jsonl",
        {"custom_id": names[3], "answer": "1"},
        {"custom_id": names[0], "answer": ""},
        {"custom_id": names[0], "answer": None},
        result("openai", names[1], "2"),
    )
    first = import_answers(cassette, read_answers(file))
    assert (first.added, first.empty, first.answered, first.pending) == (2, 2, 2, 2)
    again = import_answers(cassette, read_answers(file))
    assert (again.added, again.known, again.empty, again.problems) == (0, 2, 2, [])
    file = write(tmp_path / "more.jsonl", *({"custom_id": n, "answer": "3"} for n in names[:3:2]))
    last = import_answers(cassette, read_answers(file))
    assert (last.added, last.answered, last.pending) == (2, 4, 0)


def test_what_is_wrong_with_an_answer_is_said_and_its_question_stays_pending(cassette, tmp_path):
    cassette.add_pending(request())
    name = custom_id(request().key)
    refused = result("openai", name, "")
    refused["response"] = {"status_code": 400, "body": {"error": {"message": "too \x1b[2J long"}}}
    cancelled = {"custom_id": name, "result": {"type": "expired"}}
    file = write(
        tmp_path / "answers.jsonl",
        {"custom_id": "0" * 32, "answer": "1"},
        refused,
        cancelled,
        {"custom_id": name, "response": None, "error": {"code": "x", "message": "gone"}},
        {"key": name, "error": {"code": 8, "message": "quota"}},
        {"key": name, "response": {"candidates": []}},  # not the provider that was asked
        result("openai", name, "1"),
        result("openai", name, "2"),
        result("openai", name, "1"),
    )
    imported = import_answers(cassette, read_answers(file))
    said = "\n".join(imported.problems)
    for words in (
        f"line 1: no question {'0' * 32} is in",
        "line 2: 400 too",
        "line 3: expired",
        "line 4: no answer gone",
        "line 5: no answer quota",
        "line 6: ",
        "line 8: its question has another answer, which stays",
    ):
        assert words in said
    assert "\x1b" not in said
    assert (imported.added, imported.known, len(imported.problems)) == (1, 1, 7)
    assert Cassette(cassette.path, "replay").lookup(request()).response["model"] == "o-1"


def test_a_question_that_was_asked_in_vain_takes_an_answer(cassette, tmp_path):
    from tog_drake.errors import Unanswered

    cassette.add_error(request(), Unanswered("timed_out", "late"), seconds=1)
    with pytest.raises(QuestionPending):
        cassette.lookup(request())
    line = {"custom_id": request().key, "answer": "1"}
    imported = import_answers(cassette, read_answers(write(tmp_path / "a.jsonl", line)))
    assert (imported.added, imported.pending) == (1, 0)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (b"{", "not valid JSON"),
        (b"\xff", "not valid JSON"),
        (b"[]", "names no question"),
        (b"7", "names no question"),
        (b'{"custom_id": 7, "answer": "1"}', "names no question"),
        (b'{"custom_id": "a"}', "is no answer; valid"),
        (b'{"custom_id": "a", "answer": "' + b"x" * 9_000_000 + b'"}', "is longer than"),
    ],
)
def test_a_broken_line_is_named_and_nothing_is_entered(line, problem, cassette, tmp_path):
    file = tmp_path / "answers.jsonl"
    cassette.add_pending(request())
    good = json.dumps({"custom_id": custom_id(request().key), "answer": "1"}).encode()
    file.write_bytes(good + b"\n\n" + line + b"\n")
    with pytest.raises(InputError, match=problem) as caught:
        read_answers(file)
    assert f"{file}, line 3" in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_a_file_of_answers_that_is_not_there_or_far_too_long_is_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_answers(tmp_path / "none.jsonl")
    with pytest.raises(InputError, match="cannot be read"):
        read_answers(tmp_path)
    with (tmp_path / "long.jsonl").open("wb") as file:
        file.truncate(500_000_001)
    with pytest.raises(InputError, match="longer than"):
        read_answers(tmp_path / "long.jsonl")


_JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=8,
)
_FIELDS = ("custom_id", "key", "answer", "response", "result", "error", "status")
_LINE = st.dictionaries(st.sampled_from(_FIELDS), _JSON, max_size=4).flatmap(
    lambda line: st.sampled_from([line, line | {"custom_id": custom_id(request().key)}])
)


@settings(max_examples=60)
@given(data=st.binary(max_size=200) | st.lists(_LINE, max_size=3).map(lambda x: _as_lines(x)))
def test_any_file_of_answers_is_imported_or_refused(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("answers")
    cassette = Cassette(folder / "tape.jsonl", "export")
    cassette.add_pending(request())
    (folder / "answers.jsonl").write_bytes(data)
    try:
        answers = read_answers(folder / "answers.jsonl")
    except InputError:
        return
    imported = import_answers(cassette, answers)
    counted = imported.added + imported.known + imported.empty + len(imported.problems)
    assert counted == len(answers)
    assert imported.answered + imported.pending == 1
    Cassette(cassette.path, "replay")


def _as_lines(lines):
    return "".join(json.dumps(line) + "\n" for line in lines).encode()
