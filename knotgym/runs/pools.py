"""The interface of an executor's pool, which maps a function over work and keeps the order."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, Protocol

AHEAD = 8  # pieces in progress per worker, so that one slow piece doesn't leave others idle


class Pool(Protocol):
    """Maps a function over work; results come in the order of the work."""

    def map(self, function: Callable[[Any], Any], work: Iterable[Any], /) -> Iterable[Any]: ...


class Promise(Protocol):
    """Any future with a `result` method."""

    def result(self) -> Any: ...


def ordered(submit: Callable[[Any], Promise], work: Iterable[Any], ahead: int) -> Iterator[Any]:
    """Return results in the order of the work, with at most `ahead` pieces in progress.

    The first pieces are submitted at once, before the first result is requested.
    """
    rest = iter(work)
    promised = deque(submit(piece) for piece in islice(rest, ahead))

    def results() -> Iterator[Any]:
        while promised:
            result = promised.popleft().result()
            promised.extend(submit(piece) for piece in islice(rest, 1))
            yield result

    return results()
