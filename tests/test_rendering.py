import ctypes
import re

import pytest
from pydrake.geometry import Rgba

from tog_drake import rendering
from tog_drake.errors import InputError


@pytest.fixture(autouse=True)
def _forget():
    rendering.rendering_problem.cache_clear()
    yield
    rendering.rendering_problem.cache_clear()


def test_this_machine_renders():
    assert rendering.rendering_problem() is None
    assert re.fullmatch(r"first 64×48 image after \d+\.\d s", rendering.render_probe())


def test_a_missing_egl_library_is_named_with_its_package(monkeypatch):
    def missing(name, *args, **kwargs):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(rendering.sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", missing)
    with pytest.raises(InputError, match=r"libEGL\.so\.1 is missing; .*apt-get install libegl1"):
        rendering.make_render_engine(Rgba(1, 1, 1, 1))


def test_a_missing_driver_is_named_before_anything_crashes(monkeypatch):
    monkeypatch.setattr(rendering, "_initializes", lambda egl, display: False)
    with pytest.raises(InputError, match=r"no graphics driver.*libgl1-mesa-dri"):
        rendering.make_render_engine(Rgba(1, 1, 1, 1))
