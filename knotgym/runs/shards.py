"""Shards of a run: `run.shard=2/8` computes every eighth of its results, from the second.

The results don't depend on the shard that computes them. A whole run is shard 1 of 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from knotgym.common.errors import InvalidInput


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

    def dealt(self, things: Sequence[Any]) -> Sequence[Any]:
        """Return every `of`-th item, from this shard's first.

        >>> [Shard(number, 3).dealt(range(8)) for number in (1, 2, 3)]
        [range(0, 8, 3), range(1, 8, 3), range(2, 8, 3)]
        """
        return things[self.number - 1 :: self.of]

    def journal(self, out: Path) -> Path:
        """Return the journal that this shard leaves beside the output `out` of the whole run."""
        return out.with_name(f"{out.name}-shard-{self.number}-of-{self.of}.journal")


WHOLE = Shard()
