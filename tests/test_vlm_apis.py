"""The three protocols: what is asked, and what is understood of the answers."""

import base64
import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from vlm_server import KEY, KEY_VARIABLES, PROVIDERS, Spoken, VlmServer, plant_keys, status

from tog_drake import http_post
from tog_drake.drawing import encode_png
from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.bodies import spare
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.question import Message, Reply

CONFIGS = {"openai": OpenAi, "gemini": Gemini, "anthropic": Anthropic}
IMAGE = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)
SCHEMA = {
    "type": "object",
    "properties": {"choice": {"type": "string"}},
    "required": ["choice"],
    "additionalProperties": False,
}
MESSAGE = Message((IMAGE, "Which one?"), SCHEMA, 512)
NAMES = (  # that an API looks for
    *("choices", "message", "content", "refusal", "finish_reason", "error", "type", "text"),
    *("usage", "prompt_tokens", "completion_tokens_details", "reasoning_tokens", "model"),
    *("candidates", "parts", "thought", "finishReason", "promptFeedback", "blockReason"),
    *("usageMetadata", "promptTokenCount", "stop_reason", "input_tokens"),
)
WORDS = (  # of complaints
    *("unsupported", "is not supported", "unknown", "invalid", "max_tokens", "effort", "thinking"),
    *("response_format", "max_completion_tokens", "reasoning_effort", "output_config", "format"),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(NAMES) | st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=12,
)


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    plant_keys(monkeypatch)


def png(image):
    return base64.b64encode(encode_png(image)).decode()


def ask(provider, answer, message=MESSAGE, **config):
    with VlmServer(answer if callable(answer) else lambda text, images: answer) as server:
        api = CONFIGS[provider](model="any", base_url=server.base_url(provider), **config)
        deadline = time.monotonic() + 5.0
        response = http_post.post(
            api.url(), api.headers(), api.body(message, png), deadline=deadline
        )
        assert server.received[0].path == api.path()
    return api.read(response)


@pytest.mark.parametrize("provider", PROVIDERS)
def test_text_and_images_arrive_in_order_and_the_answer_comes_back(provider):
    def answer(text, images):
        assert text == "Look here.\nWhich one?"
        np.testing.assert_array_equal(images[0], IMAGE)
        np.testing.assert_array_equal(images[1], IMAGE[::-1])
        return '{"choice": "2"}'

    message = Message(("Look here.", IMAGE, IMAGE[::-1], "Which one?"), SCHEMA, 512)
    reply = ask(provider, answer, message, effort="low")
    assert (reply.text, reply.finish, reply.model) == ('{"choice": "2"}', "stop", "served-model-1")
    assert reply.tokens["input"] == 1000
    assert reply.tokens["output"] == 50  # reasoning included, with all three
    assert reply.tokens.get("reasoning", 30) == 30


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("schema", [None, SCHEMA], ids=["free", "schema"])
def test_nothing_that_steers_sampling_is_sent(provider, schema):
    body = CONFIGS[provider](model="any").body(Message(("Say.",), schema, 512), png)
    words = json.dumps(body).lower()
    for name in ("temperature", "top_p", "topp", "top_k", "topk", "seed", "detail"):
        assert name not in words
    assert ("json" in words) == (schema is not None)


@pytest.mark.parametrize("provider", PROVIDERS)
def test_a_body_can_be_made_without_images_or_keys(provider, monkeypatch):
    monkeypatch.delenv(KEY_VARIABLES[provider])
    body = CONFIGS[provider](model="any").body(MESSAGE, lambda image: "sha256:0f")
    assert json.dumps(body).count("sha256:0f") == 1


TEXTS = {
    "fenced JSON": 'Sure!\n```json\n{"choice": "2"}\n```\n',
    "Unicode": "Größe ≥ 3 → 选择 2 🔨 \u202e",
    "line ends": "1\r\n2\u2028",
}


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_text_comes_back_as_it_was_said(provider, text):
    assert ask(provider, text).text == text


@pytest.mark.parametrize("provider", PROVIDERS)
def test_halves_of_surrogate_pairs_are_replaced(provider):
    ask(provider, "a \ud800 b").text.encode("utf-8")


@pytest.mark.parametrize("provider", PROVIDERS)
def test_reasoning_is_no_answer(provider):
    reply = ask(provider, Spoken("2", reasoning="First 1, or 3? Final answer: 7"))
    assert (reply.text, reply.finish) == ("2", "stop")


@pytest.mark.parametrize("provider", PROVIDERS)
def test_reasoning_that_used_up_the_tokens_is_a_cut_answer(provider):
    reply = ask(provider, Spoken(None, finish="length", reasoning="Final answer: 7"))
    assert (reply.text, reply.finish) == ("", "length")


@pytest.mark.parametrize("provider", PROVIDERS)
def test_an_answer_that_was_cut_says_so(provider):
    reply = ask(provider, Spoken('{"choice": "1', finish="length"))
    assert (reply.text, reply.finish) == ('{"choice": "1', "length")


@pytest.mark.parametrize("provider", PROVIDERS)
@pytest.mark.parametrize("finish", ["refusal", "blocked"])
def test_a_refusal_is_a_refusal(provider, finish):
    reply = ask(provider, Spoken(None, finish=finish, refusal="I can't help with that."))
    assert (reply.text, reply.finish) == ("", "refusal")
    if provider == "openai" or finish == "blocked":
        assert reply.refusal in ("I can't help with that.", "content_filter", "SAFETY", "")


def test_why_a_model_refuses_is_kept():
    assert ask("openai", Spoken(None, refusal="I can't.")).refusal == "I can't."
    assert ask("openai", Spoken(None, finish="blocked")).refusal == "content_filter"
    assert ask("gemini", Spoken(None, finish="blocked")).refusal == "SAFETY"
    assert ask("gemini", Spoken(None, finish="refusal")).refusal == "PROHIBITED_CONTENT"
    assert ask("anthropic", Spoken(None, finish="refusal", refusal="No.")).refusal == "No."


@pytest.mark.parametrize("provider", PROVIDERS)
def test_an_empty_answer_is_empty(provider):
    assert ask(provider, "").text == ""
    assert ask(provider, Spoken(None)).text == ""


@pytest.mark.parametrize("name", ["reasoning", "reasoning_content", "thinking"])
@pytest.mark.parametrize("content", [None, "", " \n", []])
def test_reasoning_and_no_answer_is_a_cut_answer_though_the_server_says_stop(name, content):
    message = {"role": "assistant", "content": content, name: "First 1, or 3? Final answer: 7"}
    body = {"choices": [{"message": message, "finish_reason": "stop"}]}
    assert OpenAi(model="any").read(body).finish == "length"


def test_what_a_model_thinks_aloud_is_left_to_the_reader_of_answers():
    said = "<think>1 or 3</think>\n2"
    assert ask("openai", said).text == said


def test_a_list_of_parts_is_an_answer_too():
    content = [{"type": "thinking", "thinking": "7"}, {"type": "text", "text": "2"}]
    assert OpenAi().read({"choices": [{"message": {"content": content}}]}).text == "2"


def test_an_error_with_status_200_is_no_answer():
    with pytest.raises(Unanswered, match='"Provider returned error"') as info:
        OpenAi().read({"error": {"message": "Provider returned error", "code": 502}})
    assert info.value.status == "unreachable"


@pytest.mark.parametrize("provider", PROVIDERS)
@settings(max_examples=50)
@given(body=JSON)
def test_every_response_is_a_reply_or_is_said_to_be_none(provider, body):
    try:
        reply = CONFIGS[provider]().read(body)
    except Unanswered as error:
        assert error.status == "unreachable"
        return
    assert isinstance(reply, Reply)
    assert isinstance(reply.text, str)
    assert isinstance(reply.refusal, str)
    assert reply.model is None or reply.model
    assert all(type(n) is int and n >= 0 for n in (reply.tokens or {}).values())


@pytest.mark.parametrize("provider", PROVIDERS)
@settings(max_examples=30)
@given(complaint=st.lists(st.sampled_from(WORDS) | st.text(max_size=5)).map(" ".join))
def test_a_complaint_adds_nothing_to_a_request_but_another_name_of_the_limit(provider, complaint):
    body = CONFIGS[provider](model="any", effort="low").body(MESSAGE, lambda image: "")
    amended = CONFIGS[provider]().amend(body, complaint)
    if amended is not None:
        assert amended[0] != body
        assert amended[0].keys() - body.keys() <= {"max_tokens", "max_completion_tokens"}


@pytest.mark.parametrize(
    ("config", "complaint", "name"),
    [
        (OpenAi, "Unsupported parameter: 'max_completion_tokens' is not supported", None),
        (OpenAi, "This response_format type is unavailable now", "response_format"),
        (OpenAi, "Invalid parameter: 'response_format' of type 'json_schema' is not supported with "
         "this model.", "response_format"),
        (OpenAi, "[{'type': 'extra_forbidden', 'loc': ('body', 'response_format'), 'msg': "
         "'Extra inputs are not permitted'}]", "response_format"),
        (OpenAi, "Unrecognized request argument supplied: reasoning_effort", "reasoning_effort"),
        (OpenAi, "max_tokens: Unsupported parameter: 'max_tokens' is not supported with this "
         "model. Use 'max_completion_tokens' instead.", "max_tokens"),
        (Gemini, "Thinking level is not supported for this model.",
         "generationConfig.thinkingConfig"),
        (Gemini, "Unable to submit request because thinking_level MEDIUM is not supported by this "
         "model.", "generationConfig.thinkingConfig"),
        (Gemini, "JSON mode is not enabled for models/gemini-robotics-er-2-preview",
         "generationConfig.responseJsonSchema"),
        (Gemini, 'Invalid JSON payload received. Unknown name "responseJsonSchema" at '
         "'generation_config': Cannot find field.", "generationConfig.responseJsonSchema"),
        (Gemini, "API key not valid. Please pass a valid API key.", None),
        (Anthropic, "This model does not support the effort parameter.", "output_config.effort"),
        (Anthropic, "output_config.format: Extra inputs are not permitted", "output_config.format"),
        (Anthropic, "output_config: Extra inputs are not permitted", "output_config"),
        (Anthropic, "messages.0.content.0.image: invalid base64 data", None),
    ],
)  # fmt: skip
def test_what_is_left_out_is_what_a_server_names(config, complaint, name):
    api = config(model="any", base_url="http://127.0.0.1:1/v1", effort="low")
    body = api.body(MESSAGE, png)
    before = json.dumps(body)
    amended = api.amend(body, complaint)
    assert (amended and amended[1]) == name
    assert json.dumps(body) == before
    if name == "generationConfig.responseJsonSchema":
        assert amended[0]["generationConfig"].keys() == {"maxOutputTokens", "thinkingConfig"}


def test_nothing_is_left_empty():
    body = {"a": {"b": 1}, "c": 2}
    assert spare(body, "b: not supported", {"b": (("a", "b"),)}) == ({"c": 2}, "a.b")


def test_a_real_client_of_openai_is_served_too():
    openai = pytest.importorskip("openai")

    def answer(text, images):
        np.testing.assert_array_equal(images[0], IMAGE)
        return f"{text} 2"

    with VlmServer(answer) as server:
        client = openai.OpenAI(base_url=server.base_url("openai"), api_key=KEY, max_retries=1)
        url = {"url": f"data:image/png;base64,{png(IMAGE)}"}
        content = [{"type": "image_url", "image_url": url}, {"type": "text", "text": "Which?"}]
        messages = [{"role": "user", "content": content}]
        format = {"type": "json_schema", "json_schema": {"name": "a", "schema": SCHEMA}}
        said = client.chat.completions.create(
            model="any", messages=messages, response_format=format, max_tokens=9
        )
        assert said.choices[0].message.content == "Which? 2"
        assert said.choices[0].finish_reason == "stop"
        assert said.usage.completion_tokens_details.reasoning_tokens == 30
        server.misbehave(status(429, {"retry-after-ms": "1"}))
        again = client.chat.completions.create(model="any", messages=messages)
        assert again.choices[0].message.content == "Which? 2"
        with pytest.raises(openai.BadRequestError, match="Unrecognized request argument"):
            client.chat.completions.create(model="any", messages=messages, extra_body={"wrong": 1})
        with pytest.raises(openai.AuthenticationError):
            client.with_options(api_key="another").chat.completions.create(
                model="any", messages=messages
            )
