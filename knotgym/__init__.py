"""knotgym: tie and untie a simulated closed rope; goals are Gauss codes.

Importing this package registers the environments knotgym/Unknot-v0, knotgym/Tie-v0 and
knotgym/Convert-v0 with Gymnasium, and knotgym/tie-nx2-v0 and the like for OGBench
(`adapters.OGBenchEnv`). All names below are imported on first use.
"""

import os
from importlib.metadata import PackageNotFoundError, version

import gymnasium
import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__.append("__version__")

try:
    __version__ = version("knotgym")
except PackageNotFoundError:  # a checkout that isn't installed
    __version__ = "0+unknown"


def _ignore_numba_config() -> None:
    """Make numba ignore a `.numba_config.yaml` in the current folder.

    Numba reads it when it is imported and before it compiles. The folder may have been downloaded,
    and the file could change what numba does, or crash it.
    """
    if not os.path.lexists(".numba_config.yaml"):
        return
    import sys
    import warnings

    yaml = sys.modules.get("yaml")
    sys.modules["yaml"] = None  # type: ignore[assignment]  # numba then warns, and reads no file
    with warnings.catch_warnings(action="ignore"):
        from numba.core import config
    config._config_fname = ""
    del sys.modules["yaml"]
    if yaml is not None:
        sys.modules["yaml"] = yaml


_ignore_numba_config()


def register_environment(task: str) -> None:
    """Register the environment of a task with Gymnasium."""
    gymnasium.register(
        id=f"knotgym/{task.capitalize()}-v0",
        entry_point="knotgym.envs.environment:KnotEnv",
        vector_entry_point="knotgym.envs.environment:KnotVectorEnv",
        kwargs={"task": task},
    )


for _task in ("unknot", "tie", "convert"):
    register_environment(_task)
    for _nx in (2, 3, 4):
        for _prefix, _observation in (("", "state"), ("visual-", "pixels")):  # OGBench's prefix
            gymnasium.register(
                id=f"knotgym/{_prefix}{_task}-nx{_nx}-v0",
                entry_point="knotgym.adapters.goal_environment:OGBenchEnv",
                kwargs={"task": _task, "nx": _nx, "split": "test", "observation": _observation},
            )
