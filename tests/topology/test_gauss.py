"""Gauss codes: parsing, printing, and the laws of mirroring, reversing and rebasing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common import InvalidInput
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


@given(codes(), st.integers(-20, 20), st.integers(-20, 20))
def test_images_undo_themselves_and_rebasing_adds_up(code: GaussCode, j: int, k: int) -> None:
    assert code.reversed().reversed() == code.switched().switched() == code
    assert code.rebased(j).rebased(k) == code.rebased(j + k)


MALFORMED = """1 1+ 1+,1+ 1+,1-, , 0+,0- 2+,2- 1+,2-,1- 1+,1-,1+,1- +1,-1 1+-,1- ----
    1+a,1-c 1+a,1- 1+b,1-b 1+a,1-a,2+,2-"""


@pytest.mark.parametrize("text", MALFORMED.split())
def test_malformed_text_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput) as refusal:
        GaussCode.parse(text)
    assert "\n" not in str(refusal.value) and repr(text) in str(refusal.value)


@pytest.mark.parametrize("letters", ["", "a", "aaa", "ab", "AC"])
def test_a_wrong_chirality_is_refused(letters: str) -> None:
    with pytest.raises(InvalidInput):
        GaussCode((1, -1, 2, -2), letters)


def test_visits_are_whole_numbers_of_any_library() -> None:
    assert GaussCode((np.int64(1), np.int8(-1))) == GaussCode((1, -1))  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="visits of a Gauss code are whole numbers"):
        GaussCode((1.0, -1.0))  # type: ignore[arg-type]


def test_letters_that_are_not_known_are_not_invented() -> None:
    for ask in ("chiral", "signs"):
        with pytest.raises(InvalidInput):
            getattr(GaussCode((1, -1)), ask)


def test_matching_ignores_letters() -> None:
    assert GaussCode((1, -1), "a").matches(GaussCode((1, -1), "c"))
    assert not GaussCode((1, -1), "a").matches(GaussCode((-1, 1), "a"))
