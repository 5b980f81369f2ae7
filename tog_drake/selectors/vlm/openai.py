"""Chat completions: the API of OpenAI and of most servers (vLLM, SGLang, Ollama, llama.cpp,
LM Studio, OpenRouter).

https://platform.openai.com/docs/api-reference/chat
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import urlsplit

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.api import Api
from tog_drake.selectors.vlm.bodies import at, count_at, short_at, text_at, token_counts
from tog_drake.selectors.vlm.keys import read_key, require_key
from tog_drake.selectors.vlm.question import Image, Message, Reply
from tog_drake.visible_text import quoted

_OPENAI = "https://api.openai.com/v1"
# One is the old name of the other; servers know the old one, the new one, or both.
_LIMITS = ("max_tokens", "max_completion_tokens")
_OPTIONAL = {
    r"response_format|json_schema|structured.outputs?|guided": (("response_format",),),
    r"reasoning_effort|reasoning|thinking": (("reasoning_effort",),),
    **{limit: ((limit,),) for limit in _LIMITS},
}
_REASONING = ("reasoning", "reasoning_content", "thinking")  # where servers put it
_FINISH: dict[str, Literal["length", "refusal"]] = {
    "length": "length",
    "content_filter": "refusal",
}


@dataclass
class OpenAi(Api):
    """A model of OpenAI, or behind any server that speaks its protocol."""

    provider = "openai"
    own_keys = ("OPENAI_API_KEY",)
    optional = _OPTIONAL

    model: str = ""  # as the server names it
    base_url: str = _OPENAI  # what comes before /chat/completions

    def url(self) -> str:
        return self.base_url.rstrip("/") + "/chat/completions"

    def _is_openai(self) -> bool:
        return urlsplit(self.base_url).hostname == urlsplit(_OPENAI).hostname

    def headers(self) -> dict[str, str]:
        """OpenAI itself wants a key; other servers get one where there is one."""
        variables = self.key_variables()
        if self._is_openai():
            key: str | None = require_key(variables, self.url())
        else:
            key = read_key(variables[0], self.url())
        return {"Authorization": f"Bearer {key}"} if key else {}

    def body(self, message: Message, encode: Callable[[Image], str]) -> dict[str, Any]:
        old, new = _LIMITS
        body: dict[str, Any] = {
            "model": self.model,
            "messages": [{"role": "user", "content": [_part(p, encode) for p in message.parts]}],
            new if self._is_openai() else old: message.max_tokens,
        }
        if message.schema is not None:
            answer = {"name": "answer", "strict": True, "schema": dict(message.schema)}
            body["response_format"] = {"type": "json_schema", "json_schema": answer}
        if self.effort is not None:
            body["reasoning_effort"] = self.effort
        return body

    def amend(self, body: dict[str, Any], complaint: str) -> tuple[dict[str, Any], str] | None:
        amended = super().amend(body, complaint)
        if amended is not None and amended[1] in _LIMITS:
            other = _LIMITS[1 - _LIMITS.index(amended[1])]
            amended[0][other] = body[amended[1]]
        return amended

    def read(self, body: Any) -> Reply:
        choice = at(body, "choices", 0)
        error = at(body, "error") or at(choice, "error")  # OpenRouter sends it with status 200
        if error:
            said = text_at(error, "message") or str(error)
            raise Unanswered("unreachable", f"the server answers with an error: {quoted(said)}")
        if not isinstance(at(choice, "message"), dict):
            raise Unanswered("unreachable", "the server's answer holds no choices[0].message")
        refusal = short_at(choice, "message", "refusal")
        finish = text_at(choice, "finish_reason")
        text = _content(at(choice, "message", "content"))
        # Nothing but reasoning: some servers say "stop" when it has used up the tokens.
        thought = any(text_at(choice, "message", name) for name in _REASONING)
        cut = thought and finish == "stop" and not text.strip()
        return Reply(
            text=text,
            finish="refusal" if refusal else "length" if cut else _FINISH.get(finish, "stop"),
            model=short_at(body, "model") or None,
            tokens=token_counts(
                count_at(body, "usage", "prompt_tokens"),
                count_at(body, "usage", "completion_tokens"),
                count_at(body, "usage", "completion_tokens_details", "reasoning_tokens"),
            ),
            refusal=refusal or (finish if finish == "content_filter" else ""),
        )


@dataclass
class Molmo(OpenAi):
    """A Molmo behind vLLM or the like; its name tells which, and so how it points."""

    model: str = "allenai/Molmo2-8B"
    base_url: str = "http://localhost:8000/v1"


@dataclass
class Qwen(OpenAi):
    """A Qwen-VL behind vLLM or the like; its name tells which, and so how it points."""

    model: str = "Qwen/Qwen3-VL-8B-Instruct"
    base_url: str = "http://localhost:8000/v1"


def _part(part: str | Image, encode: Callable[[Image], str]) -> dict[str, Any]:
    if isinstance(part, str):
        return {"type": "text", "text": part}
    return {"type": "image_url", "image_url": {"url": f"data:image/png;base64,{encode(part)}"}}


def _content(content: Any) -> str:
    """Text, or with some servers a list of parts; null where the model refuses or only thinks."""
    if isinstance(content, list):
        return "".join(text_at(p, "text") for p in content if at(p, "type") == "text")
    return content if isinstance(content, str) else ""
