"""The codes for which a run makes states, and their order."""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.runs.shards import Shard
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import based_diagrams, diagram_of, type_of
from knotgym.topology.knots import LISTED_NX, codes_of, shows
from knotgym.topology.uniform_codes import uniform_code

_RARE = 20_000  # random codes to try until one shows the knot


class CodeOrder:
    """The codes with one nx, by index, and the order in which a shard makes states of them.

    `listed` has all codes, None if there are too many to list; for a knot whose crossing number
    exceeds LISTED_NX, the diagram of the knot table from every base point. `existing` is the number
    of codes that show the knot, None if unknown; `wanted` that of states to make. A *slot* (index,
    copy) stands for one state of a code.
    """

    def __init__(self, config: GenerateConfig, knot: str, shard: Shard, nx: int) -> None:
        self._knot, self._shard, self._nx = knot, shard, nx
        self.listed: Sequence[GaussCode] | None = None
        if config.codes:
            self.listed = [code for code in config.parsed if code.nx == nx]
        elif nx <= LISTED_NX:
            self.listed = codes_of(type_of(knot), nx)
        elif nx == diagram_of(knot).nx:
            self.listed = based_diagrams(diagram_of(knot))
        counted = self.listed is not None and (config.codes or nx <= LISTED_NX)
        self.existing = len(self.listed or ()) if counted else None
        self._drawn: dict[GaussCode, None] = {}
        self._rng = generator(Stream.DRAWING_CODES, config.seed, nx)
        self._slots: list[tuple[int, int]] = []
        if self.listed is None:
            self.wanted = len(shard.share(config.count))
            return
        if not self.listed:
            raise InvalidInput(f"no diagram of {config.knot} has {nx} crossings")
        order = generator(Stream.CODE_ORDER, config.seed, nx).permutation(len(self.listed))
        each = config.every_code or -(-config.count // len(self.listed))
        # first copies of all codes come before second copies; shards take slots in turn
        slots = list(itertools.product(range(each), order.tolist()))
        self._slots = [(index, copy) for copy, index in shard.dealt(slots)]
        count = len(slots) if config.every_code else config.count
        self.wanted = min(len(shard.share(count)), len(self._slots))
        self._shares = Counter(index for index, _ in self._slots)

    def share(self, index: int) -> int:
        """Return the number of states requested for a code."""
        return 1 if self.listed is None else self._shares[index]

    def slots(self) -> Iterator[tuple[int, int]]:
        """Yield the slots of the shard in order; endless if codes aren't listed."""
        if self.listed is not None:
            yield from self._slots
            return
        for position in itertools.count():
            yield self._shard.number - 1 + position * self._shard.of, 0

    def __getitem__(self, index: int) -> GaussCode:
        if self.listed is not None:
            return self.listed[index]
        while len(self._drawn) <= index:
            self._drawn.setdefault(self._next())
        return list(self._drawn)[index]

    def _next(self) -> GaussCode:
        """Draw the next random code that shows the knot."""
        for _ in range(_RARE):
            code = uniform_code(self._nx, self._rng)
            if shows(code, self._knot):
                return code
        raise InvalidInput(
            f"none of {_RARE} random codes with {self._nx} crossings shows {self._knot}"
        )
