"""Anthropic's messages.

https://docs.claude.com/en/api/messages
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.api import Api
from tog_drake.selectors.vlm.bodies import at, count_at, short_at, text_at, token_counts
from tog_drake.selectors.vlm.keys import require_key
from tog_drake.selectors.vlm.question import Image, Message, Reply

_OPTIONAL = {
    r"output_config\.effort|effort": (("output_config", "effort"),),
    r"output_config\.format|structured.output|json_schema|output_format": (
        ("output_config", "format"),
    ),
    r"output_config(?!\.)": (("output_config",),),
}
_FINISH: dict[str, Literal["length", "refusal"]] = {
    "max_tokens": "length",
    "model_context_window_exceeded": "length",
    "refusal": "refusal",
}


@dataclass
class Anthropic(Api):
    """A Claude model of Anthropic."""

    provider = "anthropic"
    own_keys = ("ANTHROPIC_API_KEY",)
    optional = _OPTIONAL

    model: str = ""  # such as claude-sonnet-5-5
    base_url: str = "https://api.anthropic.com"  # what comes before /v1/messages

    def url(self) -> str:
        return self.base_url.rstrip("/") + "/v1/messages"

    def headers(self) -> dict[str, str]:
        key = require_key(self.key_variables(), self.url())
        return {"x-api-key": key, "anthropic-version": "2023-06-01"}

    def body(self, message: Message, encode: Callable[[Image], str]) -> dict[str, Any]:
        config: dict[str, Any] = {}
        if self.effort is not None:
            config["effort"] = self.effort
        if message.schema is not None:
            config["format"] = {"type": "json_schema", "schema": dict(message.schema)}
        body = {
            "model": self.model,
            "max_tokens": message.max_tokens,
            "messages": [{"role": "user", "content": [_part(p, encode) for p in message.parts]}],
        }
        return {**body, "output_config": config} if config else body

    def read(self, body: Any) -> Reply:
        content = at(body, "content")
        if not isinstance(content, list):
            raise Unanswered("unreachable", "the server's answer holds no list named content")
        finish: Literal["stop", "length", "refusal"]
        finish = _FINISH.get(text_at(body, "stop_reason"), "stop")
        return Reply(
            text="".join(text_at(b, "text") for b in content if at(b, "type") == "text"),
            finish=finish,
            model=short_at(body, "model") or None,
            tokens=token_counts(
                count_at(body, "usage", "input_tokens"),
                count_at(body, "usage", "output_tokens"),
                count_at(body, "usage", "output_tokens_details", "thinking_tokens"),
            ),
            refusal=short_at(body, "stop_details", "explanation"),
        )


def _part(part: str | Image, encode: Callable[[Image], str]) -> dict[str, Any]:
    if isinstance(part, str):
        return {"type": "text", "text": part}
    source = {"type": "base64", "media_type": "image/png", "data": encode(part)}
    return {"type": "image", "source": source}
