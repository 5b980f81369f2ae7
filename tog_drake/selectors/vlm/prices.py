"""What an answer costs, from the tokens that the server counted and a table of prices."""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from tog_drake.errors import InputError
from tog_drake.files import read_yaml

VARIABLE = "TOG_PRICES"  # environment variable that names a file of one's own prices
_VERSION = re.compile(r"-(\d{8}|\d{4}-\d{2}-\d{2}|\d{3})$")  # of a model, in the name returned


@dataclass(frozen=True)
class Prices:
    """Prices of models by host, [USD per million tokens] of input and of output."""

    as_of: str  # the date of our own table
    of: Mapping[tuple[str, str], tuple[float, float]]  # (host, model) -> (input, output)

    def cost(self, url: str, model: str, tokens: Mapping[str, int] | None) -> float | None:
        """Returns what an answer costs [USD], None where price or tokens are not known.

        Args:
            url: of the request: who bills.
            model: as the server named it in its answer, maybe with a version at the end. It may
                have been another than was asked for, at another price.
            tokens: input and output, reasoning included in the output.
        """
        host = urlsplit(url).hostname or ""
        name = model.removeprefix("models/")
        price = self.of.get((host, name)) or self.of.get((host, _VERSION.sub("", name)))
        if price is None or tokens is None or not {"input", "output"} <= tokens.keys():
            return None
        return (price[0] * tokens["input"] + price[1] * tokens["output"]) / 1e6


def load_prices() -> Prices:
    """Returns our table, with the entries of the file that ``TOG_PRICES`` names on top.

    Raises:
        InputError: that file cannot be read, or is not of the form of ``prices.yaml``.
    """
    as_of, table = _read(Path(__file__).with_name("prices.yaml"))
    own = os.environ.get(VARIABLE, "")
    if own:
        table |= _read(Path(own))[1]
    return Prices(as_of, table)


def _read(file: Path) -> tuple[str, dict[tuple[str, str], tuple[float, float]]]:
    try:
        content = read_yaml(file)
        table = {
            (str(host), str(model)): (_amount(price, "input"), _amount(price, "output"))
            for host, models in content["hosts"].items()
            for model, price in models.items()
        }
    except InputError as error:
        raise InputError(f"{VARIABLE}: {file} cannot be read: {error}") from error
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{VARIABLE}: {file} is no table of prices: {error!r}; valid: "
            "hosts: {api.example.com: {model: {input: 1.0, output: 5.0}}}, USD per million tokens"
        ) from error
    return str(content.get("as_of", "")), table


def _amount(price: Any, name: str) -> float:
    amount = float(price[name])
    if not (isfinite(amount) and amount >= 0.0):
        raise ValueError(f"{name} must be 0 or more, not {amount}")
    return amount
