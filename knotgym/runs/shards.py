"""Shards of a run: `--shard 2/8` does the second eighth of it, in a folder of its own, without
knowing of the others.

What a shard makes depends on the configuration, the seed and its number alone. Counters that key
random draws begin at `first`, so that no two shards draw the same; a whole run is shard 1 of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from knotgym.common.errors import KnotgymError

_STRIDE = 10**9  # more than a shard counts of anything


class InvalidShard(KnotgymError, ValueError):
    """No such shard of a run."""


@dataclass(frozen=True)
class Shard:
    """Shard `number`, from 1, of `of`."""

    number: int = 1
    of: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.number <= self.of:
            raise InvalidShard(f"a shard is i/n with i from 1 to n, such as 2/8; got {self}")

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read "2/8"; "" is the whole."""
        words = text.split("/")
        if not text:
            return cls()
        if len(words) != 2 or not all(word.isdecimal() and len(word) < 7 for word in words):
            raise InvalidShard(f"a shard is i/n with i from 1 to n, such as 2/8; got {text!r}")
        return cls(*map(int, words))

    @property
    def is_whole(self) -> bool:
        """There is no other."""
        return self.of == 1

    @property
    def first(self) -> int:
        """Where this shard's counters begin."""
        return (self.number - 1) * _STRIDE

    def share(self, count: int) -> range:
        """Which of `count` things in a row are this shard's; where they don't divide, the first
        shards have one more.

        >>> [Shard(number, 3).share(8) for number in (1, 2, 3)]
        [range(0, 3), range(3, 6), range(6, 8)]
        """
        each, more = divmod(count, self.of)
        begin = (self.number - 1) * each + min(self.number - 1, more)
        return range(begin, begin + each + (self.number <= more))

    def dealt(self, things: Sequence[Any]) -> Sequence[Any]:
        """Those of the things that fall to this shard when they are dealt out in turn, as many as
        `share` says.
        """
        return things[self.number - 1 :: self.of]

    def folder(self, out: Path) -> Path:
        """Where this shard goes if the whole run goes to `out`."""
        return (
            out if self.is_whole else out.with_name(f"{out.name}-shard-{self.number}-of-{self.of}")
        )
