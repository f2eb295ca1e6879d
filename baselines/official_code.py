"""Code that a user fetches himself: its checkout, at the commit that an adapter was made for, and
the settings that an adapter gives it.
"""

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

from baseline_script import InvalidBaseline

from knotgym.common.errors import MissingExtra

Settings = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class OfficialCode:
    """A repository that an adapter was made for.

    Attributes:
        name: of the method.
        repository: where it is.
        commit: all 40 digits.
        files: of its checkout, which tell it from any other folder.
        root: folder of the checkout that its modules are imported from.
        libraries: that it imports.
    """

    name: str
    repository: str
    commit: str
    files: tuple[str, ...]
    root: str = "."
    libraries: tuple[str, ...] = ()


def add_options(options: argparse.ArgumentParser, code: OfficialCode) -> None:
    """The options of every adapter."""
    place = f"of {code.repository} at {code.commit[:12]}"
    options.add_argument("--checkout", type=Path, required=True, help=place)
    options.add_argument("--settings", default="paper", help="table of settings.toml, or small")
    options.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="one")
    options.add_argument("--seed", type=int, default=0)


def require_checkout(code: OfficialCode, folder: Path) -> str:
    """The commit that a checkout is at, "unknown" where Git can't tell; another than the adapter's
    is warned of in one line.

    Raises:
        InvalidBaseline: it is no checkout of that code.
        MissingExtra: a library that it imports isn't installed.
    """
    if missing := [name for name in code.files if not (folder / name).is_file()]:
        raise InvalidBaseline(
            f"{folder} is no checkout of {code.repository} at {code.commit[:12]}: it has no"
            f" {missing[0]}"
        )
    for library in code.libraries:
        if importlib.util.find_spec(library) is None:
            raise MissingExtra(library, f"see docs/baselines.md on {code.name}")
    commit = _commit(folder)
    if commit != code.commit:
        print(
            f"warning: {folder} is at commit {commit[:12]}; this was made for {code.commit[:12]}",
            file=sys.stderr,
        )
    return commit


def import_from(code: OfficialCode, folder: Path) -> None:
    """Have the modules of a checkout found before all others."""
    sys.path.insert(0, str((folder / code.root).resolve()))


def read_settings(file: Path, table: str, changes: Sequence[str]) -> Settings:
    """A table of a settings file, with changes such as "run.envs=8".

    Raises:
        InvalidBaseline: no such table, no such setting in any, or a value of another type.
    """
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    if table not in tables:
        raise InvalidBaseline(f"no settings {table!r}; there is {', '.join(tables)}")
    known: Settings = {}
    for one in (*tables.values(), tables[table]):
        known |= one
    chosen: Settings = dict(tables[table])
    for change in changes:
        name, equals, text = change.partition("=")
        if not equals or name not in known:
            raise InvalidBaseline(
                f"--set takes NAME=VALUE with one of {', '.join(known)}; got {change!r}"
            )
        chosen[name] = _value(name, text, known[name])
    return chosen


def _value(name: str, text: str, usual: Any) -> Any:
    """What is written, of the type that the setting usually has."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    if isinstance(usual, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not type(usual):
        raise InvalidBaseline(f"{name} must be like {usual!r}, got {text!r}")
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
