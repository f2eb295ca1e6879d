"""Planarity, checked against published lists; faces and summands; codes drawn at random."""

import json
from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common import InvalidInput
from knotgym.topology.diagrams import (
    _walked,
    chiralities,
    faces,
    is_planar,
    planar_codes,
    summands,
    uniform_code,
    with_chirality,
)
from knotgym.topology.gauss import GaussCode

CODES = Path(__file__).parents[1] / "codes"
TREFOIL = GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c")
planar = st.integers(0, 4).flatmap(lambda nx: st.sampled_from(list(planar_codes(nx))))


@pytest.mark.parametrize("nx", range(5))
def test_planar_codes_and_chiralities_are_the_listed_ones(nx: int) -> None:
    listed = json.loads((CODES / f"codes_n{nx}.json").read_text())["codes"]
    assert {str(code): list(chiralities(code)) for code in planar_codes(nx)} == {
        text: entry["chirality"] for text, entry in listed.items()
    }


@pytest.mark.parametrize(
    ("nx", "codes", "chiral"),
    [(5, 3616, 57472), pytest.param(6, 37888, 857344, marks=pytest.mark.slow)],
)
def test_longer_planar_codes_are_as_many_as_they_should(nx: int, codes: int, chiral: int) -> None:
    found = list(planar_codes(nx))
    assert (len(set(found)), sum(2 ** (max(_walked(code.visits)[0]) + 1) for code in found)) == (
        codes,
        chiral,
    )


@given(planar)
def test_no_other_pattern_is_planar(code: GaussCode) -> None:
    patterns = ("".join(letters) for letters in product("ac", repeat=code.nx))
    assert tuple(
        pattern for pattern in patterns if is_planar(GaussCode(code.visits, pattern))
    ) == chiralities(code)


@given(planar, st.integers(0, 7))
def test_planarity_knows_no_base_direction_or_height(code: GaussCode, k: int) -> None:
    for one in (code, with_chirality(code)):
        assert is_planar(one.rebased(k)) and is_planar(one.reversed()) and is_planar(one.switched())


@given(planar)
def test_a_code_is_drawn_with_its_chirality_or_the_first(code: GaussCode) -> None:
    drawn = with_chirality(code)
    assert drawn.chirality == chiralities(code)[0] and with_chirality(drawn) is drawn


def test_a_code_of_many_parts_is_drawn_without_listing_its_chiralities() -> None:
    kinks = GaussCode(tuple(sign * k for k in range(1, 61) for sign in (1, -1)))
    assert is_planar(with_chirality(kinks))  # of 2 ** 60


@pytest.mark.parametrize(
    "text",
    [
        "1+,2+,1-,2-",
        "1+,2+,3+,4+,5+,3-,4-,1-,2-,5-",  # even, but not planar
        "1+c,2-c,3+a,1-c,2+c,3-a",  # a trefoil with one letter wrong
    ],
)
def test_a_code_that_no_curve_shows_is_not_planar_and_named(text: str) -> None:
    code = GaussCode.parse(text)
    assert not is_planar(code) and (code.chirality or chiralities(code) == ())
    with pytest.raises(InvalidInput) as refusal:
        with_chirality(code)
    assert repr(text) in str(refusal.value)


@given(planar)
def test_a_planar_code_has_two_faces_more_than_crossings(code: GaussCode) -> None:
    found = faces(with_chirality(code))
    assert len(found) == (code.nx + 2 if code.nx else 0)
    assert sorted(dart for face in found for dart in face) == list(range(4 * code.nx))


def test_summands_come_in_order_of_first_visit() -> None:
    both = GaussCode.parse("1+a,2+c,3-c,4+c,2-c,3+c,4-c,1-a")
    assert [summand.chiral for summand in summands(both)] == ["1+a,1-a", "1+c,2-c,3+c,1-c,2+c,3-c"]


@given(planar)
def test_summands_share_out_the_crossings(code: GaussCode) -> None:
    assert sum(summand.nx for summand in summands(code)) == code.nx
    assert all(is_planar(summand) for summand in summands(with_chirality(code)))


def chi_square(counts: Counter[str], kinds: int) -> float:
    """Pearson's statistic against the uniform distribution, per degree of freedom."""
    expected = counts.total() / kinds
    missing = (kinds - len(counts)) * expected
    off = sum((count - expected) ** 2 / expected for count in counts.values())
    return (off + missing) / (kinds - 1)


@pytest.mark.parametrize(("nx", "draws"), [(1, 100), (2, 400), (3, 2000)])
def test_every_planar_code_is_as_likely_as_any_other(nx: int, draws: int) -> None:
    rng = np.random.default_rng(nx)
    counts = Counter(str(uniform_code(nx, rng)) for _ in range(draws))
    codes = {str(code) for code in planar_codes(nx)}
    assert set(counts) == codes
    assert chi_square(counts, len(codes)) < 2
