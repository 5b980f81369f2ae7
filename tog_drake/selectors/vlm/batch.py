"""Questions written down to be asked elsewhere: by a batch API at half the price, by another
machine that has a network, or by hand.

A folder gets ``batch-1.jsonl`` and so on as the provider takes them, with the images in them; the
images as files; ``index.html``, which shows the questions to a person; and ``answers.jsonl`` to be
filled in.
"""

import base64
import json
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tog_drake.drawing import encode_png
from tog_drake.errors import InputError
from tog_drake.files import write_atomically
from tog_drake.pages import page_environment
from tog_drake.selectors.vlm.question import Image
from tog_drake.selectors.vlm.request import Request, pixel_hash, save_images
from tog_drake.visible_text import visible

MAX_BATCH = 190_000_000  # [byte] of a file: OpenAI takes 200 MB, Anthropic 256 MB, Gemini 2 GB
_BATCH_FILE = re.compile(r"batch-[1-9][0-9]*\.jsonl?")  # as an export writes them
_HOW = {
    "openai": "upload each file with purpose “batch” and create a batch for /v1/chat/completions, "
    "or run it with vLLM: vllm run-batch",
    "gemini": "upload each file and create a batch of model {model} from it",
    "anthropic": "send each file as the body of a POST to /v1/messages/batches",
}
"""What to do with the files of each provider."""


def custom_id(key: str) -> str:
    """Returns the name of a question outside of cassettes: batch APIs take no more than 64
    letters, digits, - and _, and people would rather have less."""
    digest, _, repeat = key.partition("#")
    return digest[:32] + (f"-{repeat}" if repeat else "")


def batch_entry(request: Request) -> dict[str, Any]:
    """Returns one request of a batch, in the shape that its provider takes."""
    name, message = custom_id(request.key), request.message
    if request.api.provider == "gemini":
        # Batches answer a responseJsonSchema with broken JSON (as of August 2026, see
        # https://github.com/crmne/ruby_llm/issues/894); the text says how to answer, too.
        message = replace(message, schema=None)
    body = request.api.body(message, _base64)
    match request.api.provider:
        case "gemini":  # https://ai.google.dev/gemini-api/docs/batch-api
            return {"key": name, "request": body}
        case "anthropic":  # https://platform.claude.com/docs/en/api/creating-message-batches
            return {"custom_id": name, "params": body}
        case _:  # https://platform.openai.com/docs/guides/batch; vLLM's run-batch takes it too
            url = "/v1/chat/completions"
            return {"custom_id": name, "method": "POST", "url": url, "body": body}


@dataclass
class Export:
    """Writes questions into a folder as they come; ``finish`` ends it.

    The batches of an earlier export in the same folder go away at once.
    """

    folder: Path
    files: list[Path] = field(default_factory=list)  # that have been written
    _shown: dict[str, dict[str, Any]] = field(default_factory=dict)  # by custom_id
    _lines: list[bytes] = field(default_factory=list)  # of the file that is not written yet
    _array: bool = False  # one JSON object with all requests, not a line for each

    def __post_init__(self) -> None:
        for old in self.folder.glob("batch-*"):
            if _BATCH_FILE.fullmatch(old.name):  # results of batches stay, whatever their names
                old.unlink()

    def add(self, request: Request, about: str) -> None:
        """Adds a question, unless it is there already; ``about`` says to a person where it is from.

        Raises:
            InputError: it is too long for a batch.
        """
        name = custom_id(request.key)
        if name in self._shown:
            return
        line = json.dumps(batch_entry(request)).encode()
        if len(line) > MAX_BATCH:
            raise InputError(f"question {name} is longer than {MAX_BATCH} bytes, the most for one")
        if sum(map(len, self._lines)) + len(line) > MAX_BATCH:
            self._write()
        self._array = request.api.provider == "anthropic"
        self._lines.append(line)
        save_images(self.folder / "images", request)
        self._shown[name] = _shown(request, name, about)

    def finish(self) -> None:
        """Writes the rest: the last file, the page and the template of answers."""
        self._write()
        write_atomically(self.folder / "index.html", _page(list(self._shown.values())))
        blank = (json.dumps({"custom_id": name, "answer": ""}) + "\n" for name in self._shown)
        write_atomically(self.folder / "answers.jsonl", "".join(blank))

    def __len__(self) -> int:
        return len(self._shown)

    def _write(self) -> None:
        if not self._lines:
            return
        number = len(self.files) + 1
        if self._array:
            file = self.folder / f"batch-{number}.json"
            write_atomically(file, b'{"requests":[\n' + b",\n".join(self._lines) + b"\n]}\n")
        else:
            file = self.folder / f"batch-{number}.jsonl"
            write_atomically(file, b"\n".join(self._lines) + b"\n")
        self.files.append(file)
        self._lines.clear()


def how_to_send(request: Request) -> str:
    """Returns what to do with the files of a batch."""
    return _HOW[request.api.provider].format(model=visible(request.api.model, limit=100))


def _base64(image: Image) -> str:
    return base64.b64encode(encode_png(image)).decode()


def _shown(request: Request, name: str, about: str) -> dict[str, Any]:
    parts = [
        {"text": visible(part, lines=True)}
        if isinstance(part, str)
        else {"image": f"images/{pixel_hash(part)}.png", "size": f"{part.shape[1]}×{part.shape[0]}"}
        for part in request.message.parts
    ]
    prompt = visible(request.message.prompt, limit=100)
    return {"id": name, "prompt": prompt, "about": visible(about), "parts": parts}


def _page(questions: list[dict[str, Any]]) -> str:
    return page_environment().get_template("questions.html.j2").render(questions=questions)
