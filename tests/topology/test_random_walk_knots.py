"""Knot types of random walks beside another program's invariants.

SnapPy's Spherogram simplifies the diagram and computes its knot Floer homology; the ranks by
Alexander grading must be those of KnotInfo's diagram of the name that knotgym gives. They tell the
unknot from every knot, and 5_1 from 10_132. KNOTS=10000 looks at more.
"""

import json
import os
from collections import Counter
from functools import cache

import numpy as np
import pytest

from knotgym.topology import UNKNOT, UNKNOWN, knot_type, label_many, pd_text

pytestmark = pytest.mark.clients
KNOTS = int(os.environ.get("KNOTS", "200"))


def ranks(pd: list[list[int]]) -> dict[int, int]:
    """Ranks of the knot Floer homology of a diagram, by Alexander grading."""
    import spherogram

    link = spherogram.Link(pd)
    link.simplify("global")
    if not link.crossings:
        return {0: 1}
    found: Counter[int] = Counter()
    for (grading, _), rank in link.knot_floer_homology()["ranks"].items():
        found[grading] += rank
    return dict(found)


@cache
def listed(name: str) -> dict[int, int]:
    """Ranks of a named type: of KnotInfo's diagrams, multiplied over the summands."""
    from database_knotinfo import link_list

    whole = {0: 1}
    for part in name.split("#"):
        if part != UNKNOT:
            (text,) = (row["pd_notation"] for row in link_list() if row["name"] == part)
            product: Counter[int] = Counter()
            for one, many in ranks(json.loads(text.replace(";", ","))).items():
                for other, more in whole.items():
                    product[one + other] += many * more
            whole = dict(product)
    return whole


@pytest.mark.parametrize("steps", [30, 60])
def test_types_of_random_walks_are_those_of_spherogram(steps: int) -> None:
    pytest.importorskip("spherogram")
    pytest.importorskip("database_knotinfo")
    types: Counter[str] = Counter()
    for chunk in range(0, KNOTS, 200):
        moves = np.random.default_rng([steps, chunk]).normal(
            size=(min(200, KNOTS - chunk), steps, 3)
        )
        walks = np.cumsum(moves - moves.mean(axis=1, keepdims=True), axis=1)
        for code in label_many(walks):
            name, found = knot_type(code), ranks(json.loads(pd_text(code) or "[]"))
            types[name] += 1
            assert found == listed(name) if name != UNKNOWN else len(found) > 1, (code.chiral, name)
    print(steps, types.most_common(), flush=True)
    assert types[UNKNOT] < KNOTS and types[UNKNOWN] < KNOTS / 4
