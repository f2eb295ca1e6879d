"""Write and read the manifest of a run's folder, and compare its checksums."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from knotgym.common.atomic_files import atomic_write, sha256
from knotgym.common.configuration import read_json
from knotgym.common.errors import InvalidFile, one_line, printable
from knotgym.datasets.machine import machine
from knotgym.states.state_file import leads_out

_Count = Annotated[int, Field(strict=True)]
_Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$", strict=True)]  # a terminal may show it
# entries of a run's report, all optional
_REPORT: dict[str, TypeAdapter[Any]] = {
    "attempts": TypeAdapter(_Count),
    "demonstrations": TypeAdapter(_Count),
    "existing_codes": TypeAdapter(dict[_Name, _Count | None]),
    "rejected": TypeAdapter(dict[_Name, dict[_Name, _Count]]),
    "undemonstrated": TypeAdapter(list[_Name]),
}


def read_manifest(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Read a manifest; return it (empty if unreadable) and the fault, if any, in a list."""
    try:
        manifest = read_json(folder / "manifest.json")
        checked = {"files": manifest["files"], "config": manifest["config"]}
        for name, value in checked.items():
            if not isinstance(value, dict):
                raise InvalidFile(f"{name} should be an object")
        for name in checked["files"]:
            if not name or leads_out(name) or not name.isprintable():
                raise InvalidFile(
                    f"it lists {printable(name)!r}, which is not a file in the folder"
                )
    except (OSError, ValueError, KeyError, TypeError) as error:
        return {}, [f"manifest.json can't be read: {one_line(error)}"]
    return {**manifest, **checked}, []


def write_manifest(
    folder: Path,
    format: str,
    request: Mapping[str, Any],
    machines: Sequence[dict[str, str]] | None,
    **entries: Any,
) -> None:
    """Write `manifest.json` into a folder, with the checksum of every other file in it.

    `machines` made the data; None for this machine.
    """
    found = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
    manifest = {
        "format": format,
        "format_version": 1,
        **request,
        "machines": machines or [machine()],
        **entries,
        "files": {
            name: sha256(path)
            for name, path in found.items()
            if path.is_file() and path.name != "manifest.json"
        },
    }
    with atomic_write(folder / "manifest.json") as temporary:
        temporary.write_text(json.dumps(manifest, indent=1, sort_keys=True), encoding="utf-8")


def run_report(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return a manifest's report of the run that generated states; empty if it is invalid."""
    report = manifest.get("report")
    if not isinstance(report, dict) or report_faults(manifest):
        return {}
    return report


def report_faults(manifest: Mapping[str, Any]) -> list[str]:
    """List the faults in the report of a run that generated states."""
    report = manifest.get("report", {})
    if not isinstance(report, dict):
        return ["manifest.json: report should be an object"]
    faults = []
    for name in _REPORT.keys() & report.keys():
        try:
            _REPORT[name].validate_python(report[name])
        except ValidationError:
            faults.append(f"manifest.json: report.{name} has the wrong type")
    if "rejected" in report and "attempts" not in report:
        faults.append("manifest.json: report.rejected needs report.attempts")
    return faults


def listed_faults(folder: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield listed files that are missing or changed, and unlisted HDF5 and JSON files."""
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
