"""What of a machine can change the last bits of a number, and so the bytes that a run makes.

The same versions of MuJoCo and NumPy take other instructions on other processors, and mathematics
from the system's own library: a sum comes out in another order, and a rope that is pulled for long
makes millimetres of it.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.configuration import read_json

_REPORTS = ("manifest.json", "data/collection.json", "collection.json")


@cache
def _found() -> tuple[tuple[str, str], ...]:
    try:
        config: Any = np.show_config(mode="dicts")
        blas = config["Build Dependencies"]["blas"]
        blas = f"{blas['name']} {blas['version']}"
        instructions = " ".join(config["SIMD Extensions"]["found"])
    except (TypeError, KeyError):  # another NumPy says it otherwise
        blas = instructions = "unknown"
    return (
        ("system", platform.system()),
        ("processor", platform.machine()),
        ("instructions", instructions),
        ("blas", blas),
        ("libc", " ".join(platform.libc_ver())),
    )


def machine() -> dict[str, str]:
    """This machine: `system`, `processor`, the `instructions` that NumPy takes beyond its baseline,
    the `blas` it was built with, and the `libc`, whose mathematics MuJoCo takes.
    """
    return dict(_found())


def distinct(reports: Iterable[Any]) -> list[dict[str, str]]:
    """The machines that reports of runs name, each once, in order."""
    found: list[dict[str, str]] = []
    for report in reports:
        named = report.get("machines") if isinstance(report, dict) else None
        for one in named if isinstance(named, list) else ():
            if _is_machine(one) and one not in found:
                found.append(one)
    return found


def others(folder: Path) -> str:
    """In which ways a folder's run says that it was made elsewhere; "" if it doesn't."""
    reports = []
    for name in _REPORTS:
        try:
            reports.append(read_json(folder / name))
        except (OSError, ValueError):
            continue
    here = machine()
    return "; ".join(_unlike(one, here) for one in distinct(reports) if one != here)


def _unlike(one: dict[str, str], here: dict[str, str]) -> str:
    names: Sequence[str] = sorted(one.keys() | here.keys())
    return ", ".join(
        f"{name} {one.get(name, 'unknown') or 'none'} (here {here.get(name, 'unknown') or 'none'})"
        for name in names
        if one.get(name) != here.get(name)
    )


def _is_machine(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(text, str) and text.isprintable() for pair in value.items() for text in pair
    )
