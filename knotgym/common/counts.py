"""How far long work is: whatever takes long counts here, and the display of a command listens."""

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, ClassVar, TypeAlias, TypeVar

Item = TypeVar("Item")


class Counts:
    """What this process counts; nobody has to listen.

    Loops of the main process count their stage. Work that may run in other processes counts the
    items that it ends, such as episodes, or shares of them, in a counter which those processes
    share.

    Attributes:
        listeners: the last one is called with the stage, how many of its items are done, and the
            total.
        ended: `value` is the number of items that ended. Worker processes have a
            `multiprocessing.Value` here.
        compiling: `value` is how many functions are compiled now; shared in the same way.
        worker_seconds: CPU time that worker processes of this one took, up to now.
    """

    # how many items are done, or what returns that by now
    Done: TypeAlias = float | Callable[[], float]
    listeners: ClassVar[list[Callable[[str, Done, int], None]]] = []
    ended: ClassVar[Any] = SimpleNamespace(value=0)
    compiling: ClassVar[Any] = SimpleNamespace(value=0)
    worker_seconds: ClassVar[float] = 0.0

    @classmethod
    def tell(cls, stage: str, done: Done, total: int) -> None:
        """Tell who listens how far a stage is."""
        if cls.listeners:
            cls.listeners[-1](stage, done, total)

    @classmethod
    def over(cls, items: Iterable[Item], stage: str, total: int | None = None) -> Iterator[Item]:
        """Yield items, and tell how many of `total` are done, by default their number."""
        total = len(items) if total is None and isinstance(items, Sized) else total or 0
        for done, item in enumerate(items):
            cls.tell(stage, done, total)
            yield item
        cls.tell(stage, total, total)

    @classmethod
    def end_item(cls, share: float = 1.0) -> None:
        """Count an item that has ended, or a share of items, in whichever process."""
        cls.add(cls.ended, share)

    @staticmethod
    def add(counter: Any, amount: float) -> None:
        """Add to a counter of this process, or one that processes share."""
        with getattr(counter, "get_lock", nullcontext)():
            counter.value += amount

    @classmethod
    def from_now(cls, done: int = 0, pool: Any = None) -> Callable[[], float]:
        """Return what counts on from `done` as items end in a pool, or in this process."""
        counter = getattr(pool, "ended", cls.ended)
        before = counter.value
        return lambda: round(done + counter.value - before, 6)  # shares add up to whole items
