"""Blocks of episodes: the calls of recipes that play, and the results that they return.

Episode i of a run has a seed of its own, so a block may have any size and be played anywhere.
"""

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from knotgym.common.tables import Schema, Table
from knotgym.datasets.episodes import EPISODES, PULLS, RECORDED, STEPS, Episodes

_PIECES = 8  # blocks of a run, so that workers have equal shares
_LEAST, _MOST = 64, 1024  # episodes of a block: enough to fill the lanes; few enough for memory
_MOST_STEPS = 2**17  # of a block


def blocks(episodes: int, horizon: int) -> list[range]:
    """Divide the numbers of a run's episodes into blocks of about equal size.

    >>> blocks(200, 50)
    [range(0, 50), range(50, 100), range(100, 150), range(150, 200)]
    """
    size = min(max(-(-episodes // _PIECES), _LEAST), _MOST, max(1, _MOST_STEPS // (horizon + 1)))
    count = -(-episodes // size)
    ends = [number * episodes // count for number in range(count + 1)]
    return [range(first, end) for first, end in zip(ends[:-1], ends[1:], strict=True)]


def as_result(episodes: Episodes) -> dict[str, NDArray[Any]]:
    """Return the columns of episodes by the names of their tables, to be kept in a journal."""
    return {f"{t.schema.name}/{name}": values for t in episodes for name, values in t.items()}


def from_result(result: Mapping[str, NDArray[Any]]) -> Episodes:
    """Return the episodes of a result of `as_result`."""
    whole = "steps/observation" in result
    forms = (EPISODES, STEPS) if whole else (RECORDED, PULLS)
    return Episodes(*(_table(schema, result) for schema in forms))


def _table(schema: Schema, result: Mapping[str, NDArray[Any]]) -> Table:
    names = [column.name for column in schema.columns if f"{schema.name}/{column.name}" in result]
    return Table(schema.only(*names), {name: result[f"{schema.name}/{name}"] for name in names})
