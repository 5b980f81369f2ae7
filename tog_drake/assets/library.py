"""Where imported objects live, and what is known of each."""

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

from tog_drake.assets.model import MODEL
from tog_drake.errors import InputError

VARIABLE = "TOG_ASSETS"  # environment variable that names another folder
REPORT = "report.json"
PREVIEW = "preview.png"
PARTS = "parts.yaml"  # part labels beside a model
PACKAGE = "tog_assets"  # package://tog_assets/NAME/model.sdf in scenarios
MAX_REPORT_BYTES = 1_000_000


def library_dir() -> Path:
    """Returns the folder of imported objects: that of ``TOG_ASSETS``, or the platform's cache."""
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given).expanduser().resolve()
    from platformdirs import user_cache_path

    return user_cache_path("tog_drake", appauthor=False) / "assets"


def asset_names() -> list[str]:
    """Returns the names of all imported objects."""
    return sorted(path.parent.name for path in library_dir().glob(f"*/{MODEL}"))


def asset_dir(name: str) -> Path:
    """Returns the folder of an imported object.

    Raises:
        InputError: there is none of that name.
    """
    folder = library_dir() / checked_name(name)
    if not (folder / MODEL).is_file():
        raise InputError(
            f"no imported object is called {name!r}; `tog assets list` shows those that are, "
            f"{_remedy(name)}"
        )
    return folder


def _remedy(name: str) -> str:
    """The command that brings an object in, as far as its name tells."""
    kind, _, rest = name.partition("_")
    if kind in ("ycb", "gso") and rest:
        return f"`tog assets fetch {kind}:{rest}` brings this one in"
    return f"`tog assets add-dir DIR` brings it in from a folder DIR that holds {name}/"


def checked_name(name: str) -> str:
    """Returns a name that is fit for a folder and for a model.

    Raises:
        InputError: it is not.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", name) or ".." in name:
        raise InputError(
            f"{name!r:.120} is no name for an object: letters, digits, '_', '-' and '.' only, the "
            "first a letter or a digit, at most 100"
        )
    return name


def read_report(name: str) -> dict[str, Any]:
    """Returns what its import said of an object; empty where nothing readable is left of it."""
    path = asset_dir(name) / REPORT
    try:
        if path.stat().st_size > MAX_REPORT_BYTES:
            return {}
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def remove_asset(name: str) -> None:
    """Deletes an imported object.

    Raises:
        InputError: there is none of that name.
    """
    shutil.rmtree(asset_dir(name))
