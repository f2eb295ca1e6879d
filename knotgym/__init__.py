"""knotgym: a closed rope in MuJoCo, goals that are Gauss codes, and the data to learn to tie them.

Importing this registers the environments knotgym/Unknot-v0, knotgym/Tie-v0 and knotgym/Convert-v0
with Gymnasium, and for OGBench knotgym/tie-nx2-v0 and the like (`adapters.ogbench_environment`).
The names below are imported when they are first used.
"""

import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import gymnasium

if TYPE_CHECKING:
    from knotgym.datasets.states import InvalidStates, States, read_states, shipped
    from knotgym.datasets.verification import verify
    from knotgym.env import KnotEnv, KnotVectorEnv
    from knotgym.errors import KnotgymError
    from knotgym.rendering.picture import PictureConfig, draw
    from knotgym.rope import InvalidCurve, Rope, RopeConfig
    from knotgym.simulation import InvalidAction
    from knotgym.tasks import InvalidSetting, TaskConfig
    from knotgym.topology.crossings import InvalidPoints, label
    from knotgym.topology.gauss import GaussCode, InvalidGaussCode
else:
    from knotgym.lazy_exports import lazy_exports

    __getattr__, __dir__ = lazy_exports(
        __name__,
        {
            "GaussCode": "knotgym.topology.gauss",
            "InvalidAction": "knotgym.simulation",
            "InvalidCurve": "knotgym.rope",
            "InvalidGaussCode": "knotgym.topology.gauss",
            "InvalidPoints": "knotgym.topology.crossings",
            "InvalidSetting": "knotgym.tasks",
            "InvalidStates": "knotgym.datasets.states",
            "KnotEnv": "knotgym.env",
            "KnotVectorEnv": "knotgym.env",
            "KnotgymError": "knotgym.errors",
            "PictureConfig": "knotgym.rendering.picture",
            "Rope": "knotgym.rope",
            "RopeConfig": "knotgym.rope",
            "States": "knotgym.datasets.states",
            "TaskConfig": "knotgym.tasks",
            "draw": "knotgym.rendering.picture",
            "label": "knotgym.topology.crossings",
            "read_states": "knotgym.datasets.states",
            "shipped": "knotgym.datasets.states",
            "verify": "knotgym.datasets.verification",
        },
    )

try:
    __version__ = version("knotgym")
except PackageNotFoundError:  # a checkout that isn't installed
    __version__ = "0+unknown"

__all__ = [
    "GaussCode",
    "InvalidAction",
    "InvalidCurve",
    "InvalidGaussCode",
    "InvalidPoints",
    "InvalidSetting",
    "InvalidStates",
    "KnotEnv",
    "KnotVectorEnv",
    "KnotgymError",
    "PictureConfig",
    "Rope",
    "RopeConfig",
    "States",
    "TaskConfig",
    "__version__",
    "draw",
    "label",
    "read_states",
    "shipped",
    "verify",
]


def _is_writable(folder: Path) -> bool:
    """Return whether a folder, or the nearest one above it that is there, can be written to."""
    there = next(one for one in (folder, *folder.parents) if one.exists())
    return there.is_dir() and os.access(there, os.W_OK)


def _require_kernel_cache() -> None:
    """Give numba a temporary folder for its machine code where it has no other.

    Numba caches beside the package or in the user's cache folder, and where it can write to neither
    it refuses to import a cached function. The folder goes when the process ends.
    """
    user = (
        Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")).absolute()
        / "numba"
    )
    beside = Path(__file__).parent / "__pycache__"
    # Numba would take the folder, whose files are unpickled, from a .numba_config.yaml in the
    # current folder unless the variable is set; "" stands for its own default
    if os.environ.setdefault("NUMBA_CACHE_DIR", "") or any(map(_is_writable, (beside, user))):
        return
    import atexit
    import shutil
    import tempfile

    folder = tempfile.mkdtemp(prefix="knotgym-numba-")  # of this user alone: the cache is code
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder  # worker processes inherit it


_require_kernel_cache()

for _task in ("unknot", "tie", "convert"):
    gymnasium.register(
        id=f"knotgym/{_task.capitalize()}-v0",
        entry_point="knotgym.env:KnotEnv",
        vector_entry_point="knotgym.env:KnotVectorEnv",
        kwargs={"task": _task},
    )
    for _nx in (2, 3, 4):
        for _look, _seen in (("", "state"), ("visual-", "pixels")):  # OGBench goes by the name
            gymnasium.register(
                id=f"knotgym/{_look}{_task}-nx{_nx}-v0",
                entry_point="knotgym.adapters.ogbench_environment:OGBenchEnv",
                kwargs={"task": _task, "nx": _nx, "split": "test", "observation": _seen},
            )
