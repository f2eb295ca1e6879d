"""Properties of a machine that can change the last bits of a number, and so a run's output.

The same versions of MuJoCo and NumPy use different instructions on different processors, and the
system's own mathematics library. A sum in another order differs by rounding, which a long
simulation amplifies to millimetres.
"""

import platform
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.configuration import read_json
from knotgym.common.errors import KnotgymError
from knotgym.datasets.episode_dataset import open_episodes


def machine() -> dict[str, str]:
    """Describe this machine: `system`, `processor`, the `instructions` that NumPy uses beyond its
    baseline, the `blas` it was built with, and the `libc`, whose mathematics MuJoCo uses.
    """
    try:
        config: Any = np.show_config(mode="dicts")
        blas = "{name} {version}".format(**config["Build Dependencies"]["blas"])
        instructions = " ".join(config["SIMD Extensions"]["found"])
    except (TypeError, KeyError):  # another NumPy version reports it differently
        blas = instructions = "unknown"
    return {
        "system": platform.system(),
        "processor": platform.machine(),
        "instructions": instructions,
        "blas": blas,
        "libc": " ".join(platform.libc_ver()),
    }


def distinct(reports: Iterable[Any]) -> list[dict[str, str]]:
    """List the machines in the reports of runs, each once, in order of appearance."""
    found: list[dict[str, str]] = []
    for report in reports:
        listed = report.get("machines") if isinstance(report, dict) else None
        for one in listed if isinstance(listed, list) else ():
            if _is_machine(one) and one not in found:
                found.append(one)
    return found


def others(folder: Path) -> str:
    """Describe how the machines of a folder's run differ from this one; "" if they don't."""
    reports = []
    with suppress(OSError, ValueError):
        reports.append(read_json(folder / "manifest.json"))
    with suppress(KnotgymError):
        reports.append(open_episodes(folder).attributes.get("run"))
    here = machine()
    return "; ".join(_difference(one, here) for one in distinct(reports) if one != here)


def _difference(one: dict[str, str], here: dict[str, str]) -> str:
    return ", ".join(
        f"{name} {one.get(name, 'unknown') or 'none'} (here {here.get(name, 'unknown') or 'none'})"
        for name in sorted(one.keys() | here.keys())
        if one.get(name) != here.get(name)
    )


def _is_machine(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(text, str) and text.isprintable() for pair in value.items() for text in pair
    )
