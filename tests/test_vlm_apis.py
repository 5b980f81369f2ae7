"""The three protocols: what is asked, and what is understood of the answers."""

import base64
import time

import numpy as np
import pytest
from vlm_server import KEY, KEY_VARIABLES, PROVIDERS, VlmServer

from tog_drake.drawing import encode_png
from tog_drake.selectors.vlm import transport
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.question import Message

CONFIGS = {"openai": OpenAi, "gemini": Gemini, "anthropic": Anthropic}
IMAGE = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)
SCHEMA = {
    "type": "object",
    "properties": {"choice": {"type": "integer"}},
    "required": ["choice"],
    "additionalProperties": False,
}


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)


def png(image):
    return base64.b64encode(encode_png(image)).decode()


def ask(server, provider, message, **config):
    api = CONFIGS[provider](model="any", base_url=server.base_url(provider), **config)
    body = api.body(message, png)
    answer = transport.post(api.url(), api.headers(), body, deadline=time.monotonic() + 5.0)
    return api.read(answer)


@pytest.mark.parametrize("provider", PROVIDERS)
def test_text_and_images_arrive_and_the_answer_comes_back(provider):
    def answer(text, images):
        assert text == "Look here.\nWhich one?"
        np.testing.assert_array_equal(images[0], IMAGE)
        np.testing.assert_array_equal(images[1], IMAGE[::-1])
        return '{"choice": 2}'

    message = Message(("Look here.", IMAGE, IMAGE[::-1], "Which one?"), SCHEMA, 512)
    with VlmServer(answer) as server:
        reply = ask(server, provider, message, effort="low")
    assert (reply.text, reply.finish, reply.model) == ('{"choice": 2}', "stop", "served-model-1")
    assert reply.tokens["input"] == 1000
    assert reply.tokens["output"] == 50
