"""Checks whether this machine can run tog_drake, and says how to mend what it cannot."""

import importlib
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from tog_drake.weights import MODELS, stored

if TYPE_CHECKING:
    from tog_drake.scenario import Scenario

_LEAST_FREE = 1_000_000_000  # [bytes] for reports and caches
# extra -> (module, what it is for)
_EXTRAS = {
    "cgn": ("torch", "Contact-GraspNet"),
    "views": ("transformers", "view scorer detector"),
    "notebooks": ("ipykernel", "notebooks"),
}
# provider -> environment variables that its key is looked for in, in that order
_KEYS = {
    "OpenAI": ("OPENAI_API_KEY",),
    "Gemini": ("GOOGLE_API_KEY", "GEMINI_API_KEY"),
    "Anthropic": ("ANTHROPIC_API_KEY",),
    "other servers": ("VLM_API_KEY",),
}


@dataclass(frozen=True)
class Check:
    """One thing that was checked."""

    name: str
    ok: bool
    found: str
    required: bool = True  # False: only some commands need it


def run_checks() -> list[Check]:
    """Returns every check in order; none of them raises."""
    checks = [
        _check("Python", _python),
        _check("Drake", lambda: _version("drake", "pydrake")),
        _check("numpy", lambda: _version("numpy")),
        _check("scipy", lambda: _version("scipy")),
        _check("OpenCV", lambda: _version("opencv-python-headless", "cv2")),
        _check("models", _models),
        _check("rendering", _rendering),
        _check("Meshcat", _meshcat),
        _check("disk", _disk),
        _check("graphviz (tog diagram)", _graphviz, required=False),
    ]
    for provider, variables in _KEYS.items():
        checks.append(_check(f"key of {provider}", partial(_key, variables), required=False))
    for extra, (module, purpose) in _EXTRAS.items():
        checks.append(
            _check(
                f"extra [{extra}] ({purpose})",
                partial(_extra, module, extra),
                required=False,
            )
        )
    for name in MODELS:
        checks.append(_check(f"weights of {name}", partial(_weights, name), required=False))
    checks.append(_check("weights of view scorer detector", _detector_weights, required=False))
    return checks


def camera_checks(scenario: "Scenario") -> list[Check]:
    """Returns, for each camera but the pipeline's own, how far its pose is off against that one.

    The scenario is simulated: its cameras look at what stands there.

    Raises:
        InputError: the scenario cannot be built.
    """
    from tog_drake.scenario import model_files
    from tog_drake.world import build_world, look

    own = scenario.pipeline.camera
    if len(scenario.cameras) == 1:
        return [Check("cameras", True, f"{own} is the only one: nothing to compare it with")]
    scenario.pipeline.cloud.fuse = True
    world = build_world(scenario, target=next(iter(model_files(scenario)), None))
    context = look(world, scenario, "pick it up").get_context()
    mine = world.pipeline.GetMyContextFromRoot(context)
    found = world.pipeline.GetOutputPort("alignments").Eval(mine)
    return [
        Check(f"camera {camera}", alignment.tolerable, alignment.said(own))
        for camera, alignment in found.items()
    ]


class _ProblemError(Exception):
    """What is wrong and how to mend it."""


def _check(name: str, look: Callable[[], str], required: bool = True) -> Check:
    try:
        return Check(name, True, look(), required)
    except Exception as error:  # whatever breaks is the finding
        return Check(name, False, str(error) or type(error).__name__, required)


def _python() -> str:
    return f"{platform.python_version()} on {platform.platform()}"


def _version(distribution: str, module: str | None = None) -> str:
    try:
        version = metadata.version(distribution)
    except metadata.PackageNotFoundError as error:
        raise _ProblemError(f"missing; install it with: pip install {distribution}") from error
    importlib.import_module(module or distribution)  # a system library that it needs may be missing
    return version


def _models() -> str:
    from tog_drake.resources import resource_dir, scenario_files

    if not scenario_files():
        raise _ProblemError(f"no scenarios in {resource_dir('diagrams')}; reinstall tog_drake")
    return f"{len(scenario_files())} scenarios in {resource_dir('diagrams')}"


def _rendering() -> str:
    """Renders one image in a process of its own: a broken driver would take this one down."""
    from tog_drake.rendering import rendering_problem

    problem = rendering_problem()
    if problem:
        raise _ProblemError(problem)
    program = "from tog_drake.rendering import render_probe; print(render_probe())"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise _ProblemError(f"a test image failed with status {done.returncode}: {last}")
    return done.stdout.strip()


def _meshcat() -> str:
    from tog_drake.visualization import make_meshcat

    return f"answers at {make_meshcat().web_url()}"


def _disk() -> str:
    free = shutil.disk_usage(Path.cwd()).free
    if free < _LEAST_FREE:
        raise _ProblemError(f"{free / 1e9:.1f} GB free here; {_LEAST_FREE / 1e9:.0f} GB is needed")
    return f"{free / 1e9:.0f} GB free"


def _graphviz() -> str:
    if shutil.which("dot") is None:
        raise _ProblemError("install it with: sudo apt-get install graphviz")
    return str(shutil.which("dot"))


def _extra(module: str, extra: str) -> str:
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise _ProblemError(f"install it with: pip install 'tog_drake[{extra}]'") from error
    return metadata.version(module)


def _weights(name: str) -> str:
    found = stored(MODELS[name])
    if found is None:
        raise _ProblemError(f"get them with: tog weights fetch {name} --accept-licence")
    return f"{found.note}, {found.file}"


def _detector_weights() -> str:
    from tog_drake.view_scorers.detector import MODEL, find_weights, require_transformers

    require_transformers()
    return f"{MODEL}, {find_weights(MODEL, None)}"


def _key(variables: Sequence[str]) -> str:
    """Says where the key is set, and nothing of the key itself."""
    from tog_drake.selectors.vlm.keys import read_key

    for variable in variables:
        if read_key(variable, "https://"):
            return f"set in {variable}"
    raise _ProblemError(f"set it with: export {variables[-1]}=...")
