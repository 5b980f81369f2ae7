"""Names the colours of points, as a person would under a lamp that is not quite white."""

import numpy as np
from numpy.typing import NDArray

from tog_drake.values import Array

# Hue [degrees] at which each chromatic name fits best, and how far from it it still fits at all.
_HUES = {
    "red": (355.0, 25.0),
    "orange": (20.0, 24.0),
    "yellow": (50.0, 22.0),
    "green": (120.0, 60.0),
    "cyan": (183.0, 25.0),
    "blue": (220.0, 45.0),
    "purple": (275.0, 30.0),
    "pink": (325.0, 30.0),
}
_SATURATED = (0.25, 0.45)  # from no colour to full colour
_DARK = (0.12, 0.25)  # from black to a colour that can be named


def chromaticity(rgb: NDArray[np.uint8] | Array) -> Array:
    """Colours (N, 3) without their brightness: shares of red, green and blue; dark is grey."""
    dim = 40.0  # of 255: keeps the noise of dark pixels small
    values = rgb.astype(np.float64)
    return np.asarray((values + dim / 3) / (values.sum(axis=1, keepdims=True) + dim))


def white_balanced(rgb: NDArray[np.uint8], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns colours (N, 3) as under a white lamp.

    The brightest part of the image (H, W, 3) is taken for white if it is nearly so; otherwise the
    colours stay as they are.
    """
    pixels = image[::4, ::4].reshape(-1, 3).astype(np.float64)
    brightness = pixels.sum(axis=1)
    lamp = np.median(pixels[brightness >= np.percentile(brightness, 97)], axis=0)
    if lamp.min() < 0.75 * lamp.max() or lamp.max() == 0:
        return rgb
    return np.asarray(np.rint(np.clip(rgb * (lamp.max() / lamp), 0, 255)), dtype=np.uint8)


def rivals(name: str) -> list[str]:
    """The names whose hues border on that of ``name``; many people call cyan blue or green."""
    if name not in _HUES:
        return []
    hue = _HUES[name][0]
    return [
        other
        for other, (centre, _) in _HUES.items()
        if other not in (name, "cyan") and abs((centre - hue + 180.0) % 360.0 - 180.0) < 60.0
    ]


def fit(rgb: NDArray[np.uint8], name: str) -> Array:
    """Returns how well a name of the lexicon's colours fits each colour (N, 3): (N,) 0..1.

    Neighbouring names overlap, so that compared with each other things can be told apart under
    any lamp: a salmon drill is the most orange thing where nothing else is.
    """
    hue, saturation, value = _hsv(rgb)
    coloured = _ramp(saturation, *_SATURATED) * _ramp(value, *_DARK)
    if name in _HUES:
        centre, reach = _HUES[name]
        away = np.abs((hue - centre + 180.0) % 360.0 - 180.0)
        return coloured * np.clip(1.3 * (1.0 - away / reach), 0.0, 1.0)
    if name == "brown":
        away = np.abs((hue - 25.0 + 180.0) % 360.0 - 180.0)
        return (
            np.clip(1.3 * (1 - away / 25.0), 0, 1)
            * _ramp(saturation, 0.15, 0.3)
            * _ramp(value, 0.8, 0.6)
        )
    plain = 1.0 - _ramp(saturation, 0.15, 0.35)
    if name == "black":
        return (1.0 - _ramp(value, 0.2, 0.4)) * np.maximum(plain, 1.0 - _ramp(value, *_DARK))
    if name == "white":
        return plain * _ramp(value, 0.5, 0.85)
    return plain * _ramp(value, 0.15, 0.35) * (1.0 - _ramp(value, 0.75, 0.95))  # grey


def _ramp(x: Array, low: float, high: float) -> Array:
    return np.clip((x - low) / (high - low), 0.0, 1.0)


def _hsv(rgb: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
    """Hue [degrees], saturation and value in 0..1 of each colour."""
    r, g, b = (rgb[:, i] / 255.0 for i in range(3))
    value = np.maximum(np.maximum(r, g), b)
    spread = value - np.minimum(np.minimum(r, g), b)
    safe = np.maximum(spread, 1e-9)
    hue = np.where(
        value == r,
        (g - b) / safe % 6.0,
        np.where(value == g, (b - r) / safe + 2.0, (r - g) / safe + 4.0),
    )
    return 60.0 * hue, spread / np.maximum(value, 1e-9), value
