"""Moves sideways of `benchmarks/long_play.py` keep the knot and can be taken back."""

import runpy
from itertools import islice

from knotgym.topology import GaussCode, chiralities, codes_of, shows

from ..scripts import ROOT

sideways = runpy.run_path(str(ROOT / "benchmarks" / "long_play.py"))["sideways"]
DIAGRAMS = [
    GaussCode(code.visits, letters)
    for nx, every in ((1, 1), (2, 1), (3, 5), (4, 41))
    for code in islice(codes_of("0_1", nx), 0, None, every)
    for letters in chiralities(code)
]


def test_moves_sideways_are_taken_back_by_their_like() -> None:
    thirds = 0
    for code in DIAGRAMS:
        after = list(sideways(code))
        thirds += len(after) - 2
        for other in after:
            assert shows(other, "0_1") and code in set(sideways(other)), (code.chiral, other.chiral)
    assert thirds > 20
