"""What every executor is: a pool that maps a function over work and keeps its order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Protocol

from knotgym.common.errors import KnotgymError

AHEAD = 8  # pieces under way for each worker: enough that a slow one holds up no other


class InvalidEngine(KnotgymError, ValueError):
    """Work cannot run where it was asked to."""


class LostWorkers(KnotgymError, RuntimeError):
    """Work stopped because nobody is left to do it."""


class Pool(Protocol):
    """Something that maps a function over work."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]: ...


class Promise(Protocol):
    """Something that will have a result."""

    def result(self) -> Any: ...


def ordered(submit: Callable[[Any], Promise], work: Iterable[Any], ahead: int) -> Iterator[Any]:
    """Results in the order of the work, at most `ahead` pieces under way at a time; the first of
    them are from now on.
    """
    rest = iter(work)
    promised = deque(submit(piece) for piece in islice(rest, ahead))

    def results() -> Iterator[Any]:
        while promised:
            result = promised.popleft().result()
            promised.extend(submit(piece) for piece in islice(rest, 1))
            yield result

    return results()
