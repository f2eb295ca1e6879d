"""Shards of a run: `run.shard=2/8` makes the second eighth of it, independently of the others.

The output of a shard depends only on the configuration, the seed and the shard's number. Counters
that key random draws start at `first`, so that no two shards draw the same numbers. A whole run is
shard 1 of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from knotgym.common.errors import InvalidInput

_STRIDE = 10**9  # larger than any counter within a shard


@dataclass(frozen=True)
class Shard:
    """Shard `number`, counted from 1, of `of` shards."""

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise InvalidInput(f"a shard is i/n with i from 1 to n, such as 2/8; got {self}")

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Parse "2/8"; "" means the whole run."""
        words = text.split("/")
        if not text:
            return cls()
        if len(words) != 2 or not all(word.isdecimal() and len(word) < 7 for word in words):
            raise InvalidInput(f"a shard is i/n with i from 1 to n, such as 2/8; got {text!r}")
        return cls(*map(int, words))

    @property
    def is_whole(self) -> bool:
        """Whether this is the only shard."""
        return self.of == 1

    @property
    def first(self) -> int:
        """First value of this shard's counters."""
        return (self.number - 1) * _STRIDE

    def share(self, count: int) -> range:
        """Return this shard's part of `range(count)`; if it doesn't divide evenly, the first shards
        get one more.

        >>> [Shard(number, 3).share(8) for number in (1, 2, 3)]
        [range(0, 3), range(3, 6), range(6, 8)]
        """
        each, more = divmod(count, self.of)
        begin = (self.number - 1) * each + min(self.number - 1, more)
        return range(begin, begin + each + (self.number <= more))

    def dealt(self, things: Sequence[Any]) -> Sequence[Any]:
        """Return every `of`-th item, starting at this shard; as many as in `share`."""
        return things[self.number - 1 :: self.of]

    def folder(self, out: Path) -> Path:
        """Return the folder of this shard if the whole run is written to `out`."""
        return self._beside(out, out.name, "")

    def file(self, out: Path) -> Path:
        """Return the file of this shard if the whole run is written to `out`."""
        return self._beside(out, out.stem, out.suffix)

    def journal(self, out: Path) -> Path:
        """Return the journal that this shard leaves beside the output `out` of the whole run."""
        return out.with_name(f"{out.name}-shard-{self.number}-of-{self.of}.journal")

    def _beside(self, out: Path, stem: str, suffix: str) -> Path:
        own = f"{stem}-shard-{self.number}-of-{self.of}{suffix}"
        return out if self.is_whole else out.with_name(own)


WHOLE = Shard()
