"""knotgym: a closed rope in MuJoCo, goals that are Gauss codes, and the data to learn to tie them.

Importing this registers the environments knotgym/Unknot-v0, knotgym/Tie-v0 and knotgym/Convert-v0
with Gymnasium.
"""

from importlib.metadata import PackageNotFoundError, version

import gymnasium

from knotgym.errors import KnotgymError
from knotgym.topology.gauss import GaussCode

try:
    __version__ = version("knotgym")
except PackageNotFoundError:  # a checkout that isn't installed
    __version__ = "0+unknown"

__all__ = ["GaussCode", "KnotgymError", "__version__"]

for _task in ("unknot", "tie", "convert"):
    gymnasium.register(
        id=f"knotgym/{_task.capitalize()}-v0",
        entry_point="knotgym.env:KnotEnv",
        vector_entry_point="knotgym.env:KnotVectorEnv",
        kwargs={"task": _task},
    )
