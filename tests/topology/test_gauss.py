"""Gauss codes: parsing, printing, and the laws of mirroring, reversing and rebasing."""

import pickle
from dataclasses import FrozenInstanceError
from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common.errors import InvalidInput, KnotgymError
from knotgym.topology.gauss import GaussCode


@st.composite
def codes(draw: st.DrawFn, max_nx: int = 7) -> GaussCode:
    """Abstract codes, planar or not, with or without chirality."""
    nx = draw(st.integers(0, max_nx))
    visits = draw(st.permutations([label * side for label in range(1, nx + 1) for side in (1, -1)]))
    letters = draw(st.none() | st.text("ac", min_size=nx, max_size=nx))
    return GaussCode.relabelled(visits, None if letters is None else dict(enumerate(letters, 1)))


@given(codes())
def test_printing_and_parsing_is_a_round_trip(code: GaussCode) -> None:
    assert GaussCode.parse(str(code)) == code.plain
    if code.chirality is not None:
        assert GaussCode.parse(code.chiral) == code


@given(codes())
def test_reversing_twice_is_nothing(code: GaussCode) -> None:
    assert code.reversed().reversed() == code


@given(codes())
def test_mirroring_twice_is_nothing(code: GaussCode) -> None:
    assert code.mirrored().mirrored() == code


@given(codes())
def test_mirroring_switches_every_visit(code: GaussCode) -> None:
    assert code.mirrored().visits == tuple(-visit for visit in code.visits)


@given(codes(), st.integers(-20, 20), st.integers(-20, 20))
def test_rebasing_twice_adds_up(code: GaussCode, j: int, k: int) -> None:
    assert code.rebased(j).rebased(k) == code.rebased(j + k)


@given(codes().filter(lambda code: code.chirality is not None))
def test_mirroring_negates_the_writhe(code: GaussCode) -> None:
    assert code.mirrored().writhe == code.reflected().writhe == -code.writhe


@given(codes().filter(lambda code: code.chirality is not None), st.integers(0, 20))
def test_neither_direction_nor_base_changes_the_writhe(code: GaussCode, k: int) -> None:
    assert code.reversed().writhe == code.rebased(k).writhe == code.writhe


def test_reflecting_keeps_the_heights() -> None:
    assert GaussCode.parse("1+a,2-c,2+c,1-a").reflected().chiral == "1+c,2-a,2+a,1-c"


def test_spaces_are_allowed() -> None:
    assert GaussCode.parse(" 1+ , 1 - ") == GaussCode((1, -1))


def test_the_flat_loop_is_the_empty_text() -> None:
    flat = GaussCode.parse("")
    assert (str(flat), flat.chiral, flat.nx, flat.writhe) == ("", "", 0, 0)


def test_the_flat_loop_has_one_value() -> None:
    assert GaussCode((), None) == GaussCode((), "") == GaussCode().plain


@pytest.mark.parametrize(
    "text",
    [
        *(
            "1",
            "1+",
            "1+,1+",
            "1+,1-,",
            ",",
            "0+,0-",
            "2+,2-",
            "1+,2-,1-",
            "1+,1-,1+,1-",
            "+1,-1",
            "1+-,1-",
            "----",
        )
    ]
    + ["1+a,1-c", "1+a,1-", "1+b,1-b", "1+a,1-a,2+,2-"],
)
def test_malformed_text_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput) as refusal:
        GaussCode.parse(text)
    assert "\n" not in str(refusal.value) and repr(text) in str(refusal.value)


def test_a_crossing_that_is_visited_once_is_named() -> None:
    with pytest.raises(InvalidInput, match="crossing 2 is visited only once"):
        GaussCode.parse("1+,2+,1-")


def test_the_refusal_is_a_value_error_of_the_package() -> None:
    assert issubclass(InvalidInput, KnotgymError) and issubclass(InvalidInput, ValueError)


@pytest.mark.parametrize("letters", ["", "a", "aaa", "ab", "AC"])
def test_a_wrong_chirality_is_refused(letters: str) -> None:
    with pytest.raises(InvalidInput):
        GaussCode((1, -1, 2, -2), letters)


def test_letters_that_are_not_known_are_not_invented() -> None:
    for ask in ("chiral", "signs", "writhe"):
        with pytest.raises(InvalidInput):
            getattr(GaussCode((1, -1)), ask)


def test_matching_ignores_letters() -> None:
    assert GaussCode((1, -1), "a").matches(GaussCode((1, -1), "c"))
    assert not GaussCode((1, -1), "a").matches(GaussCode((-1, 1), "a"))


def test_codes_are_equal_and_hashed_by_value() -> None:
    assert len({GaussCode((1, -1), letter) for letter in (*"aacc", None, None)}) == 3


def test_a_code_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        delattr(GaussCode((1, -1)), "visits")


def test_a_code_pickles_whole() -> None:
    code = GaussCode.parse("1+a,1-a")
    assert pickle.loads(pickle.dumps(code)) == code


def test_abstract_codes_of_two_crossings_number_twelve() -> None:
    seen = set()
    for visits in product((1, -1, 2, -2), repeat=4):
        try:
            seen.add(GaussCode(visits))
        except InvalidInput:
            continue
    assert len(seen) == 12
