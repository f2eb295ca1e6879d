"""Properties of a machine that can change the last bits of a number, and so a run's output.

The same versions of MuJoCo and NumPy use different instructions on different processors, and the
system's own mathematics library. A sum in another order differs by rounding, which a long
simulation amplifies to millimetres.
"""

import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.configuration import read_json
from knotgym.common.errors import KnotgymError, printable
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


def others(folder: Path) -> str:
    """Describe how the machines of a folder's run differ from this one; "" if they don't."""
    here, reports = machine(), list[Any]()
    with suppress(OSError, ValueError):
        reports.append(read_json(folder / "manifest.json"))
    with suppress(KnotgymError):
        reports.append(open_episodes(folder).attributes.get("run"))
    found: dict[str, None] = {}
    for report in reports:
        with suppress(AttributeError, TypeError):  # it lists no machines
            found |= {_difference(one, here): None for one in report.get("machines", ())}
    return printable("; ".join(filter(None, found)))


def _difference(one: dict[str, str], here: dict[str, str]) -> str:
    return ", ".join(
        f"{name} {one.get(name, 'unknown') or 'none'} (here {here.get(name, 'unknown') or 'none'})"
        for name in sorted(one.keys() | here.keys())
        if one.get(name) != here.get(name)
    )
