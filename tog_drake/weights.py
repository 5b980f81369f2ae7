"""Where the weights of networks live on this machine. None of them comes with the package."""

import os
from pathlib import Path

VARIABLE = "TOG_WEIGHTS"  # environment variable that names another folder


def weights_dir() -> Path:
    """Returns the folder of stored weights: that of ``TOG_WEIGHTS``, or the platform's cache."""
    given = os.environ.get(VARIABLE)
    if given:
        return Path(given).expanduser().resolve()
    from platformdirs import user_cache_path

    return user_cache_path("tog_drake", appauthor=False) / "weights"
