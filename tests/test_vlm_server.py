"""The server of the tests refuses what the providers refuse: a test that passes on it says much."""

import base64

import numpy as np
import pytest
import requests
from vlm_server import KEY, VlmServer, status

from tog_drake.drawing import encode_png

PNG = base64.b64encode(encode_png(np.zeros((2, 3, 3), np.uint8))).decode()
URL = f"data:image/png;base64,{PNG}"
GOOD = {
    "openai": (
        "/v1/chat/completions",
        {"Authorization": f"Bearer {KEY}"},
        {"model": "any", "messages": [{"role": "user", "content": "Which?"}]},
    ),
    "gemini": (
        "/v1beta/models/any:generateContent",
        {"x-goog-api-key": KEY},
        {"contents": [{"parts": [{"text": "Which?"}]}]},
    ),
    "anthropic": (
        "/v1/messages",
        {"x-api-key": KEY, "anthropic-version": "2023-06-01"},
        {"model": "any", "max_tokens": 9, "messages": [{"role": "user", "content": "Which?"}]},
    ),
}


def post(server, provider, changes=None, headers=None, data=None):
    path, known, body = GOOD[provider]
    with requests.Session() as session:
        session.trust_env = False
        return session.post(
            server.url + path,
            json=None if data else {**body, **(changes or {})},
            data=data,
            headers={**known, "Content-Type": "application/json", **(headers or {})},
            timeout=5.0,
        )


@pytest.fixture(scope="module")
def server():
    with VlmServer(lambda text, images: f"{text} {len(images)}") as running:
        yield running


@pytest.mark.parametrize("provider", GOOD)
def test_what_is_in_order_is_answered(server, provider):
    answer = post(server, provider)
    assert answer.status_code == 200
    assert "Which? 0" in answer.text


@pytest.mark.parametrize(
    ("provider", "header", "code"),
    [
        ("openai", "Authorization", 401),
        ("gemini", "x-goog-api-key", 403),
        ("anthropic", "x-api-key", 401),
        ("anthropic", "anthropic-version", 400),
    ],
)
def test_a_missing_header_is_refused(server, provider, header, code):
    answer = post(server, provider, headers={header: None})
    assert answer.status_code == code
    assert answer.json()["error"]["message"]


@pytest.mark.parametrize(
    ("provider", "header", "code"),
    [
        ("openai", "Authorization", 401),
        ("gemini", "x-goog-api-key", 400),
        ("anthropic", "x-api-key", 401),
    ],
)
def test_a_wrong_key_is_refused(server, provider, header, code):
    assert post(server, provider, headers={header: "Bearer wrong"}).status_code == code


def user(*content):
    return {"messages": [{"role": "user", "content": list(content)}]}


def contents(*parts):
    return {"contents": [{"parts": list(parts)}]}


def strict(schema):
    return {"type": "json_schema", "json_schema": {"name": "a", "strict": True, "schema": schema}}


LOOSE = {"type": "object", "properties": {"a": {"type": "string"}}, "required": ["a"]}
BLOB = {"mimeType": "image/png", "data": PNG}
SOURCE = {"type": "base64", "media_type": "image/png", "data": PNG}


@pytest.mark.parametrize(
    ("provider", "changes"),
    [
        ("openai", {"model": ""}),
        ("openai", {"messages": []}),
        ("openai", {"messages": [{"role": "robot", "content": "Which?"}]}),
        ("openai", {"wrong": 1}),
        ("openai", {"max_tokens": "9"}),
        ("openai", {"max_tokens": 9, "max_completion_tokens": 9}),
        ("openai", user({"type": "image_url", "image_url": URL})),
        ("openai", user({"type": "image_url", "image_url": {"url": "http://example.com/a.png"}})),
        ("openai", user({"type": "image_url", "image_url": {"url": URL[:40]}})),
        ("openai", user({"type": "image", "source": SOURCE})),
        ("openai", {"response_format": {"type": "json_schema", "json_schema": {"schema": {}}}}),
        ("openai", {"response_format": strict(LOOSE)}),
        ("gemini", {"contents": []}),
        ("gemini", contents({"text": "Which?", "inlineData": BLOB})),
        ("gemini", contents({"inlineData": {**BLOB, "mimeType": "image/bmp"}})),
        ("gemini", contents({"inlineData": {**BLOB, "data": "no PNG"}})),
        ("gemini", contents({"image": BLOB})),
        ("gemini", {"generationConfig": {"max_tokens": 9}}),
        ("gemini", {"generationConfig": {"responseJsonSchema": LOOSE}}),
        ("gemini", {"generationConfig": {"thinkingConfig": {"effort": "low"}}}),
        ("anthropic", {"max_tokens": None}),
        ("anthropic", {"temperature": 0.0}),
        ("anthropic", user({"type": "text", "text": " "})),
        ("anthropic", user({"type": "image_url", "image_url": {"url": URL}})),
        ("anthropic", user({"type": "image", "source": {**SOURCE, "media_type": "image/bmp"}})),
        ("anthropic", {"output_config": {"format": {"type": "json_schema", "schema": LOOSE}}}),
        ("anthropic", {"output_config": {"thinking": 1}}),
    ],
)  # fmt: skip
def test_what_a_provider_does_not_take_is_a_bad_request(server, provider, changes):
    answer = post(server, provider, changes)
    assert answer.status_code == 400
    assert answer.json()["error"]["message"]


@pytest.mark.parametrize("provider", GOOD)
def test_what_is_no_json_is_a_bad_request(server, provider):
    assert post(server, provider, data=b"{").status_code == 400


@pytest.mark.parametrize(
    ("provider", "changes"),
    [
        ("openai", user({"type": "image_url", "image_url": {"url": URL}})),
        ("gemini", contents({"inline_data": {"mime_type": "image/png", "data": PNG}})),
        ("anthropic", user({"type": "image", "source": SOURCE})),
    ],
)
def test_images_are_seen(server, provider, changes):
    assert " 1" in post(server, provider, changes).text


def test_an_answer_that_fails_in_a_test_fails_the_test():
    def answer(text, images):
        raise AssertionError("not what was expected")

    with pytest.raises(AssertionError, match="not what"), VlmServer(answer) as server:
        assert post(server, "openai").status_code == 500


def test_mishaps_come_in_order_and_end():
    with VlmServer(lambda text, images: "2") as server:
        server.misbehave(status(500), None, status(529))
        codes = [post(server, "anthropic").status_code for _ in range(4)]
    assert codes == [500, 200, 529, 200]
