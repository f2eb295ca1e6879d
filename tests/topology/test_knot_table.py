"""The table of knots, checked against KnotInfo's polynomials."""

import json
from pathlib import Path

import numpy as np
import pytest

from knotgym.common import InvalidInput
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import (
    _prime_diagrams,
    based_diagrams,
    diagram_of,
    knot_type,
    shows,
    type_of,
)
from knotgym.topology.polynomials import alexander_polynomial, jones_polynomial
from knotgym.topology.reidemeister import is_alternating

INFO = json.loads((Path(__file__).parent / "knotinfo.json").read_text())["knots"]


def test_the_table_has_the_249_prime_knots_to_ten_crossings() -> None:
    crossings = [code.nx for code in _prime_diagrams().values()]
    assert [crossings.count(nx) for nx in range(3, 11)] == [1, 1, 2, 3, 7, 21, 49, 165]
    assert _prime_diagrams().keys() == INFO.keys()


def test_every_diagram_has_the_polynomials_that_knotinfo_has_hand_and_all() -> None:
    for name, code in _prime_diagrams().items():
        lowest, values, alexander = INFO[name]
        told = tuple((power, value) for power, value in enumerate(values, lowest) if value)
        assert jones_polynomial(code) == told, name
        sign = 1 if sum(alexander) > 0 else -1
        assert list(alexander_polynomial(code)) == [sign * value for value in alexander], name
        spans_crossings = told[-1][0] - told[0][0] == code.nx
        assert spans_crossings == is_alternating(code), name


def test_every_diagram_is_named_as_itself_from_any_base_and_in_the_mirror() -> None:
    for place, (name, code) in enumerate(_prime_diagrams().items()):
        seen = code.rebased(place).switched() if place % 2 else code.reversed().rebased(place)
        assert knot_type(seen) == name


def test_a_diagram_that_is_not_the_tables_is_told_by_its_polynomials() -> None:
    kinked = GaussCode.relabelled([9, -9, *diagram_of("8_19").visits])
    assert knot_type(kinked) == "8_19"


def test_a_name_means_one_hand_and_m_the_other() -> None:
    right, left = (jones_polynomial(diagram_of(name)) for name in ("3_1", "m3_1"))
    assert right == ((1, 1), (3, 1), (4, -1)) and left == ((-4, -1), (-3, 1), (-1, 1))
    one, other = diagram_of("8_19"), diagram_of("m8_19")
    assert dict(jones_polynomial(other)) == {-k: value for k, value in jones_polynomial(one)}
    assert shows(one, "8_19") and not shows(one, "m8_19") and shows(one.plain, "m8_19")


def test_the_granny_is_told_from_the_square_knot() -> None:
    granny, square = diagram_of("3_1#3_1"), diagram_of("3_1#m3_1")
    assert knot_type(granny) == knot_type(square) == "3_1#3_1"
    assert shows(granny, "3_1#3_1") and not shows(square, "3_1#3_1")
    assert shows(square, "m3_1#3_1")


@pytest.mark.parametrize("name", ["3_1#4_1", "10_25#3_1", "m8_20#m3_1", "4_1#5_2"])
def test_a_sum_is_named_by_its_summands_in_order(name: str) -> None:
    assert knot_type(diagram_of(name)) == type_of(name)
    assert type_of("10_25#3_1") == "3_1#10_25"


def test_a_diagram_from_every_base_keeps_its_hand() -> None:
    found = based_diagrams(diagram_of("7_3"))
    draw = np.random.default_rng(0).integers(len(found), size=3)
    assert len(found) > 7 and all(shows(found[k], "7_3") for k in draw)


@pytest.mark.parametrize("name", ["9_50", "10_166", "trefoil", "", "3_1#", "mm3_1", "11a_1"])
def test_a_knot_that_is_not_in_the_table_is_one_line(name: str) -> None:
    with pytest.raises(InvalidInput, match="3_1 to 10_165") as caught:
        diagram_of(name)
    assert "\n" not in str(caught.value)
