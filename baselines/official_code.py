"""Official code that users clone themselves: its checkout, its commit, and the settings for it."""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from knotgym.common.errors import InvalidInput, MissingExtra

Settings = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class OfficialCode:
    """A repository for which there is an adapter.

    Attributes:
        name: name of the method.
        repository: host and path of the repository.
        commit: tested commit, 40 digits.
        files: files by which a checkout is recognized.
        root: folder in the checkout from which modules are imported.
        libraries: libraries that the code imports.
    """

    name: str
    repository: str
    commit: str
    files: tuple[str, ...]
    root: str = "."
    libraries: tuple[str, ...] = ()


def add_options(options: argparse.ArgumentParser, code: OfficialCode) -> None:
    """Add the options of every adapter."""
    place = f"checkout of {code.repository} at {code.commit[:12]}"
    options.add_argument("--checkout", type=Path, required=True, help=place)
    options.add_argument(
        "--settings", default="paper", help="table of settings.toml: paper or small"
    )
    options.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="change a setting"
    )
    options.add_argument("--seed", type=int, default=0)


def require_checkout(code: OfficialCode, folder: Path) -> str:
    """Return the commit of a checkout, or "unknown"; print a warning if it isn't the tested one.

    Raises:
        InvalidInput: the folder isn't a checkout of that code.
        MissingExtra: a library that the code imports isn't installed.
    """
    if missing := [name for name in code.files if not (folder / name).is_file()]:
        raise InvalidInput(
            f"{folder} isn't a checkout of {code.repository} at {code.commit[:12]}: it has no"
            f" {missing[0]}"
        )
    for library in code.libraries:
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, f"see docs/baselines.md on {code.name}")
    commit = _commit(folder)
    if commit != code.commit:
        print(
            f"warning: {folder} is at commit {commit[:12]}; this adapter was tested with"
            f" {code.commit[:12]}",
            file=sys.stderr,
        )
    return commit


def import_from(code: OfficialCode, folder: Path) -> None:
    """Put a checkout first on the import path."""
    sys.path.insert(0, str((folder / code.root).resolve()))


def read_settings(file: Path, table: str, changes: Sequence[str]) -> Settings:
    """Read a table of a settings file and apply changes such as "run.envs=8".

    Raises:
        InvalidInput: the table or a setting is unknown, or a value has the wrong type.
    """
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    if table not in tables:
        raise InvalidInput(f"no settings {table!r}; choose from {', '.join(tables)}")
    known: Settings = {}
    for one in (*tables.values(), tables[table]):
        known |= one
    chosen: Settings = dict(tables[table])
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or name not in known:
            raise InvalidInput(
                f"--set takes NAME=VALUE with one of {', '.join(known)}; got {change!r}"
            )
        chosen[name] = _value(name, text, known[name])
    return chosen


def _value(name: str, text: str, usual: Any) -> Any:
    """Parse a value; its type must be that of the setting's usual value."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    if isinstance(usual, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(usual):
        raise InvalidInput(f"{name} must be like {usual!r}, got {text!r}")
    return value


def _commit(folder: Path) -> str:
    try:
        found = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "HEAD"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return found.stdout.strip()
