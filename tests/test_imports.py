"""What is heavy or optional is loaded by nobody who does not use it."""

import json
import subprocess
import sys

import pytest

import tog_drake

HEAVY = (
    *("torch", "transformers", "huggingface_hub", "cv2", "requests"),
    *("trimesh", "fast_simplification", "coacd", "PIL", "platformdirs", "pyrealsense2"),
)
WITH_TORCH = [
    f"tog_drake.proposers.contact_graspnet.{name}"
    for name in ("network", "layers", "decoding", "workers", "checkpoint", "trial")
]  # all that needs torch when it is loaded


def _loaded(program):
    """The modules that are loaded after ``program``, in a Python of its own."""
    program += "\nimport json, sys; sys.stderr.write(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stderr.splitlines()[-1]))


def _help(*arguments):
    return f"""
import sys
from tog_drake.cli import main
sys.argv = ["tog", *{arguments!r}, "--help"]
try:
    main()
except SystemExit as ended:
    assert ended.code == 0
"""


@pytest.mark.parametrize(
    "program",
    [
        "import tog_drake",
        _help(),
        *map(_help, ("run", "choose", "replay", "prompts")),
        _help("vlm", "check"),
        _help("assets", "import"),
        _help("serve", "proposer"),
        _help("weights", "check"),
        _help("hardware", "emulate"),
        _help("hardware", "run"),
    ],
    ids=[
        "import",
        "help",
        "run --help",
        "choose --help",
        "replay --help",
        "prompts --help",
        "vlm check --help",
        "assets import --help",
        "serve proposer --help",
        "weights check --help",
        "hardware emulate --help",
        "hardware run --help",
    ],
)
def test_neither_the_package_nor_its_help_loads_anything_heavy(program):
    loaded = _loaded(program)
    assert "tog_drake" in loaded
    assert loaded.isdisjoint({*HEAVY, "pydrake", "scipy"})


def test_every_module_can_be_loaded_without_what_is_optional():
    program = f"""
import importlib, pkgutil, tog_drake
for module in pkgutil.walk_packages(tog_drake.__path__, "tog_drake."):
    if module.name not in {WITH_TORCH}:
        importlib.import_module(module.name)
"""
    assert _loaded(program).isdisjoint(HEAVY)


@pytest.mark.parametrize("name", tog_drake.__all__)
def test_every_public_name_is_there_when_it_is_asked_for(name):
    assert getattr(tog_drake, name).__name__ == name


def test_an_unknown_public_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Kuka'"):
        _ = tog_drake.Kuka
