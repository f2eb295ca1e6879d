"""Rows of arrays divided among threads.

For NumPy and compiled code that releases the interpreter's lock. A row's result must not depend on
the rows beside it; then the number of threads changes nothing.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count
from typing import Any

Work = Callable[[slice], Any]


class Threads:
    """A pool of threads, which start when they are first needed.

    Attributes:
        count: how many were asked for; 0 for one on every core.
    """

    def __init__(self, count: int = 1) -> None:
        self.count = count
        self._most = count or cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._most) if self._most > 1 else None

    def spread(self, work: Work, rows: int, unit: int = 1) -> list[Any]:
        """Call `work` with consecutive slices of `rows` rows, about as many on each thread.

        Args:
            work: called with a slice, on any thread.
            rows: how many there are; none if 0.
            unit: parts are whole multiples of it, but for the last.

        Returns:
            What the calls return, in the order of the rows.
        """
        size = -(-rows // (self._most * unit)) * unit
        parts = [slice(first, first + size) for first in range(0, rows, size or 1)]
        if self._pool is None or len(parts) < 2:
            return list(map(work, parts))
        return list(self._pool.map(work, parts))


ALONE = Threads()
