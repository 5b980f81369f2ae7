import importlib
import shutil
import subprocess
from collections import namedtuple

import pytest

from tog_drake import cli, doctor
from tog_drake.selectors.vlm.anthropic import Anthropic
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import OpenAi


@pytest.fixture(scope="module")
def checks():
    """What the doctor finds on this machine, by name."""
    return {check.name: check for check in doctor.run_checks()}


def _exit_status(monkeypatch, found):
    monkeypatch.setattr(doctor, "run_checks", lambda: found)
    with pytest.raises(SystemExit) as ended:
        cli.app(["doctor"], prog_name="tog")
    return ended.value.code


def test_everything_that_the_tests_need_is_found_with_its_version(checks):
    required = {name: check for name, check in checks.items() if check.required}
    assert set(required) == {
        "Python", "Drake", "numpy", "scipy", "OpenCV", "models", "rendering", "Meshcat", "disk"
    }  # fmt: skip
    assert [check for check in required.values() if not check.ok] == []
    assert required["Drake"].found.startswith("1.")
    assert "http://localhost" in required["Meshcat"].found
    assert required["rendering"].found.startswith("first 64×48 image")


def test_optional_extras_are_listed_with_the_command_that_installs_them(checks, monkeypatch):
    assert not checks["weights of contact-graspnet"].required
    assert not checks["weights of view scorer detector"].required
    extras = [name for name in checks if "extra" in name]
    assert [name.split()[1] for name in extras] == ["[cgn]", "[views]", "[notebooks]"]
    monkeypatch.setattr(importlib, "import_module", _not_there)
    missing = doctor._check("extra", lambda: doctor._extra("torch", "cgn"), required=False)
    assert not missing.ok
    assert missing.found == "install it with: pip install 'tog_drake[cgn]'"


def _not_there(name):
    raise ImportError(f"No module named {name!r}")


KEYS = (
    "OPENAI_API_KEY", "GOOGLE_API_KEY", "GEMINI_API_KEY", "ANTHROPIC_API_KEY", "VLM_API_KEY"
)  # fmt: skip


def test_it_says_whether_a_key_is_set_and_nothing_else_of_it(monkeypatch):
    for variable in KEYS:
        monkeypatch.setenv(variable, "sk-planted-0123456789")
    found = [doctor._check("key", lambda v=v: doctor._key(v)) for v in doctor._KEYS.values()]
    assert [(check.ok, check.found) for check in found] == [
        (True, "set in OPENAI_API_KEY"),
        (True, "set in GOOGLE_API_KEY"),
        (True, "set in ANTHROPIC_API_KEY"),
        (True, "set in VLM_API_KEY"),
    ]


def test_what_cannot_be_a_key_is_said_without_repeating_it(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-planted\x1b[2J 0123456789")
    check = doctor._check("key", lambda: doctor._key(doctor._KEYS["OpenAI"]), required=False)
    assert not check.ok
    assert "OPENAI_API_KEY" in check.found
    assert "planted" not in check.found


@pytest.mark.parametrize("provider", [OpenAi, Gemini, Anthropic])
def test_a_key_is_looked_for_where_the_provider_takes_it_from(provider, monkeypatch):
    variables = doctor._KEYS[provider.__name__.replace("Ai", "AI")]
    config = provider(model="any")
    for other in KEYS:
        monkeypatch.delenv(other, raising=False)
    for variable in reversed(variables):  # each in turn is taken before those after it
        monkeypatch.setenv(variable, f"key-of-{variable}")
        assert f"key-of-{variable}" in " ".join(config.headers().values())
        assert doctor._key(variables) == f"set in {variable}"


@pytest.mark.parametrize("key", [None, "", "  "])
def test_a_key_that_is_missing_or_empty_comes_with_the_command_that_sets_it(key, monkeypatch):
    for variable in KEYS:
        if key is None:
            monkeypatch.delenv(variable, raising=False)
        else:
            monkeypatch.setenv(variable, key)
    check = doctor._check("key", lambda: doctor._key(doctor._KEYS["Gemini"]), required=False)
    assert (check.ok, check.found) == (False, "set it with: export GEMINI_API_KEY=...")
    monkeypatch.setenv("GEMINI_API_KEY", "x")
    assert doctor._key(doctor._KEYS["Gemini"]) == "set in GEMINI_API_KEY"


def test_a_module_that_is_installed_but_cannot_be_loaded_is_a_problem(monkeypatch):
    def broken(name):
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", broken)
    found = {check.name: check for check in doctor.run_checks()}["OpenCV"]
    assert not found.ok
    assert "libGL.so.1" in found.found


def test_a_package_that_is_not_installed_comes_with_the_command(monkeypatch):
    check = doctor._check("x", lambda: doctor._version("no-such-distribution-here"))
    assert not check.ok
    assert check.found == "missing; install it with: pip install no-such-distribution-here"


def test_a_renderer_that_crashes_takes_only_its_own_process_down(monkeypatch):
    crash = subprocess.CompletedProcess([], returncode=-11, stdout="", stderr="driver\nno display")
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: crash)
    check = doctor._check("rendering", doctor._rendering)
    assert not check.ok
    assert check.found == "a test image failed with status -11: no display"


def test_a_full_disk_is_a_problem(monkeypatch):
    usage = namedtuple("usage", "free")(3e8)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    check = doctor._check("disk", doctor._disk)
    assert not check.ok
    assert check.found == "0.3 GB free here; 1 GB is needed"


@pytest.mark.parametrize(
    ("ok", "required", "mark", "status"),
    [
        (True, True, "ok", 0),
        (False, False, "missing", 0),
        (False, True, "PROBLEM", 1),
    ],
)
def test_only_what_is_needed_makes_the_command_fail(
    ok, required, mark, status, monkeypatch, capsys
):
    check = doctor.Check("thing", ok, "found " + 90 * "x", required)
    assert _exit_status(monkeypatch, [check]) == status
    (line,) = capsys.readouterr().out.splitlines()  # never broken in two
    assert line.startswith(mark)
    assert line.endswith("x")
