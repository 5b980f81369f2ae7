"""Text from outside, made fit to be shown: by a model, a server or a file.

A terminal obeys control characters, and a page turns text around at bidirectional overrides: both
could show something else than what was said. Here such characters become visible escapes.
"""

import unicodedata

# Control, format (bidirectional marks, zero-width), surrogate and private characters, and those
# that break lines or paragraphs (Unicode 15, table 12: General_Category).
_HIDDEN = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def visible(text: str, *, limit: int | None = None, lines: bool = False) -> str:
    r"""Returns ``text`` with every character that is obeyed, not shown, as an escape: ``\u001b``.

    Args:
        text: anything, lone surrogates included, which no file could be written with.
        limit: the greatest number of characters of ``text`` that is shown; what is cut off is
            counted at the end.
        lines: whether line breaks and tabs stay as they are.
    """
    cut = text if limit is None or len(text) <= limit else text[:limit]
    kept = "\n\t" if lines else ""
    shown = "".join(_escaped(c) if _hidden(c) and c not in kept else c for c in cut)
    left = len(text) - len(cut)
    return shown + (f" … ({left:,} more characters)" if left else "")


def quoted(text: str, limit: int = 200) -> str:
    """Returns what somebody else wrote, fit for a message: on one line, and nothing hidden in it.

    Args:
        text: from a server or a file.
        limit: the greatest number of characters that is shown.
    """
    line = " ".join(text[: 20 * limit].split())
    return f'"{visible(line, limit=limit)}"'


def _hidden(character: str) -> bool:
    return unicodedata.category(character) in _HIDDEN


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
