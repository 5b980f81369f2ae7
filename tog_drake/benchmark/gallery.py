"""The episodes of a run as cards of its page: small pictures, what was asked, what came of it."""

import base64
import gzip
import hashlib
import io
import zlib
from bisect import bisect_left
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tog_drake.benchmark.costs import exchanges
from tog_drake.benchmark.journal import episode_folder
from tog_drake.benchmark.sheets import shown
from tog_drake.record import chosen_region, usage
from tog_drake.visible_text import visible

if TYPE_CHECKING:
    from tog_drake.benchmark.journal import Line, Run
    from tog_drake.vlm_record import ExchangeRecord

VIEW, SENT, REPLAY = "view.jpg", "sent-*.png", "replay.html.gz"
SIZES = ((480, 75), (360, 65), (240, 55))
"""(greatest side [pixel], JPEG quality) of pictures: the first with which all of them fit."""
MAX_PICTURES = 10_000_000  # [byte] in the page
MAX_REPLAYS = 60_000_000  # [byte] in the page
_MAX_FILE, _MAX_PAGE = 30_000_000, 100_000_000  # [byte] a file, a replay: more is not read
_MAX_PIXELS = 50_000_000  # of a picture
LONGEST = 2000  # characters of a text from outside


class Pictures:
    """The pictures of a page, each content once."""

    def __init__(self) -> None:
        self._files: dict[str, Path] = {}  # SHA-256 -> where it was first

    def __len__(self) -> int:
        return len(self._files)

    def add(self, path: Path) -> str | None:
        """Returns the key of a picture in ``encoded``; None where there is none."""
        content = _read(path)
        if content is None:
            return None
        key = hashlib.sha256(content).hexdigest()[:16]
        self._files.setdefault(key, path)
        return key

    def encoded(self) -> dict[str, dict[str, Any]]:
        """Returns each picture as a JPEG, its ``data`` in base64, with ``size`` (of the original).

        What cannot be read is left out, and so are the last ones where even the smallest are too
        many for a page.
        """
        for side, quality in SIZES:
            found = {
                key: encoded
                for key, path in self._files.items()
                if (encoded := _encode(path, side, quality)) is not None
            }
            if sum(len(picture["data"]) for picture in found.values()) <= MAX_PICTURES:
                return found
        total = 0
        for key in list(found):
            total += len(found[key]["data"])
            if total > MAX_PICTURES:
                del found[key]
        return found


class Replays:
    """The Meshcat replays of a page; the viewer, with which all begin, is carried once."""

    def __init__(self) -> None:
        self._files: dict[str, Path] = {}

    def __len__(self) -> int:
        return len(self._files)

    def add(self, path: Path) -> str | None:
        """Returns the key of a replay in ``packed``; None where there is none."""
        if not path.is_file():
            return None
        key = hashlib.sha256(str(path).encode(errors="surrogateescape")).hexdigest()[:16]
        self._files[key] = path
        return key

    def packed(self) -> tuple[str, dict[str, str]]:
        """Returns how all replays begin, and the rest of each by its key: gzip in base64.

        What cannot be read is left out, and so are the last ones where they are too many.
        """
        begin: bytes | None = None
        for path in self._files.values():
            page = _unpacked(path)
            if page is not None:
                begin = page if begin is None else begin[: _alike(begin, page)]
        if begin is None:
            return "", {}
        rest: dict[str, str] = {}
        total = 0
        for key, path in self._files.items():
            page = _unpacked(path)
            if page is not None:
                packed = _pack(page[len(begin) :])
                total += len(packed)
                if total > MAX_REPLAYS:
                    break
                rest[key] = packed
        return _pack(begin), rest


def cards(run: "Run", pictures: Pictures, replays: Replays) -> list[dict[str, Any]]:
    """Returns what the page shows of each line of a run; every text is fit to be shown."""
    return [_card(run, line, pictures, replays) for line in run.lines]


def _card(run: "Run", line: "Line", pictures: Pictures, replays: Replays) -> dict[str, Any]:
    cell, record, judge = line["cell"], line["record"], line["judge"]
    folder = episode_folder(run.folder, line)
    sent = sorted(folder.glob(SENT), key=_number) if folder is not None else []
    choice = record["choice"]
    vlm = record["vlm"]
    other = choice is not None and choice["planned_index"] not in (None, choice["index"])
    facts = {
        "Scene": f"{cell['scenario']}, {cell['object']}, seed {cell['seed']}",
        "Outcome": ": ".join(filter(None, (record["outcome"], record["message"]))),
        "Chosen": None if choice is None else choice["part"] or f"grasp {choice['index']}",
        "Reason": None if choice is None else choice["reason"],
        "It closes on": _shares(chosen_region(record) or {}),
        "Carried out": f"another grasp, on {_shares(record['closes_on'] or {})}" if other else None,
        "Held by": _shares(record["held"]),
        "Task allows": ", ".join(record["allowed"] or ()),
        "Beyond the hand": cell["beyond"],
        "Instead of the model": None if vlm is None else vlm["fallback"],
        "Model as judge": None if judge is None else _judged(judge),
    }
    return {
        "run": shown(run.folder.name),
        "method": shown(cell["method"]),
        "object": shown(cell["object"]),
        "task": shown(cell["task"]),
        "category": shown(cell["category"]),
        "outcome": shown(record["outcome"]),
        "grasp": bool(record["grasp_success"]),
        "complies": record["task_compliance"],
        "facts": {
            name: visible(text, limit=LONGEST, lines=True) for name, text in facts.items() if text
        },
        "view": None if folder is None else pictures.add(folder / VIEW),
        "sent": [key for path in sent if (key := pictures.add(path)) is not None],
        "asked": [_asked(exchange) for exchange in exchanges(line)],
        "replay": None if folder is None else replays.add(folder / REPLAY),
    }


def _asked(exchange: "ExchangeRecord") -> dict[str, Any]:
    """What the page shows of a question."""
    marks = "; ".join(f"{mark} is grasp {row}" for mark, row in exchange["marks"].items())
    pointed = "; ".join(f"{role} ({u:.0f}, {v:.0f})" for role, (u, v) in exchange["points"].items())
    took = usage(
        exchange["seconds"], [exchange["tokens"]], [exchange["cost"]], [exchange["replayed"]]
    )
    facts = {
        "What is wrong": exchange["message"],
        "Marks": marks,
        "Points to": pointed,
        "It took": took,
    }
    answer = exchange["answer"]
    return {
        "prompt": shown(exchange["prompt"]),
        "status": shown(exchange["status"]),
        "text": visible(exchange["text"], limit=LONGEST, lines=True),
        "answer": None if answer is None else visible(answer, limit=LONGEST, lines=True),
        "facts": {name: visible(text, limit=LONGEST) for name, text in facts.items() if text},
    }


def _judged(judge: Mapping[str, Any]) -> str:
    said = {True: "suits the task", False: "does not suit the task", None: judge["status"]}
    return f"{judge['model']}: {said[judge['complies']]}"


def _shares(shares: Mapping[str, float]) -> str:
    return ", ".join(f"{part} {share:.0%}" for part, share in shares.items())


def _number(path: Path) -> int:
    digits = "".join(filter(str.isdigit, path.stem))
    return int(digits or 0)


def _read(path: Path) -> bytes | None:
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_FILE + 1)
    except OSError:
        return None
    return content if len(content) <= _MAX_FILE else None


def _encode(path: Path, side: int, quality: int) -> dict[str, Any] | None:
    """A picture as a small JPEG; None where it is none, or far too large."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            size = image.size
            if size[0] * size[1] > _MAX_PIXELS:
                return None
            image.draft("RGB", (side, side))  # a JPEG is read no larger than needed
            small = image.convert("RGB")
    except (
        OSError,
        SyntaxError,
        ValueError,
        UnidentifiedImageError,
        Image.DecompressionBombError,
    ):
        return None
    small.thumbnail((side, side), Image.Resampling.BILINEAR)
    file = io.BytesIO()
    small.save(file, "JPEG", quality=quality)
    return {"data": base64.b64encode(file.getvalue()).decode(), "size": size}


def _unpacked(path: Path) -> bytes | None:
    """The page of a replay; None where it is none."""
    content = _read(path)
    if content is None:
        return None
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            page = file.read(_MAX_PAGE + 1)
    except (OSError, EOFError, zlib.error):
        return None
    return page if len(page) <= _MAX_PAGE else None


def _alike(a: bytes, b: bytes) -> int:
    """How many bytes at the beginning are the same."""
    return bisect_left(range(min(len(a), len(b))), True, key=lambda i: a[: i + 1] != b[: i + 1])


def _pack(page: bytes) -> str:
    return base64.b64encode(gzip.compress(page, mtime=0)).decode()
