"""Google's generateContent.

https://ai.google.dev/api/generate-content
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import quote

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.api import Api
from tog_drake.selectors.vlm.bodies import at, count_at, short_at, text_at, token_counts
from tog_drake.selectors.vlm.keys import require_key
from tog_drake.selectors.vlm.question import Image, Message, Reply

_OPTIONAL = {
    r"thinking.?(config|level)|thinking": (("generationConfig", "thinkingConfig"),),
    r"response.?(json.?)?schema|response.?mime.?type|json.(mode|schema)|structured.output": (
        ("generationConfig", "responseJsonSchema"),
        ("generationConfig", "responseMimeType"),
    ),
}
_REFUSALS = frozenset(
    {
        "SAFETY",
        "RECITATION",
        "LANGUAGE",
        "BLOCKLIST",
        "PROHIBITED_CONTENT",
        "SPII",
        "MODEL_ARMOR",
        "IMAGE_SAFETY",
        "IMAGE_PROHIBITED_CONTENT",
        "IMAGE_RECITATION",
    }
)


@dataclass
class Gemini(Api):
    """A Gemini model of Google."""

    provider = "gemini"
    own_keys = ("GOOGLE_API_KEY", "GEMINI_API_KEY")
    optional = _OPTIONAL

    model: str = ""  # such as gemini-3.8-flash
    base_url: str = "https://generativelanguage.googleapis.com"  # what comes before /v1beta

    def url(self) -> str:
        model = quote(self.model.removeprefix("models/"), safe="")
        return f"{self.base_url.rstrip('/')}/v1beta/models/{model}:generateContent"

    def headers(self) -> dict[str, str]:
        # Not as ?key=: addresses end up in logs.
        return {"x-goog-api-key": require_key(self.key_variables(), self.url())}

    def body(self, message: Message, encode: Callable[[Image], str]) -> dict[str, Any]:
        config: dict[str, Any] = {"maxOutputTokens": message.max_tokens}
        if message.schema is not None:
            config["responseMimeType"] = "application/json"
            config["responseJsonSchema"] = dict(message.schema)
        if self.effort is not None:
            config["thinkingConfig"] = {"thinkingLevel": self.effort}
        parts = [_part(part, encode) for part in message.parts]
        return {"contents": [{"role": "user", "parts": parts}], "generationConfig": config}

    def read(self, body: Any) -> Reply:
        candidate = at(body, "candidates", 0)
        blocked = short_at(body, "promptFeedback", "blockReason")
        reason = text_at(candidate, "finishReason")
        if not isinstance(candidate, dict) and not blocked:
            raise Unanswered("unreachable", "the server's answer holds no candidates[0]")
        parts = at(candidate, "content", "parts")
        said = [p for p in parts if at(p, "thought") is not True] if isinstance(parts, list) else []
        finish: Literal["stop", "length", "refusal"] = "stop"
        if blocked or reason in _REFUSALS:
            finish = "refusal"
        elif reason == "MAX_TOKENS":
            finish = "length"
        thought = count_at(body, "usageMetadata", "thoughtsTokenCount")
        spoken = count_at(body, "usageMetadata", "candidatesTokenCount")
        known = [count for count in (spoken, thought) if count is not None]
        return Reply(
            text="".join(text_at(part, "text") for part in said),
            finish=finish,
            model=short_at(body, "modelVersion") or None,
            tokens=token_counts(
                count_at(body, "usageMetadata", "promptTokenCount"),
                sum(known) if known else None,
                thought,
            ),
            refusal=(blocked or short_at(candidate, "finishMessage") or reason)
            if finish == "refusal"
            else "",
        )


def _part(part: str | Image, encode: Callable[[Image], str]) -> dict[str, Any]:
    if isinstance(part, str):
        return {"text": part}
    return {"inlineData": {"mimeType": "image/png", "data": encode(part)}}
