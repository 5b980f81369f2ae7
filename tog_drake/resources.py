"""Where the package's own models and scenarios are, wherever it is installed."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydrake.multibody.parsing import PackageMap

_PACKAGE = Path(__file__).resolve().parent


def resource_dir(name: str) -> Path:
    """Returns the folder ``models`` or ``diagrams``.

    A wheel carries both inside the package; in a checkout they lie beside it.
    """
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def scenario_files() -> dict[str, Path]:
    """Returns the scenarios that come with the package, by name."""
    return {path.stem: path for path in sorted(resource_dir("diagrams").glob("*.yaml"))}


def make_package_map() -> "PackageMap":
    """Returns Drake's package map: ``package://tog_drake/`` is our ``models`` folder.

    ``package://tog_assets/`` is the folder of imported objects, where there is one.
    """
    from pydrake.multibody.parsing import PackageMap

    from tog_drake.assets.library import PACKAGE, library_dir

    package_map = PackageMap()
    package_map.AddPackageXml(str(resource_dir("models") / "package.xml"))
    if library_dir().is_dir():
        package_map.Add(PACKAGE, str(library_dir()))
    return package_map
