"""Models in one line, as the command takes them: ``PROVIDER:MODEL`` or ``PROVIDER:MODEL@URL``."""

import re

from tog_drake.errors import InputError
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import Molmo, OpenAi, Qwen

ModelConfig = OpenAi | Gemini | Anthropic | Molmo | Qwen

PROVIDERS: dict[str, type[ModelConfig]] = {
    "openai": OpenAi,
    "gemini": Gemini,
    "anthropic": Anthropic,
    "molmo": Molmo,
    "qwen": Qwen,
}
VALID = (
    "openai:MODEL, openai:MODEL@URL (vLLM, Ollama, llama.cpp ...), gemini:MODEL, anthropic:MODEL, "
    "molmo:MODEL@URL, qwen:MODEL@URL, replay:FILE"
)
# A model's name may hold colons (qwen2.5vl:7b) and at-signs; a URL begins with its scheme.
_FORM = re.compile(r"([a-z]+):((?!@)[^\s\x00-\x1f]+?)(?:@(https?://\S*))?", re.DOTALL)

# No user, password or query, and nothing that two readers of URLs could take for two hosts.
_URL = re.compile(r"https?://([\w.-]+|\[[0-9a-fA-F:.]+\])(:[0-9]{1,5})?(/[\w.~%:+/-]*)?", re.ASCII)


def read_specification(text: str, profile: str | None = None) -> ModelConfig:
    """Returns the model that ``text`` names, to be asked with the profile of that name.

    Raises:
        InputError: saying what would be valid.
    """
    match = _FORM.fullmatch(text.strip())
    if match is None or match[1] not in PROVIDERS:
        raise InputError(f"{text!r} names no model; valid: {VALID}")
    config = PROVIDERS[match[1]](model=match[2], profile=profile)
    if match[3] is not None:
        config.base_url = match[3].rstrip("/")
    check_model(config)
    return config


def specification(config: ModelConfig) -> str:
    """Returns the line that ``read_specification`` makes this model of, but for its options."""
    word = next(word for word, kind in PROVIDERS.items() if kind is type(config))
    at = "" if config.base_url == type(config)().base_url else f"@{config.base_url}"
    return f"{word}:{config.model}{at}"


def check_model(config: ModelConfig) -> None:
    """Raises InputError for a model that cannot be asked, whatever its server is."""
    if not config.model:
        raise InputError(f"no model is named; valid: {VALID}")
    if not _URL.fullmatch(config.base_url):
        # Not shown: it may hold a password, and messages end up in records.
        raise InputError(
            f"base_url of {config.model} is no URL of scheme, host and path alone; valid: one such "
            f"as http://localhost:8000/v1. A key goes into the environment variable "
            f"{config.key_variable}"
        )
    if isinstance(config, Molmo | Qwen) and config.profile is None:
        family = type(config).__name__
        if family.lower() not in config.model.lower():
            raise InputError(
                f"the name {config.model!r} does not say which {family} it is, and they point in "
                "different ways; name the profile too (--profile, or profile: in the scenario)"
            )
    if config.max_tokens < 1:
        raise InputError(f"max_tokens must be 1 or more, not {config.max_tokens}")
