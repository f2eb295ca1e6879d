"""Knot types of known knots and published lists, which Reidemeister moves don't change."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knotgym.common import InvalidInput
from knotgym.topology.crossings import label
from knotgym.topology.diagrams import faces, is_planar
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import Knot, _is_unknot, _prime_diagrams, knot_type
from knotgym.topology.notation import _from_dt
from knotgym.topology.polynomials import alexander_polynomial, jones_polynomial
from knotgym.topology.reidemeister import connected_sum, is_alternating, simplify, without_bigons

CODES = Path(__file__).parents[1] / "codes"
TREFOIL = GaussCode.parse("1+c,2-c,3+c,1-c,2+c,3-c")
SMALL = [name for name in _prime_diagrams() if int(name.split("_")[0]) <= 7]
seeds = st.integers(0, 2**32 - 1)


def kinked(code: GaussCode, rng: np.random.Generator) -> GaussCode:
    """Add a kink at random (Reidemeister's first move)."""
    new, at = code.nx + 1, int(rng.integers(len(code.visits) + 1))
    loop = (new, -new) if rng.integers(2) else (-new, new)
    letters = {**dict(enumerate(code.chirality or "", 1)), new: str(rng.choice(["a", "c"]))}
    return GaussCode.relabelled(code.visits[:at] + loop + code.visits[at:], letters)


def poked(code: GaussCode, rng: np.random.Generator) -> GaussCode:
    """Push a finger of a random edge over or under another edge of a face (second move)."""
    wide = [face for face in faces(code) if len({dart // 2 for dart in face}) > 1]
    face = wide[int(rng.integers(len(wide)))]
    while True:
        finger, wall = (int(dart) for dart in rng.choice(face, 2))
        if finger // 2 != wall // 2:
            break
    new = code.nx + 1
    height = 1 if rng.integers(2) else -1
    over, under = [height * new, height * (new + 1)], [-height * (new + 1), -height * new]
    pieces = {
        finger // 2: over if finger % 2 == 0 else over[::-1],
        wall // 2: under if wall % 2 == 0 else under[::-1],
    }
    # along both darts the finger goes out to the left and comes in from the left
    positive = ((finger + wall) % 2 == 0) == (height > 0)
    letters = dict(enumerate((code.chirality or "") + ("ca" if positive else "ac"), 1))
    visits: list[int] = []
    for edge, visit in enumerate(code.visits):
        visits += [visit, *pieces.get(edge, [])]
    return GaussCode.relabelled(visits, letters)


def moved(code: GaussCode, rng: np.random.Generator, moves: int) -> GaussCode:
    for _ in range(moves):
        code = poked(code, rng) if code.nx and rng.integers(3) else kinked(code, rng)
    return code


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.linalg.det(q)
    return q


def torus_knot(p: int, q: int, beads: int = 100) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, beads, endpoint=False)
    radius = 2.0 + np.cos(q * angle)
    return np.column_stack(
        [radius * np.cos(p * angle), radius * np.sin(p * angle), -np.sin(q * angle)]
    )


def figure_eight(beads: int = 300) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, beads, endpoint=False)
    flat = (2.0 + np.cos(2.0 * angle)) * np.exp(3j * angle)
    return np.column_stack([flat.real, flat.imag, np.sin(4.0 * angle)])


@pytest.mark.parametrize("nx", range(5))
def test_types_of_short_codes_are_the_listed_ones(nx: int) -> None:
    listed = json.loads((CODES / f"codes_n{nx}.json").read_text())["codes"]
    for text, entry in listed.items():
        code = GaussCode.parse(text)
        assert knot_type(code) == entry["knot"]
        for letters in (None, *entry["chirality"]):
            assert _is_unknot(GaussCode(code.visits, letters)) == (entry["knot"] == "0_1")


@pytest.mark.parametrize(
    ("points", "name"),
    [
        (torus_knot(3, 2), "3_1"),
        (torus_knot(2, 7), "7_1"),
        (torus_knot(3, 4), "8_19"),
        (torus_knot(1, 4), "0_1"),
        (torus_knot(2, 11), "unknown"),  # past the table
        (figure_eight(), "4_1"),
    ],
)
def test_curves_given_by_formula_are_named_from_every_side(points: np.ndarray, name: str) -> None:
    rng = np.random.default_rng(0)
    assert {knot_type(label(points @ rotation(rng).T)) for _ in range(5)} == {name}


@given(seeds, st.sampled_from([7] * 9 + [40]))  # 40 moves: past the reach of polynomials
@settings(max_examples=60)
def test_random_unknot_diagrams_are_recognised(seed: int, moves: int) -> None:
    code = moved(GaussCode(), np.random.default_rng(seed), moves)
    assert is_planar(code) and _is_unknot(code) and knot_type(code) == "0_1"


@given(seeds)
@settings(max_examples=40)
def test_moves_change_neither_the_name_nor_the_polynomials(seed: int) -> None:
    rng = np.random.default_rng(seed)
    name = SMALL[int(rng.integers(len(SMALL)))]
    code = Knot(name).diagram
    tangled = moved(code, rng, 4)
    assert is_planar(tangled) and knot_type(tangled) == name
    assert jones_polynomial(tangled) == jones_polynomial(code)
    assert alexander_polynomial(tangled) == alexander_polynomial(code)


@given(seeds)
@settings(max_examples=40)
def test_simplifying_keeps_the_knot_and_adds_nothing(seed: int) -> None:
    code = label(np.random.default_rng(seed).normal(size=(14, 3)))
    simpler = simplify(code)
    assert is_planar(simpler) and simpler.nx <= without_bigons(code).nx <= code.nx
    assert jones_polynomial(simpler) == jones_polynomial(code)
    assert alexander_polynomial(simpler) == alexander_polynomial(code)


def test_the_polynomials_of_a_sum_are_products() -> None:
    granny = connected_sum([TREFOIL, TREFOIL])
    assert alexander_polynomial(granny) == (1, -2, 3, -2, 1)
    assert jones_polynomial(granny) == ((2, 1), (4, 2), (5, -2), (6, 1), (7, -2), (8, 1))


def test_codes_that_no_curve_shows_have_no_knot() -> None:
    virtual = GaussCode.parse("1+,2+,1-,2-")
    for question in (_is_unknot, knot_type, simplify, alexander_polynomial, jones_polynomial):
        with pytest.raises(InvalidInput):
            question(virtual)


@pytest.mark.parametrize(
    "knot",
    [
        _from_dt([4, 8, 12, 2, -16, -18, 6, -20, -22, -14, -10]),  # of Kinoshita and Terasaka
        _from_dt([4, 8, 12, 2, -18, -20, 6, -10, -22, -14, -16]),  # of Conway
    ],
)
def test_a_knot_with_trivial_alexander_polynomial_is_still_knotted(knot: GaussCode) -> None:
    assert alexander_polynomial(knot) == (1,)
    assert not _is_unknot(knot)


# the table of knots, against KnotInfo's polynomials

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


def test_a_name_means_one_hand_and_m_the_other() -> None:
    right, left = (jones_polynomial(Knot(name).diagram) for name in ("3_1", "m3_1"))
    assert right == ((1, 1), (3, 1), (4, -1)) and left == ((-4, -1), (-3, 1), (-1, 1))
    one, other = Knot("8_19").diagram, Knot("m8_19").diagram
    assert dict(jones_polynomial(other)) == {-k: value for k, value in jones_polynomial(one)}
    assert Knot("8_19").is_shown_by(one) and not Knot("m8_19").is_shown_by(one)
    assert Knot("m8_19").is_shown_by(one.plain)
    assert Knot("m4_1").is_shown_by(Knot("4_1").diagram)  # which is its own mirror image


def test_the_granny_is_told_from_the_square_knot() -> None:
    granny, square = Knot("3_1#3_1").diagram, Knot("3_1#m3_1").diagram
    assert knot_type(granny) == knot_type(square) == "3_1#3_1"
    assert Knot("3_1#3_1").is_shown_by(granny) and not Knot("3_1#3_1").is_shown_by(square)
    assert Knot("m3_1#3_1").is_shown_by(square)


@pytest.mark.parametrize("name", ["3_1#4_1", "10_25#3_1", "m8_20#m3_1", "4_1#5_2"])
def test_a_sum_is_named_by_its_summands_in_order(name: str) -> None:
    assert knot_type(Knot(name).diagram) == Knot(name).type
    assert Knot("10_25#3_1").type == "3_1#10_25"


def test_a_diagram_from_every_base_keeps_its_hand() -> None:
    found = Knot("7_3").diagrams()
    draw = np.random.default_rng(0).integers(len(found), size=3)
    assert len(found) > 7 and all(Knot("7_3").is_shown_by(found[k]) for k in draw)


@pytest.mark.parametrize("name", ["9_50", "10_166", "trefoil", "", "3_1#", "mm3_1", "11a_1"])
def test_a_knot_that_is_not_in_the_table_is_one_line(name: str) -> None:
    with pytest.raises(InvalidInput, match="3_1 to 10_165") as caught:
        _ = Knot(name).diagram
    assert "\n" not in str(caught.value)
