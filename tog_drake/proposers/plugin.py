"""Proposers of other packages, found by the entry points ``tog_drake.proposers``.

A package adds one with a line in its pyproject.toml and a class::

    [project.entry-points."tog_drake.proposers"]
    my-network = "my_package:MyNetwork"

    @dataclass
    class MyNetwork:                                  # its settings, each with a default
        checkpoint: str = "model.pt"

        def make_proposer(self, workspace: Workspace, seed: int) -> Proposer:
            return MyProposer(self, workspace, seed)  # see ``tog_drake.proposer.Proposer``

Then ``--proposer my-network`` takes it, or in a scenario ``proposer: !Plugin {name: my-network,
options: {checkpoint: other.pt}}``. It is imported when it is asked for, not before.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, is_dataclass, make_dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

import yaml
from pydrake.common.yaml import yaml_load_typed
from pydrake.perception import PointCloud

from tog_drake.errors import InputError, NoGrasp, TogError
from tog_drake.proposers.grasp_document import (
    BadDocument,
    HoldNothing,
    grasps_in_world,
    read_document,
)
from tog_drake.schema_check import check_yaml
from tog_drake.values import Grasps, View, Workspace

GROUP = "tog_drake.proposers"
T = TypeVar("T")


@dataclass
class Plugin:
    """A proposer of another package: `!Plugin {name: my-network}`."""

    name: str = ""  # of its entry point
    options: dict[str, bool | int | float | str] = field(default_factory=dict)
    """Its settings; what is not given is as the package has it."""


def plugin_names() -> list[str]:
    """Returns the names of the proposers that other packages add; nothing is imported."""
    return sorted({entry.name for entry in entry_points(group=GROUP)})


class PluginProposer:
    """Proposes what another package's proposer does, checked (a ``Proposer``).

    Raises:
        InputError: there is no such proposer, or it cannot be used; it names the package.
    """

    def __init__(self, config: Plugin, workspace: Workspace, seed: int):
        if not config.name:
            raise InputError("!Plugin lacks its name; valid: !Plugin {name: NAME}")
        entry = _entry(config.name)
        self._who = f"the proposer {config.name!r} of {_package(entry)}"
        kind = self._call("cannot be imported", entry.load)
        if not (isinstance(kind, type) and is_dataclass(kind) and hasattr(kind, "make_proposer")):
            raise InputError(
                f"{self._who} is no proposer: {entry.value} must be a dataclass with the method "
                "make_proposer(workspace, seed); tell its authors"
            )
        settings = self._call("does not take its options", lambda: self._settings(kind, config))
        self._proposer = self._call(
            "cannot be made", lambda: settings.make_proposer(workspace, seed)
        )

    def propose(self, cloud: PointCloud, view: View) -> Grasps:
        """Returns grasps, best first, possibly none.

        Raises:
            InputError: the package's proposer failed, or what it returned are no grasps.
            NoGrasp: most of them hold nothing that was seen.
        """
        grasps = self._call("failed", lambda: self._proposer.propose(cloud, view))
        if not isinstance(grasps, Grasps):
            raise InputError(f"{self._who} returned a {type(grasps).__name__}; valid: Grasps")
        arrays = {
            "poses": grasps.X_WG,
            "scores": grasps.score,
            "widths": grasps.width,
            "contacts": grasps.p_WContact,
        }
        try:
            found = read_document(arrays, frame="world", gripper="G")
        except BadDocument as error:
            raise InputError(f"{self._who} returned what are no grasps: {error}") from error
        try:
            return grasps_in_world(found, cloud, view.X_WC)
        except HoldNothing as error:
            raise NoGrasp(f"{self._who}: {error}") from error

    def _settings(self, kind: type, config: Plugin) -> Any:
        """The package's dataclass with the options in their place, as Drake loads a scenario."""
        schema = make_dataclass("Schema", [("options", kind, field(default_factory=kind))])
        text = check_yaml(schema, yaml.safe_dump({"options": config.options}), self._who)
        return yaml_load_typed(schema=schema, data=text, defaults=schema()).options

    def _call(self, trouble: str, work: Callable[[], T]) -> T:
        """Runs code of the package; what it raises, other than our own errors, names it."""
        try:
            return work()
        except TogError:
            raise
        except (Exception, SystemExit) as error:
            raise InputError(
                f"{self._who} {trouble} ({type(error).__name__}: {error}); install it anew or tell "
                "its authors (--debug shows where)"
            ) from error


def _entry(name: str) -> EntryPoint:
    """The entry point of that name; raises InputError where there is none, or more than one."""
    found = {
        (_package(entry), entry.value): entry for entry in entry_points(group=GROUP, name=name)
    }
    if not found:
        installed = ", ".join(plugin_names()) or "none is installed"
        raise InputError(f"no package adds a proposer {name!r}; valid: {installed}")
    if len(found) > 1:
        packages = " and ".join(package for package, _ in found)
        raise InputError(f"{packages} both add a proposer {name!r}; uninstall one of them")
    return next(iter(found.values()))


def _package(entry: EntryPoint) -> str:
    return "a package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
