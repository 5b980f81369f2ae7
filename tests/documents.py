"""What Markdown files and notebooks hold: fenced blocks, tables, links, headings."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_FOLDERS = ("diagrams", "docs", "models", "notebooks", "tests", "tog_drake", ".github")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language ("" where none is named) and text."""

    language: str
    text: str
    heading: str  # that it stands below
    line: int  # of the fence, from 1


def documents():
    """All Markdown files and notebooks of this checkout."""
    found = list(ROOT.glob("*.md"))
    for folder in _FOLDERS:
        for kind in ("*.md", "*.ipynb"):
            found += sorted((ROOT / folder).rglob(kind))
    return found


def markdown_of(path):
    """The text of a Markdown file, or of a notebook's Markdown cells."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".ipynb":
        return text
    cells = [c["source"] for c in json.loads(text)["cells"] if c["cell_type"] == "markdown"]
    return "\n\n".join(c if isinstance(c, str) else "".join(c) for c in cells)


_FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*) *\n(?P<text>.*?)^ *``` *$",
    re.M | re.S,
)


def blocks(text):
    """The fenced blocks of a text, in order."""
    found = []
    for match in _FENCE.finditer(text):
        indent = len(match["indent"])
        body = "\n".join(line[indent:] for line in match["text"].splitlines())
        line = text.count("\n", 0, match.start("language")) + 1
        above = re.findall(r"^#+ +(.+?) *$", _FENCE.sub("", text[: match.start()]), re.M)
        found.append(Block(match["language"], body, above[-1] if above else "", line))
    return found


def commands(block):
    """The lines that a shell would run: continued ones joined, of a console those behind ``$``."""
    lines = re.sub(r"\\\n\s*", " ", block.text).splitlines()
    if block.language == "console":
        return [line[2:] for line in lines if line.startswith("$ ")]
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def prose(text):
    """The text without fenced blocks and code, in which brackets are no links."""
    return re.sub(r"`[^`\n]*`", "``", _FENCE.sub("", text))


def links(text):
    """The targets of all links and images."""
    return re.findall(r"\]\(<?([^)>\s]+)>?(?: \"[^\"]*\")?\)", prose(text))


def anchors(text):
    """The fragments by which GitHub names the headings."""
    found = set()
    for title in re.findall(r"^#+ +(.+?) *$", _FENCE.sub("", text), re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", title).lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        found.add(next(s for s in (slug, *(f"{slug}-{i}" for i in range(1, 99))) if s not in found))
    return found


def first_column(text, heading):
    """What stands in backticks or plain in the first column of the table below a heading."""
    section = re.split(r"^#+ ", text.split(f"## {heading}\n", 1)[1], maxsplit=1, flags=re.M)[0]
    rows = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [row.split("|")[1].strip().strip("`") for row in rows]
