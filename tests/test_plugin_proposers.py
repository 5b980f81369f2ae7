"""Proposers that other packages add by an entry point: found, configured, checked, or blamed."""

import itertools
import json
import os
import subprocess
import sys
import textwrap

import cv2
import numpy as np
import pytest
from command import refused, tog
from tabletop import RED, TABLE, look
from things import box, cloud

from tog_drake.errors import InputError, NoGrasp
from tog_drake.options import ProposerOptions
from tog_drake.pipeline import PipelineConfig, make_proposer
from tog_drake.proposers.plugin import Plugin, plugin_names
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import View

SEEN = cloud((box((-0.10, -0.012, 0.004), (0.10, 0.012, 0.031)), (150, 0, 0)))

MODULE = '''
from dataclasses import dataclass

import numpy as np

from tog_drake.values import Grasps


@dataclass
class Highest:
    """One grasp from above on the highest point."""

    depth: float = 0.01  # [m] below it
    count: int = 1

    def make_proposer(self, workspace, seed):
        return HighestProposer(self)


class HighestProposer:
    def __init__(self, config):
        self.config = config

    def propose(self, cloud, view):
        points = cloud.xyzs().T.astype(float)
        top = points[points[:, 2].argmax()]
        X_WG = np.diag([1.0, -1.0, -1.0, 1.0])
        X_WG[:3, 3] = top - [0, 0, self.config.depth]
        n = self.config.count
        score = np.linspace(0.5, 0.9, n) if n > 1 else np.array([0.9])
        return Grasps(np.tile(X_WG, (n, 1, 1)), np.full(n, 0.024), score, np.tile(top, (n, 1)))
'''

numbers = itertools.count()


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Makes a package importable that adds a proposer, as an installer would leave it."""

    def installed(source, *, name="highest", attribute="Highest", package="highest-point"):
        folder = tmp_path / package
        info = folder / f"{package.replace('-', '_')}-1.2.dist-info"
        info.mkdir(parents=True)
        module = f"plugged_in_{next(numbers)}"
        (folder / f"{module}.py").write_text(textwrap.dedent(source))
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        group = "[tog_drake.proposers]\n"
        (info / "entry_points.txt").write_text(f"{group}{name} = {module}:{attribute}\n")
        monkeypatch.syspath_prepend(folder)
        return module

    return installed


def proposed(**plugin):
    config = PipelineConfig(proposer=Plugin(**plugin))
    return make_proposer(config, 0).propose(SEEN, View.empty())


def test_a_proposer_of_another_package_proposes(install):
    install(MODULE)
    assert plugin_names() == ["highest"]
    grasps = proposed(name="highest")
    assert grasps.X_WG[0, 2, 3] == pytest.approx(0.031 - 0.01, abs=0.002)
    deeper = proposed(name="highest", options={"depth": 0.02, "count": 3})
    assert deeper.X_WG[0, 2, 3] == pytest.approx(0.031 - 0.02, abs=0.002)
    assert deeper.score.tolist() == pytest.approx([0.9, 0.7, 0.5])  # best first


def test_a_scenario_names_it_by_a_tag_and_the_command_by_its_name(install):
    install(MODULE)
    text = "pipeline: {proposer: !Plugin {name: highest, options: {depth: 0.02, count: 2}}}"
    config = parse_scenario(text, "text", Scenario()).pipeline
    assert config.proposer == Plugin("highest", {"depth": 0.02, "count": 2})
    ProposerOptions("highest").apply(config)  # the same: its options stay
    assert config.proposer.options == {"depth": 0.02, "count": 2}
    other = PipelineConfig()
    ProposerOptions("highest").apply(other)
    assert other.proposer == Plugin("highest")


def test_it_is_imported_only_when_it_is_asked_for(install):
    module = install(MODULE)
    ProposerOptions("antipodal").apply(PipelineConfig())
    with pytest.raises(InputError, match=r"unknown proposer 'highes'; valid: .*, highest"):
        ProposerOptions("highes").apply(PipelineConfig())
    assert module not in sys.modules
    ProposerOptions("highest").apply(PipelineConfig())
    assert module in sys.modules


def test_our_own_proposers_cannot_be_replaced_by_a_package(install):
    module = install(MODULE, name="antipodal")
    config = PipelineConfig()
    ProposerOptions("antipodal").apply(config)
    assert config == PipelineConfig()
    assert module not in sys.modules


IMPORTED = "from tog_drake.errors import NoGrasp\n" + MODULE
WHO = "the proposer 'highest' of highest-point 1.2"
BROKEN = {
    "cannot be imported": ("import no_such_module", {}, "cannot be imported.*no_such_module"),
    "is no Python": ("def", {}, "cannot be imported.*SyntaxError"),
    "ends the program": ("import sys; sys.exit(7)", {}, "cannot be imported.*SystemExit: 7"),
    "has no such name": ("x = 1", {}, "cannot be imported.*Highest"),
    "is no class": ("Highest = 3", {}, r"is no proposer: .*make_proposer\(workspace, seed\)"),
    "is no dataclass": ("class Highest:\n    make_proposer = 1", {}, "is no proposer"),
    "has no default": (
        MODULE.replace("depth: float = 0.01", "depth: float"), {}, "does not take its options",
    ),
    "option": (MODULE, {"dept": 1.0}, r"options has no field 'dept' \(did you mean depth\?\)"),
    "text": (MODULE, {"depth": "deep"}, "options.depth must be a number, not 'deep'"),
    "cannot be made": (
        MODULE.replace("return HighestProposer(self)", "1 / 0"), {}, "cannot be made.*ZeroDiv",
    ),
    "fails": (MODULE.replace("n = self.config.count", "n = self.nothing"), {}, "failed.*nothing"),
    "returns nothing": (MODULE.replace("return Grasps", "Grasps"), {}, "returned a NoneType"),
    "nan": (MODULE.replace("[0.9]", "[np.nan]"), {}, r"no grasps: scores\[0\] is not finite"),
    "mirrored": (MODULE.replace("-1.0, -1.0, 1.0", "1.0, -1.0, 1.0"), {}, "no rigid transform"),
    "too wide": (MODULE.replace("0.024", "0.24"), {}, r"widths\[0\] is 0.24"),
    "shapes": (MODULE.replace("np.tile(top, (n, 1))", "top"), {}, "contacts"),
    "too many": (MODULE, {"count": 2001}, "at most 2000"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_what_is_wrong_with_a_package_names_the_package(case, install):
    source, options, message = BROKEN[case]
    install(source)
    with pytest.raises(InputError, match=message) as caught:
        proposed(name="highest", options=options)
    assert str(caught.value).startswith(WHO)


def test_what_it_says_of_the_scene_is_passed_on_as_it_is(install):
    install(IMPORTED.replace("n = self.config.count", "raise NoGrasp('all too flat')"))
    with pytest.raises(NoGrasp, match=r"^all too flat$"):
        proposed(name="highest")


def test_a_plugin_without_a_name_is_told_so():
    with pytest.raises(InputError, match="!Plugin lacks its name"):
        proposed()


def test_grasps_beside_what_is_seen_are_refused_by_the_packages_name(install):
    install(MODULE.replace("- [0, 0, self", "+ [0.5, 0, self"))
    with pytest.raises(NoGrasp, match=rf"{WHO}: 1 of the 1 grasps have nothing .*'world'.*'G'"):
        proposed(name="highest")


def test_two_packages_with_the_same_name_are_told_and_none_is_taken(install):
    install(MODULE)
    install(MODULE, package="other-point")
    with pytest.raises(InputError, match=r"point 1.2 and .*point 1.2 both add .*'highest'"):
        proposed(name="highest")
    with pytest.raises(InputError, match="no package adds a proposer 'lowest'; valid: highest"):
        proposed(name="lowest")


def test_a_broken_package_is_one_line_before_anything_starts(install, tmp_path):
    install("import no_such_module")
    run = ("run", "--no-meshcat", "--task", "use the hammer", "--out", tmp_path / "out")
    refused(tog(*run, "--proposer", "highest"), WHO, "no_such_module")
    assert not (tmp_path / "out").exists()


def test_a_package_that_is_installed_by_pip_is_what_tog_choose_can_take(tmp_path):
    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()
    (source / "highest.py").write_text(MODULE)
    (source / "pyproject.toml").write_text(
        """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "highest-point"
version = "1.2"

[project.entry-points."tog_drake.proposers"]
highest = "highest:Highest"

[tool.hatch.build.targets.wheel]
only-include = ["highest.py"]
"""
    )
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-index", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, *offline, "--target", site, source], check=True, timeout=300)
    view = look([TABLE, ((0.46, -0.012, 0.0), (0.50, 0.012, 0.05), RED)])
    cv2.imwrite(str(tmp_path / "color.png"), view.rgb[..., ::-1])
    np.save(tmp_path / "depth.npy", view.depth)
    (tmp_path / "camera.json").write_text(json.dumps(vars(view.intrinsics)))
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tog_drake.cli", "choose", "--rgb", "color.png"),
            *("--depth", "depth.npy", "--intrinsics", "camera.json", "--task", "take the block"),
            *("--selector", "top-score", "--proposer", "highest", "--json", "--out", "out"),
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["proposer"] == {"kind": "plugin", "name": "highest", "options": {}}
    assert (record["counts"]["proposed"], record["choice"]["score"]) == (1, 0.9)
