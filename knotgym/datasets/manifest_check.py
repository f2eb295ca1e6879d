"""The manifest of a folder that a run made: read back, and its checksums compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import sha256
from knotgym.common.configuration import read_json
from knotgym.common.errors import KnotgymError, one_line, printable
from knotgym.states.state_file import leads_out

_NUMBER = (Real,)
_COUNTS = {str: _NUMBER}
# what is read of a run's report, where it is there: {type: shape} for an object of such, [shape]
# for a list, (type, ...) for a value
_REPORT: dict[str, Any] = {
    "attempts": _NUMBER,
    "actions": _NUMBER,
    "existing_codes": {str: (Real, type(None))},
    "rejected": {str: _COUNTS},
    "growth": [{"steps": _NUMBER, "known": _COUNTS, "accepted": _COUNTS}],
}


class InvalidManifest(KnotgymError, ValueError):
    """A manifest that says what none of ours says."""


def read_manifest(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """The manifest, which has `files` and `config`, empty if it can't be read; and that fault."""
    try:
        manifest = read_json(folder / "manifest.json")
        checked = {"files": manifest["files"], "config": manifest["config"]}
        for name, value in checked.items():
            if not isinstance(value, dict):
                raise InvalidManifest(f"{name} should be an object")
        _require_inside(checked["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        return {}, [f"manifest.json can't be read: {one_line(error)}"]
    return {**manifest, **checked}, []


def run_report(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What a manifest reports of the run that made states, empty if it isn't such a report."""
    report = manifest.get("report")
    if not isinstance(report, dict) or report_faults(manifest):
        return {}
    return report


def report_faults(manifest: Mapping[str, Any]) -> list[str]:
    """What is wrong in the report of a run that made states."""
    report = manifest.get("report", {})
    if not isinstance(report, dict):
        return ["manifest.json: report should be an object"]
    faults = [
        f"manifest.json: report.{name} isn't what a run reports"
        for name, shape in _REPORT.items()
        if name in report and not _fits(report[name], shape)
    ]
    if "rejected" in report and "attempts" not in report:
        faults.append("manifest.json: report.rejected counts without report.attempts")
    grown = [] if faults else report.get("growth", [])
    if any(not row["known"].keys() == row["accepted"].keys() for row in grown):
        faults.append("manifest.json: report.growth counts different nx in a row")
    return faults


def listed_faults(folder: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Files that the manifest lists and that are missing or of another checksum; and HDF5 and JSON
    files that it doesn't list.
    """
    found = sorted([*folder.rglob("*.h*5"), *folder.rglob("*.json")])
    there = (one for one in found if one.is_file() and one != folder / "manifest.json")
    for name in (path.relative_to(folder).as_posix() for path in there) if manifest else ():
        if name not in manifest.get("files", {}):
            yield f"{name} is not in the manifest"
    for name, digest in manifest.get("files", {}).items():
        if not (folder / name).is_file():
            yield f"{name} is missing"
        elif sha256(folder / name) != digest:
            yield f"{name} is not the file the manifest lists (SHA-256 differs)"


def _require_inside(files: Mapping[str, Any]) -> None:
    """Refuse names of files that lie elsewhere, or that no file of ours has.

    Raises:
        InvalidManifest: one is such.
    """
    for name in files:
        if not name or leads_out(name) or not name.isprintable():
            raise InvalidManifest(f"it lists {printable(name)!r}, which is no file in the folder")


def _fits(value: Any, shape: Any) -> bool:
    """Whether a value of JSON is of a shape, as _REPORT spells them."""
    if isinstance(shape, tuple):
        return isinstance(value, shape) and not isinstance(value, bool)
    if isinstance(shape, list):
        return isinstance(value, list) and all(_fits(one, shape[0]) for one in value)
    if not isinstance(value, dict):
        return False
    if str in shape:
        return all(name.isprintable() and _fits(one, shape[str]) for name, one in value.items())
    return all(name in value and _fits(value[name], inner) for name, inner in shape.items())
