"""The manifest of a run's folder: what was asked for, what the run reports, and checksums."""

import platform
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from knotgym.common import InvalidInput, list_files, one_line, read_json, sha256


def _inside(name: str) -> str:
    outside = PurePath(name).is_absolute() or ".." in PurePath(name).parts
    if not name or outside or not name.isprintable():
        raise InvalidInput(f"{one_line(name)!r} is not a file in the folder")
    return name


_Count = Annotated[int, Field(strict=True)]
_Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]*$", strict=True)]  # a terminal may show it
_File = Annotated[str, AfterValidator(_inside)]


class _Report(BaseModel, extra="allow"):
    """What a run that generated states counts; other entries are kept as they are."""

    attempts: _Count | None = None
    demonstrations: _Count = 0
    existing_codes: dict[_Name, _Count | None] = {}
    rejected: dict[_Name, dict[_Name, _Count]] = {}
    undemonstrated: list[_Name] = []


class _Manifest(BaseModel, extra="allow"):
    config: dict[str, Any] = {}
    files: dict[_File, str]
    report: _Report = _Report()


def read_manifest(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Read a manifest; return it (empty if unreadable) and the fault, if any, in a list.

    The report of a run that generated states has all its entries, zero or empty if they are absent.
    """
    try:
        return _Manifest.model_validate(read_json(folder / "manifest.json")).model_dump(), []
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        said = f"{where}: {first['msg']}"
    except (OSError, ValueError) as error:
        said = one_line(error)
    return {}, [one_line(f"manifest.json can't be read: {said}")]


def write_manifest(
    folder: Path, format: str, request: Mapping[str, Any], report: Mapping[str, Any]
) -> None:
    """Write `manifest.json` into a folder, with the checksum of every other file in it.

    Args:
        format: name of the format.
        request: what was asked for: configuration, sources, versions.
        report: the run's counts.
    """
    facts = {"format": format, "format_version": 1, **request, "report": report}
    list_files(folder, {**facts, "machines": [machine()]})


def machine() -> dict[str, str]:
    """Describe what can change the last bits of a number, and so a run's output.

    That is `system`, `processor`, the `instructions` that NumPy uses beyond its baseline, the
    `blas` it was built with, and the `libc`, whose mathematics MuJoCo uses (on macOS the release of
    the system). A sum in another order differs by rounding, which a long simulation amplifies to
    millimetres.
    """
    try:
        config: Any = np.show_config(mode="dicts")
        blas = "{name} {version}".format(**config["Build Dependencies"]["blas"])
        instructions = " ".join(config["SIMD Extensions"].get("found", []))
    except (TypeError, KeyError):  # another NumPy version reports it differently
        blas = instructions = "unknown"
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "instructions": instructions,
        "blas": blas,
        "libc": " ".join(platform.libc_ver()).strip() or platform.release(),
    }


def listed_faults(folder: Path, manifest: Mapping[str, Any]) -> Iterator[str]:
    """Yield listed files that are missing or changed, and data files that aren't listed."""
    data_files = [path for kind in ("*.h*5", "*.json", "*.parquet") for path in folder.rglob(kind)]
    for path in sorted(data_files) if manifest else ():
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in {"manifest.json", *manifest["files"]}:
            yield f"{name} is not in the manifest"
    for name, digest in manifest.get("files", {}).items():
        if not (folder / name).is_file():
            yield f"{name} is missing"
        elif sha256(folder / name) != digest:
            yield f"{name} is not the file the manifest lists (SHA-256 differs)"
