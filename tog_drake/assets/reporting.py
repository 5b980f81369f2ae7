"""What an import found out about an object, in words."""

from collections.abc import Mapping
from typing import Any

UNREADABLE = "its report cannot be read; import it again"


def line_of(report: Mapping[str, Any]) -> str:
    """Returns the short form of an import report: size, mass, and how it lies."""
    try:
        rest = "lies still" if report["settled"]["ok"] else "does not lie still"
        return f"{_extent(report)}, {report['mass']:.3g} kg, {rest}"
    except (KeyError, TypeError, ValueError):
        return UNREADABLE


def details_of(report: Mapping[str, Any]) -> str:
    """Returns what else an import found out, on one line: what it is made of, and how it lies."""
    try:
        settled = report["settled"]
        closed, textured = ("" if report[key] else "not " for key in ("watertight", "textured"))
        return (
            f"{1e6 * report['volume']:.1f} cm³, {closed}closed, {textured}textured, "
            f"{report['pieces']} convex pieces; on the table: "
            f"penetration {1000 * settled['penetration']:.2f} mm, drift "
            f"{1000 * settled['drift']:.3f} mm, speed {1000 * settled['speed']:.3f} mm/s"
        )
    except (KeyError, TypeError, ValueError):
        return UNREADABLE


def changes_of(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Returns what another import of an object has changed, such as "mass 0.5 kg -> 0.2 kg"."""
    try:
        said = [
            (what, of(before), of(after))
            for what, of in (
                ("file", lambda report: str(report["file"])),
                ("extent", _extent),
                ("mass", lambda report: f"{report['mass']:.3g} kg, by {report['inertia_from']}"),
            )
        ]
    except (KeyError, TypeError, ValueError):
        return "what it was cannot be read"
    changed = [f"{what} {old} -> {new}" for what, old, new in said if old != new]
    return "; ".join(changed) or "same file, extent and mass"


def rows_of(report: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns an import report as rows for a person: what, and how much."""
    try:
        settled, faces = report["settled"], report["faces"]
        return [
            ("file", str(report["file"])),
            *((str(what), str(value)) for what, value in report["source"].items()),
            ("extent", _extent(report)),
            ("volume", f"{1e6 * report['volume']:.1f} cm³"),
            ("mass", f"{report['mass']:.4g} kg, by {report['inertia_from']}"),
            ("surface", "closed" if report["watertight"] else "not closed"),
            ("texture", "yes" if report["textured"] else "no"),
            ("faces", f"{faces['file']} in the file, {faces['core']} of the collision surface"),
            ("convex pieces", str(report["pieces"])),
            ("on the table", "lies still" if settled["ok"] else "does not lie still"),
            ("  penetration", f"{1000 * settled['penetration']:.2f} mm"),
            ("  drift", f"{1000 * settled['drift']:.3f} mm in a second"),
            ("  speed", f"{1000 * settled['speed']:.3f} mm/s"),
            ("  turned", f"{settled['turned']:.0f}° from how it was put down"),
            ("imported in", f"{report['seconds']:.1f} s"),
            *(("note", str(note)) for note in report["notes"]),
        ]
    except (KeyError, TypeError, ValueError, AttributeError):
        return [("report", UNREADABLE)]


def _extent(report: Mapping[str, Any]) -> str:
    length, width, height = (100 * side for side in report["extent"])
    return f"{length:.1f} x {width:.1f} x {height:.1f} cm"
