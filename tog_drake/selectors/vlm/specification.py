"""Models in one line, as the command takes them: ``PROVIDER:MODEL`` or ``PROVIDER:MODEL@URL``."""

import re
from typing import get_args

from tog_drake.errors import InputError
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.keys import ELSEWHERE
from tog_drake.selectors.vlm.openai import Molmo, OpenAi, Qwen
from tog_drake.urls import is_plain_url

ModelConfig = OpenAi | Gemini | Anthropic | Molmo | Qwen

PROVIDERS: dict[str, type[ModelConfig]] = {
    kind.__name__.lower(): kind for kind in get_args(ModelConfig)
}
VALID = (
    "openai:MODEL, openai:MODEL@URL (vLLM, Ollama, llama.cpp ...), gemini:MODEL, anthropic:MODEL, "
    "molmo:MODEL@URL, qwen:MODEL@URL; and replay:FILE where a cassette may answer"
)
# Servers that are taken for a provider, and the port each listens on.
_SERVERS = {"ollama": 11434, "vllm": 8000, "sglang": 30000, "lmstudio": 1234}
_FAMILIES = {"gpt": "openai", "chatgpt": "openai", "gemini": "gemini", "claude": "anthropic"}
# A model's name may hold colons (qwen2.5vl:7b) and at-signs; a URL begins with its scheme.
_FORM = re.compile(r"([a-z]+):((?!@)[^\s\x00-\x1f]+?)(?:@(https?://\S*))?", re.DOTALL)
# The only end of a name after an at-sign that is no address: a version, as in claude@20250514.
_VERSION = re.compile(r"[0-9]+|latest|default", re.ASCII)


def read_specification(text: str, profile: str | None = None) -> ModelConfig:
    """Returns the model that ``text`` names, to be asked with the profile of that name.

    Raises:
        InputError: saying what would be valid.
    """
    match = _FORM.fullmatch(text.strip())
    if match is None or match[1] not in PROVIDERS:
        raise InputError(f"{text!r} names no model{_meant(text.strip())}; valid: {VALID}")
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


def _meant(text: str) -> str:
    """What the writer of a line that names no model may have meant; "" where nothing is likely."""
    word, colon, name = text.partition(":")
    if colon and word.lower() in _SERVERS and re.fullmatch(r"[\w.:/-]+", name):
        meant = f"openai:{name}@http://localhost:{_SERVERS[word.lower()]}/v1"
    else:
        bare = re.fullmatch(r"([a-z]+)[\w.-]*", text, re.ASCII)
        if bare is None or bare[1] not in _FAMILIES:
            return ""
        meant = f"{_FAMILIES[bare[1]]}:{text}"
    return f"; did you mean {meant}"


def _without_endpoint(config: ModelConfig) -> str | None:
    """The base of an URL that was copied with what is added to it; None where it is the base."""
    base = config.base_url.rstrip("/")
    added = config.url().removeprefix(base)
    version = re.match(r"/v[0-9][^/]*", added)  # Anthropic's and Gemini's
    for end in (added, version[0] if version else added):
        if base.endswith(end):
            return base.removesuffix(end)
    return None


def check_model(config: ModelConfig) -> None:
    """Raises InputError for a model that cannot be asked, whatever its server is."""
    if not config.model:
        raise InputError(f"no model is named; valid: {VALID}")
    unsaid = config.base_url == type(config)().base_url
    _, at, end = config.model.rpartition("@")
    if unsaid and at and not _VERSION.fullmatch(end):
        # Such as any@localhost:8000/v1: the provider would be asked, and get its key and images.
        # Not shown: it may hold a password.
        raise InputError(
            "the model's name ends in an address without http:// or https://; a URL after @ begins "
            "with http:// or https://; valid: such as openai:MODEL@http://localhost:8000/v1"
        )
    if not is_plain_url(config.base_url):
        # Not shown: it may hold a password, and messages end up in records.
        raise InputError(
            f"base_url of {config.model} is no URL of scheme, host and path alone; valid: one such "
            "as http://localhost:8000/v1. A key goes into an environment variable such as "
            f"{ELSEWHERE}"
        )
    if (base := _without_endpoint(config)) is not None:
        raise InputError(
            f"base_url {config.base_url} has a part of {config.url()[len(base) :]} already, which "
            f"is added to it; valid: {base}"
        )
    if isinstance(config, Molmo | Qwen) and config.profile is None:
        family = type(config).__name__
        if family.lower() not in config.model.lower():
            raise InputError(
                f"the name {config.model!r} does not say which {family} it is, and they point in "
                "different ways; name the profile too (--profile, or profile: in the scenario)"
            )
    config.key_variables()  # to hear now that a key would go where it does not belong
    if config.max_tokens < 1:
        raise InputError(f"max_tokens must be 1 or more, not {config.max_tokens}")
