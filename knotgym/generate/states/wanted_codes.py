"""The codes that a run draws states of, and how many of each."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import count, islice

from knotgym.common import InvalidInput, Stream
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.topology import (
    LISTED_NX,
    GaussCode,
    based_diagrams,
    codes_of,
    diagram_of,
    shows,
    type_of,
    uniform_code,
)

_RARE = 20_000  # random codes to try until one shows the knot


class WantedCodes:
    """The codes with one nx, by index.

    Attributes:
        listed: all codes; None if there are too many to list, and codes are drawn at random. For a
            knot whose crossing number exceeds LISTED_NX, the diagram of the knot table from every
            base point.
        existing: number of codes that show the knot; None if unknown.
        wanted: number of states to make.
    """

    def __init__(self, config: GenerateConfig, nx: int) -> None:
        self._knot, self._nx = config.knot, nx
        self.listed: Sequence[GaussCode] | None = None
        if config.codes:
            self.listed = [code for code in config.parsed if code.nx == nx]
        elif nx <= LISTED_NX:
            self.listed = codes_of(type_of(config.knot), nx)
        elif nx == diagram_of(config.knot).nx:
            self.listed = based_diagrams(diagram_of(config.knot))
        counted = self.listed is not None and (config.codes or nx <= LISTED_NX)
        self.existing = len(self.listed or ()) if counted else None
        self._drawn: dict[GaussCode, None] = {}
        self._rng = Stream.DRAWING_CODES.generator(config.seed, nx)
        self._order: list[int] | None = None
        self.wanted = config.count
        if self.listed is None:
            return
        if not self.listed:
            raise InvalidInput(f"no diagram of {config.knot} has {nx} crossings")
        order = Stream.CODE_ORDER.generator(config.seed, nx).permutation(len(self.listed))
        each = config.every_code or -(-config.count // len(self.listed))
        # first copies of all codes come before second copies
        self._order = order.tolist() * each
        if config.every_code:
            self.wanted = len(self._order)

    def lacking(self, have: Mapping[int, int], given_up: Collection[int]) -> Counter[int]:
        """Count the states still to be made, by index of their code.

        A code that is given up keeps the states it has, and later codes take its other places.
        """
        chosen = Counter[int]()
        order: Iterator[int] = count() if self._order is None else iter(self._order)
        fitting = (one for one in order if one not in given_up or chosen[one] < have.get(one, 0))
        # counted while `fitting` is followed, since it looks at the counts so far
        for index in islice(fitting, self.wanted):
            chosen[index] += 1
        return chosen - Counter(have)

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
