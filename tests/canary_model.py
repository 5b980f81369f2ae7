"""A model that knows the canary: it tells what is to be seen there, in the way of its family."""

import json

import numpy as np

from tog_drake.selectors.vlm.canary import HEIGHT, WIDTH, draw_canary

TOLD = {  # how a point (u, v) is told in each convention, as native answers have it
    "gemini": lambda u, v: _json([{"point": [_m(v, HEIGHT), _m(u, WIDTH)], "label": "disc"}]),
    "qwen3-vl": lambda u, v: _json([{"point_2d": [_m(u, WIDTH), _m(v, HEIGHT)], "label": "disc"}]),
    "qwen2.5-vl": lambda u, v: _json([{"point_2d": [int(u), int(v)], "label": "disc"}]),
    "molmo": lambda u, v: f'<point x="{u / WIDTH:.1%}" y="{v / HEIGHT:.1%}" alt="d">d</point>',
    "molmo2": lambda u, v: (
        f'<points coords="1 1 {_m(u, WIDTH):03d} {_m(v, HEIGHT):03d}">disc</points>'
    ),
    "robopoint": lambda u, v: f"[({u / WIDTH:.3f}, {v / HEIGHT:.3f})]",
    "gpt": lambda u, v: _json({"points": [{"x": int(u), "y": int(v), "label": "disc"}]}),
    "claude": lambda u, v: _json({"points": [{"x": int(u), "y": int(v), "label": "disc"}]}),
    "pixels": lambda u, v: _json({"points": [{"x": int(u), "y": int(v), "label": "disc"}]}),
}


def _json(said):
    return json.dumps(said)


def _m(value, size):
    return round(1000 * value / size)


def seeing(convention="pixels", seed=0, **wrong):
    """A model that sees the canary of a seed and tells points in a certain way."""
    truth = draw_canary(seed)

    def answer(text, images):
        assert np.array_equal(images[-1], truth.image)
        if "Which number" in text:
            return _json({"reasoning": "", "choice": wrong.get("number", truth.number)})
        if "Which colour" in text:
            return _json({"reasoning": "", "choice": wrong.get("colour", truth.numbered)})
        assert truth.target in text
        return TOLD[convention](*wrong.get("pixel", truth.pixel)).replace("%", "")

    return answer
