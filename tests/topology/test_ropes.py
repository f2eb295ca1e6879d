"""Codes of open curves and of several: against labels of closed ones, and back from notations."""

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common import InvalidInput
from knotgym.topology import RopesCode, find_ropes_crossings, label, parse_ropes, pd_text

Array = NDArray[np.float64]


def curves(seed: int) -> tuple[list[Array], list[bool]]:
    """Return 1 to 3 random curves, open or closed."""
    rng = np.random.default_rng(seed)
    ropes = [rng.normal(size=(rng.integers(3, 9), 3)) for _ in range(rng.integers(1, 4))]
    return ropes, (rng.random(len(ropes)) < 0.5).tolist()


@pytest.mark.parametrize("seed", range(20))
def test_an_open_curve_has_the_code_of_the_closed_one_but_for_the_closing_edge(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(8, 3))
    points = points[np.argsort(points[:, 0])][[0, 3, 1, 5, 2, 6, 4, 7]]  # from left to right
    outside = [[9, points[-1, 1], 0], [9, 9, 0], [-9, 9, 0], [-9, points[0, 1], 0]]
    code = label(points, closed=False)
    assert str(code) == str(label(np.concatenate([points, outside])))
    back = label(points[::-1], closed=False)
    assert back == code.reversed() and back.smallest() == code.smallest()


@pytest.mark.parametrize("seed", range(20))
def test_codes_come_back_from_notations_and_keep_their_smallest_form(seed: int) -> None:
    ropes, closed = curves(seed)
    found = find_ropes_crossings(ropes, closed)
    code = found.code
    assert code.nx == len(found.sign) and code.closed == tuple(closed)
    assert RopesCode.parse(str(code), closed) == code.plain
    if all(code.visits):
        assert parse_ropes(pd_text(code)) == code
    moved = [np.roll(rope, 2 * shut, 0)[::-1] for rope, shut in zip(ropes, closed, strict=True)]
    assert find_ropes_crossings(moved, closed).code.smallest() == code.smallest()
    for k, rope in enumerate(ropes):
        if closed[k]:
            assert code.rope(k) == label(rope)
        else:
            with pytest.raises(InvalidInput, match=f"curve {k + 1} is open"):
                code.rope(k)


def test_what_a_notation_cannot_show_is_refused_by_name() -> None:
    for text in ("DT: [(4,6,2)]", "[4,6,2]"):
        with pytest.raises(InvalidInput, match="a DT code has no ends"):
            parse_ropes(text)
    plain = label(np.eye(3), closed=False)
    with pytest.raises(InvalidInput, match="a curve passes no crossing"):
        pd_text(plain)
    with pytest.raises(InvalidInput, match="2 ropes, and whether 1 are closed"):
        find_ropes_crossings([np.eye(3)] * 2, [True])
    with pytest.raises(InvalidInput, match=r"no open rope: the array has shape \(1, 3\)"):
        label(np.zeros((1, 3)), closed=False)
    assert str(parse_ropes("O1-U1-", closed=False)) == "1+,1-"
