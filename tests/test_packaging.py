"""The wheel, installed beside nothing of this checkout and run from an empty folder."""

import ast
import base64
import json
import os
import re
import subprocess
import sys
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

import tog_drake

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = "from tog_drake.sharing import program_digest; print(program_digest())"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, built without reaching for the network."""
    folder = tmp_path_factory.mktemp("dist")
    _run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT],
        cwd=ROOT,
    )
    (built,) = folder.iterdir()
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder that the wheel is installed to."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    _run([*pip, "--no-deps", "--no-index", "--no-compile", "--target", folder, wheel], cwd=folder)
    return folder


def _run(command, *, cwd, **environment):
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _files(folder, pattern):
    return {str(path.relative_to(ROOT)) for path in (ROOT / folder).rglob(pattern)}


def _inside(wheel):
    return set(zipfile.ZipFile(wheel).namelist())


def test_the_wheel_holds_the_package_with_its_templates(wheel):
    wanted = {*_files("tog_drake", "*.py"), *_files("tog_drake", "*.j2"), "tog_drake/py.typed"}
    assert "tog_drake/templates/report.html.j2" in wanted
    assert wanted <= _inside(wheel)


@pytest.mark.parametrize(
    ("folder", "pattern"),
    [
        ("models", "*.sdf"),
        ("models", "*.urdf"),
        ("models", "*.obj"),
        ("models", "*.yaml"),
        ("models", "package.xml"),
        ("diagrams", "*.yaml"),
    ],
)
def test_the_wheel_holds_models_and_scenarios_inside_the_package(wheel, folder, pattern):
    wanted = _files(folder, pattern)
    assert wanted
    assert {f"tog_drake/{name}" for name in wanted} <= _inside(wheel)


def test_the_wheel_holds_nothing_else(wheel):
    for name in _inside(wheel):
        top, *rest = Path(name).parts
        assert top == "tog_drake" or top.endswith(".dist-info"), name
        assert not {"tests", "notebooks", "__pycache__", "out"} & {top, *rest}, name
        assert not name.endswith((".pyc", ".tmp", "~")), name


def test_everything_that_is_imported_is_a_declared_dependency(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (metadata,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        text = archive.read(metadata).decode()
    needs = re.findall(r"^Requires-Dist: ([\w.-]+)(?!.*extra == 'dev')", text, re.M)
    declared = {_normal(name) for name in needs}
    assert "drake" in declared
    assert "pytest" not in declared
    distributions = packages_distributions()
    for path in (ROOT / "tog_drake").rglob("*.py"):
        for module in _imported(path) - sys.stdlib_module_names - {"tog_drake"}:
            names = {_normal(name) for name in distributions.get(module, [module])}
            assert names & declared, f"{path.name} imports {module}, of {names}: not declared"


def _normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def _imported(path):
    """The top-level names of all modules that a file imports, lazily or not."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


def test_the_installed_copy_lists_its_scenarios_from_an_empty_folder(installed, tmp_path):
    run = {"cwd": tmp_path, "PYTHONPATH": str(installed)}
    where = _run([sys.executable, "-c", "import tog_drake; print(tog_drake.__file__)"], **run)
    assert Path(where.strip()) == installed / "tog_drake" / "__init__.py"
    assert Path(where.strip()) != Path(tog_drake.__file__)
    out = _run([sys.executable, "-m", "tog_drake.cli", "scenarios", "--json"], **run)
    listed = json.loads(out.splitlines()[-1])
    assert set(listed) == {path.stem for path in (ROOT / "diagrams").glob("*.yaml")}
    assert list(tmp_path.iterdir()) == []


def test_the_installed_copy_is_the_same_program_as_the_checkout(installed, tmp_path):
    told = [
        _run(
            [sys.executable, "-B", "-c", PROGRAM],
            cwd=tmp_path,
            PYTHONPATH=str(place),
        )
        for place in (installed, ROOT)
    ]
    assert told[0] == told[1]


def test_the_installed_copy_builds_a_world_of_its_own_models(installed, tmp_path):
    command = [sys.executable, "-m", "tog_drake.cli", "show", "Mug", "--out", "mug.html"]
    _run(command, cwd=tmp_path, PYTHONPATH=str(installed))
    assert [path.name for path in tmp_path.iterdir()] == ["mug.html"]
    page = (tmp_path / "mug.html").read_text(encoding="utf-8")
    scene = b"".join(base64.b64decode(m) for m in re.findall(r"base64,([\w+/]+=*)", page))
    assert b"panda_link7" in scene
    assert b"mug" in scene


def test_the_wheel_gives_the_command_tog(installed):
    (entry,) = installed.glob("*.dist-info/entry_points.txt")
    assert "tog = tog_drake.cli:main" in entry.read_text(encoding="utf-8")
    assert (installed / "bin" / "tog").is_file()
