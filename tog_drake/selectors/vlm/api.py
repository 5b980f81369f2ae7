"""What every provider's API has: the config of a model, and how it is asked."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar
from urllib.parse import urlsplit

from tog_drake.selectors.vlm.bodies import Path, spare
from tog_drake.selectors.vlm.keys import key_variables
from tog_drake.selectors.vlm.question import Image, Message, Reply


@dataclass
class Api(ABC):
    """How one provider wants to be asked: the config of a model is one of these.

    ``body`` and ``read`` are functions of their arguments alone, so that a question can be hashed,
    recorded and exported without being sent.
    """

    provider: ClassVar[str]  # the first word of its specification: openai, gemini or anthropic
    own_keys: ClassVar[tuple[str, ...]]  # environment variables of the provider's own key
    optional: ClassVar[Mapping[str, tuple[Path, ...]]]
    """What a server need not take, as ``bodies.spare`` wants it."""

    model: str = ""  # as the server names it
    base_url: str = ""  # what comes before the part of the path that ``url`` adds
    profile: str | None = None  # how the model points; None: as its name tells
    key_variable: str | None = None  # environment variable of the key; None: see ``keys``
    max_tokens: int = 4096  # of an answer, reasoning included
    effort: str | None = None  # of reasoning: low, medium, high; None: by default

    @abstractmethod
    def url(self) -> str:
        """Where the request goes."""

    def path(self) -> str:
        """Of the request's URL, without host, such as /v1/chat/completions."""
        return urlsplit(self.url()).path

    def key_variables(self) -> tuple[str, ...]:
        """Where the key is looked for. Raises InputError for another host's, see ``keys``."""
        return key_variables(self.key_variable, self.own_keys, self.url())

    @abstractmethod
    def headers(self) -> dict[str, str]:
        """Of the request, the key among them. Raises InputError where the key is missing."""

    @abstractmethod
    def body(self, message: Message, encode: Callable[[Image], str]) -> dict[str, Any]:
        """The request; ``encode`` gives the text that stands for an image, base64 of its PNG."""

    @abstractmethod
    def read(self, body: Any) -> Reply:
        """What a response of status 200 says. Raises Unanswered where that is nothing."""

    def amend(self, body: dict[str, Any], complaint: str) -> tuple[dict[str, Any], str] | None:
        """The request without what a status 400 says is not taken, and the name of that.

        None where the complaint is about something that the request cannot do without.
        """
        return spare(body, complaint, self.optional)
