"""PD and DT codes, against SnapPy, spherogram and KnotInfo's tables (run with -m clients)."""

import json
import re
from collections import Counter
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knotgym.common import InvalidInput
from knotgym.topology.diagrams import _walked, uniform_code, with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import Knot, _prime_diagrams, knot_type
from knotgym.topology.notation import (
    _from_dt,
    _from_pd,
    _parse_code,
    dt_text,
    parse_codes,
    pd_code,
    pd_text,
)
from knotgym.topology.reidemeister import without_bigons
from knotgym.topology.symmetry import Symmetry, canonical

CODES = Path(__file__).parents[1] / "codes"
TREFOIL = GaussCode.parse("1-c,2+c,3-c,1+c,2-c,3+c")
LEFT_TREFOIL = GaussCode(TREFOIL.visits, "aaa")


def listed_codes() -> dict[GaussCode, str]:
    """Every code of 0 to 4 crossings, each with every chirality, and its knot."""
    found = {}
    for nx in range(5):
        listed = json.loads((CODES / f"codes_n{nx}.json").read_text())["codes"]
        for text, entry in listed.items():
            for letters in entry["chirality"]:
                found[GaussCode(GaussCode.parse(text).visits, letters)] = entry["knot"]
    return found


def test_every_code_of_up_to_four_crossings_comes_back() -> None:
    codes = listed_codes()
    assert len(codes) == 4533
    for code in codes:
        assert _parse_code(pd_text(code)) == code
        assert _parse_code(dt_text(code)) == code.plain


@given(st.integers(5, 40), st.integers(0, 2**32))
def test_larger_codes_come_back(nx: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    code = with_chirality(uniform_code(min(nx, 9), rng))
    assert _from_pd(rng.permutation(pd_code(code)).tolist()) == code
    assert _from_dt(json.loads(dt_text(code))) == code.plain


# what other programs write, and the same code as a list of visits; without letters where the
# notation has no handedness
AS_OTHERS_WRITE = {
    TREFOIL: """[[1,5,2,4],[3,1,4,6],[5,3,6,2]]
        PD[X[1, 5, 2, 4], X[3, 1, 4, 6], X[5, 3, 6, 2]]
         [(0, 4, 1, 3), (2, 0, 3, 5), (4, 2, 5, 1)]
        X[1,5,2,4] X[3,1,4,6] X[5,3,6,2]
        [1,5,2,4],[3,1,4,6],[5,3,6,2]
        {1,5,2,4}, {3,1,4,6}, {5,3,6,2}
        U1+O2+U3+O1+U2+O3+
        u1+ o2+ u3+ o1+ u2+ o3+""",
    LEFT_TREFOIL: "U1-O2-U3-O1-U2-O3-|PD[X[0,3,1,4],X[4,1,5,2],X[2,5,3,0]];",
    TREFOIL.switched().plain: "[4, 6, 2]|4 6 2|4,6,2|DT: [(4,6,2)]|DTCode[4, 6, 2]"
    "|O1-U2-O3-U1-O2-U3|1 -2 3 -1 2 -3"
    # whose plus is under, as its name says
    "|KnotInfo:{-1,2,-3,1,-2,3}",
    TREFOIL.plain: "-1 2 -3 1 -2 3|[-7,2,-3,7,-2,3]|GaussCode[-1, 3, -2, 1, -3, 2]",
    GaussCode(): "|[]|PD[]|PD[Loop[1]]|DT: []",
    # four numbers are a DT code unless an edge repeats
    _from_dt([4, 6, 8, 2]): "[(4,6,8,2)]",
    GaussCode.parse("1-c,1+c"): "[[1,1,2,2]]",
    GaussCode.parse("1+a,1-a"): "[[2,1,1,2]]|O1-U1-",
}
# the Knot Atlas says it in both notations
FIGURE_EIGHT = "GaussCode[1, -4, 3, -1, 2, -3, 4, -2]", "X[4,2,5,1]X[8,6,1,5]X[6,3,7,4]X[2,7,3,8]"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        *(
            (text, code)
            for code, texts in AS_OTHERS_WRITE.items()
            for text in re.split(r"\||\n {8}", texts)
        ),
        (FIGURE_EIGHT[0], _parse_code(FIGURE_EIGHT[1]).plain),
    ],
)
def test_codes_are_read_as_others_write_them(text: str, code: GaussCode) -> None:
    assert _parse_code(text) == code


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[1,2,3,4],[1,2,3,5]]", "edge 4 occurs 1 times"),
        ("[[1,3,2,4],[3,1,4,2]]", "not a link of several components"),
        ("[[2,4,1,5],[3,1,4,6],[5,3,6,2]]", "walked backwards"),
        ("[4, 6, 8, 10, 2]", "no planar diagram has it"),
        ("DT:[(4,6),(2,8)]", "it can't be read"),
        ("1,5,2,4;5,3,6,2;3,1,4,6", "cannot read the visit"),
        ("[" * 20_000, "it can't be read"),
        ("9" * 40_000, "too long"),
        (" ".join(str(2 * k) for k in range(1, 1002)), "too large"),
        ("{2, {1, 1, 1}}", "a braid's word isn't read"),
        ("{1, 1, 1}", "as in a braid's word"),
        ("[[[1, -2, 3, -1, 2, -3]], [1, 1, 1]]", "Sage's oriented Gauss code isn't read"),
        ("3_1", "a knot's name isn't read"),
        ("O1+U1-", "crossing 1 has two signs"),
        ("KnotInfo:{1,2}", "crossing 1 is visited 0 times over and 1 under"),
        ("{-1,2,-3,1,-2,3}", "KnotInfo:"),
    ],
)
def test_a_bad_code_is_refused_in_one_short_line(text: str, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem) as caught:
        _parse_code(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def kinks(visit: str, count: int) -> str:
    """Return a code of so many kinks; `visit` spells a kink's two."""
    return ",".join(visit.format(k) for k in range(1, count + 1))


@pytest.mark.parametrize("visit", ["{0}+,{0}-", "{0} -{0}", "O{0},U{0}", "O{0}+,U{0}+"])
def test_the_largest_code_is_read_and_none_larger(visit: str) -> None:
    with pytest.raises(InvalidInput, match="too large|too long"):
        _parse_code(kinks(visit, 1001))
    assert _parse_code(kinks(visit, 1000)).nx == 1000


@given(st.text("[](),+-acDTPX 0123456789", max_size=60))
def test_any_text_is_a_code_or_refused(text: str) -> None:
    try:
        _parse_code(text)
    except InvalidInput:
        pass


def require_same_abroad(code: GaussCode, knot: str) -> None:
    """Check that spherogram reads both codes as this diagram and knot, and writes them back."""
    import spherogram

    link = spherogram.Link(pd_code(code))
    written = _from_pd(link.PD_code(min_strand_index=1)) if code.nx else GaussCode()
    # spherogram picks the base point of a diagram of one crossing itself
    assert written in ([code, code.rebased(1)] if code.nx == 1 else [code])
    assert link.writhe() == sum(code.signs) and len(link) == code.nx
    if code.nx > 1:
        assert _from_dt([*link.DT_code()[0]]) == code.plain
        # its own reader of DT codes fails at nugatory crossings, and may never return
        if 1 not in Counter(_walked(code.visits)[0]).values():
            again = spherogram.Link(f"DT: [{tuple(json.loads(dt_text(code)))}]")
            read = _from_dt([*again.DT_code()[0]])  # at another base point, or switched
            assert canonical(read, Symmetry.DIAGRAM) == canonical(code, Symmetry.DIAGRAM)
    link.simplify("basic")
    if link.crossings:
        link.simplify("global")
    if knot == "0_1":
        assert not link.crossings
    else:
        own = spherogram.Link(pd_code(Knot(knot).diagram)).knot_floer_homology()["ranks"]
        assert link.knot_floer_homology()["ranks"] in (own, mirrored(own))


def mirrored(ranks: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    return {(-alexander, -maslov): rank for (alexander, maslov), rank in ranks.items()}


@pytest.mark.clients
def test_spherogram_reads_and_writes_every_code_of_up_to_four_crossings() -> None:
    pytest.importorskip("spherogram")
    for code, knot in listed_codes().items():
        require_same_abroad(code, knot)


@pytest.mark.clients
def test_the_249_knots_are_those_of_knotinfo() -> None:
    rows = pytest.importorskip("database_knotinfo").link_list()[2:]
    info = {row["name"]: row for row in rows}
    assert len(_prime_diagrams()) == 249
    for name, code in _prime_diagrams().items():
        pd = json.loads(info[name]["pd_notation"])
        assert sorted(pd_code(code)) == sorted(pd) and _from_pd(pd) == code
        table_dt = _parse_code(info[name]["dt_notation"])
        assert dt_text(table_dt) == info[name]["dt_notation"]
        assert knot_type(table_dt) in (name, "unknown")
        gauss = _parse_code(f"KnotInfo:{info[name]['gauss_notation']}")
        assert canonical(gauss, Symmetry.DIAGRAM) == canonical(code, Symmetry.DIAGRAM)
        require_same_abroad(code, name)


def hard_unknots() -> dict[str, GaussCode]:
    path = files("knotgym.topology") / "data/hard-unknots.txt"
    lines = [line.partition("#") for line in path.read_text("utf-8").splitlines()]
    return {name.strip(): _parse_code(text) for text, _, name in lines if text}


def test_the_hard_unknots_are_unknots_that_no_simplifying_move_undoes() -> None:
    codes = hard_unknots()
    assert len(codes) == 22  # 21 and the plain loop
    for name, code in codes.items():
        assert not code.nx or name.endswith(f", {code.nx} crossings")
        if 0 < code.nx <= 32:
            assert knot_type(code) == "0_1", name
            assert without_bigons(with_chirality(code)).nx == code.nx, name


@pytest.mark.clients
def test_snappy_certifies_every_hard_unknot() -> None:
    pytest.importorskip("snappy")
    spherogram = pytest.importorskip("spherogram")
    for name, code in hard_unknots().items():
        if code.nx:
            link = spherogram.Link([tuple(one) for one in pd_code(with_chirality(code))])
            smaller = link.copy()
            smaller.simplify("global")
            if smaller.crossings:  # a knot whose group is infinite cyclic is the unknot (Dehn)
                group = link.exterior().fundamental_group()
                assert (group.num_generators(), group.num_relators()) == (1, 0), name


def test_a_list_has_a_code_a_line() -> None:
    lines = ["# five", "O1U1", "4 6 8 2", "4 6 8 2 # twice the figure-eight knot", "[[1,1,2,2]]"]
    lines += ["PD[X[1,5,2,4],X[5,3,6,2],X[3,1,4,6]];"]
    codes = [*parse_codes(lines)]
    assert [code.nx for code in codes] == [1, 4, 4, 1, 3] and codes[4] == TREFOIL
    with pytest.raises(InvalidInput, match="line 4: "):
        [*parse_codes([*lines[:3], "[[1,2"])]
