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
from knotgym.rope import MUJOCO, simulation
from knotgym.states import read_states, shipped
from knotgym.topology import notation
from knotgym.topology.crossings import label_many
from knotgym.topology.diagrams import _parts, uniform_code, with_chirality
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import _is_unknot, _prime_diagrams, diagram_of, knot_type
from knotgym.topology.notation import (
    _dt_code,
    _from_dt,
    _from_pd,
    dt_text,
    parse_code,
    parse_codes,
    pd_code,
    pd_text,
)
from knotgym.topology.reidemeister import without_bigons
from knotgym.topology.symmetry import Symmetry, canonical

CODES = Path(__file__).parents[1] / "codes"
TREFOIL = GaussCode.parse("1-c,2+c,3-c,1+c,2-c,3+c")
KINKS = ("1+a,1-a", "1+c,1-c", "1-a,1+a", "1-c,1+c")


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
        assert parse_code(pd_text(code)) == code
        assert parse_code(dt_text(code)) == code.plain


@given(st.integers(5, 40), st.integers(0, 2**32))
def test_larger_codes_come_back(nx: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    code = with_chirality(uniform_code(min(nx, 9), rng))
    assert _from_pd(rng.permutation(pd_code(code)).tolist()) == code
    assert _from_dt(_dt_code(code)) == code.plain


def test_a_kink_is_told_from_its_mirror_images() -> None:
    codes = [pd_text(GaussCode.parse(kink)) for kink in KINKS]
    assert codes == ["[[2,1,1,2]]", "[[2,2,1,1]]", "[[1,2,2,1]]", "[[1,1,2,2]]"]


def test_dt_loses_the_handedness_of_each_summand() -> None:
    granny, square = (diagram_of(name) for name in ("3_1#3_1", "3_1#m3_1"))
    switched = GaussCode(granny.visits, "ccc" + "aaa")
    assert _dt_code(switched) == _dt_code(granny) and max(_parts(granny)) == 1
    assert knot_type(switched) == knot_type(square) and pd_code(switched) != pd_code(granny)


LEFT = TREFOIL.switched().plain  # a DT code has one sign for each number, and no handedness


@pytest.mark.parametrize(
    ("text", "code"),
    [
        *(
            (text, TREFOIL)
            for text in (
                "1-c,2+c,3-c,1+c,2-c,3+c",
                "[[1,5,2,4],[3,1,4,6],[5,3,6,2]]",
                "PD[X[1, 5, 2, 4], X[3, 1, 4, 6], X[5, 3, 6, 2]]",
                " [(0, 4, 1, 3), (2, 0, 3, 5), (4, 2, 5, 1)] ",
                "X[1,5,2,4] X[3,1,4,6] X[5,3,6,2]",
                "[1,5,2,4],[3,1,4,6],[5,3,6,2]",
                "{1,5,2,4}, {3,1,4,6}, {5,3,6,2}",
                "X1524 X3146 X5362",
                "X1,5,2,4 X3,1,4,6 X5,3,6,2",
            )
        ),
        *((text, LEFT) for text in ("[4, 6, 2]", "4 6 2", "4,6,2", "DT: [(4,6,2)]")),
        ("DTCode[4, 6, 2]", LEFT),
        *((text, LEFT) for text in ("DT[cacbca]", "DT: cacbca", "DT[cacbca.000]")),
        *((text, GaussCode()) for text in ("", "[]", "PD[]", "PD[Loop[1]]", "DT: []")),
        # four numbers are a DT code unless an edge repeats
        ("[(4,6,8,2)]", _from_dt([4, 6, 8, 2])),
        ("[[1,1,2,2]]", GaussCode.parse(KINKS[3])),
    ],
)
def test_codes_are_read_as_others_write_them(text: str, code: GaussCode) -> None:
    assert parse_code(text) == code


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[1,2,3,4],[1,2,3,5]]", "edge 4 occurs 1 times"),
        ("[[1,3,2,4],[3,1,4,2]]", "not a link of several components"),
        ("[[2,4,1,5],[3,1,4,6],[5,3,6,2]]", "walked backwards"),
        ("[[1,4,2,5],[3,1,4,6],[5,3,6,2]]", "no planar diagram has it"),
        ("[4, 6, 8, 10, 2]", "no planar diagram has it"),
        ("[4, 6, 3]", "doesn't pair 3 odd visits"),
        ("[4, 4, 2]", "doesn't pair 3 odd visits"),
        ("DT:[(4,6),(2,8)]", "it can't be read"),
        ("DT[cacbc]", "isn't that of one component"),
        ("DT:eabcCaDeb", "isn't that of one component"),
        ("DT[cacbcB]", "doesn't pair 3 odd visits"),
        ("X142 X3641", "it can't be read"),
        ("GaussCode[1,2]", "crossing 1 is visited only once"),
        ("1,5,2,4;5,3,6,2;3,1,4,6", "cannot read the visit"),
        ("[[1,5,2,4],[3,1,4,6],[5,3,6,2]", "it can't be read"),
        ("[" * 20_000, "it can't be read"),
        ("9" * 40_000, "too long"),
        (" ".join(str(2 * k) for k in range(1, 1002)), "too large"),
        ("1+,1", "cannot read the visit"),
        ("__import__('os')", "cannot read the visit"),
        ("O1+U1-", "crossing 1 has two signs"),
        ("O1+U2O2+U1", "only some visits have a sign"),
        ("O1xU1", "it can't be read"),
        ("O1", "crossing 1 is visited only once"),
        ("KnotInfo:{1,2}", "crossing 1 is visited only once"),
        ("1 -1 ++", "it has 1 crossings and 2 signs"),
    ],
)
def test_a_bad_code_is_refused_in_one_short_line(text: str, problem: str) -> None:
    with pytest.raises(InvalidInput, match=problem) as caught:
        parse_code(text)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def kinks(visit: str) -> str:
    """Return a code one crossing larger than any that is read; `visit` spells a kink's two."""
    return ",".join(visit.format(k) for k in range(1, 1002))


@pytest.mark.parametrize("visit", ["{0}+,{0}-", "{0} -{0}", "O{0},U{0}", "O{0}+,U{0}+"])
def test_the_largest_code_is_read_and_none_larger(visit: str) -> None:
    text = kinks(visit)
    with pytest.raises(InvalidInput, match="too large|too long"):
        parse_code(text)
    assert parse_code(text.removesuffix(f",{visit.format(1001)}")).nx == 1000


@given(st.text("[](),+-acDTPX 0123456789", max_size=60))
def test_any_text_is_a_code_or_refused(text: str) -> None:
    try:
        parse_code(text)
    except InvalidInput:
        pass


def test_states_that_ship_have_the_codes_of_their_gauss_code() -> None:
    states = read_states(shipped("hard-unknots"), images=False)
    for row, text in enumerate(states.gauss_code_chiral.tolist()):
        code = GaussCode.parse(text)
        assert (states.pd_code[row], states.dt_code[row]) == (pd_text(code), dt_text(code))


def rope_codes(count: int) -> list[GaussCode]:
    """Codes of ropes that random actions tangled."""
    ropes, rng = simulation(MUJOCO, 50, threads=0), np.random.default_rng(40)
    found: list[GaussCode] = []
    while len(found) < count:
        ropes.act(rng.uniform(-1, 1, (50, 6)).astype(np.float32))
        found += [code for code in label_many(ropes.points) if code.nx]
    return found[:count]


def require_same_abroad(code: GaussCode, knot: str) -> None:
    """Check that spherogram reads both codes as this diagram and knot, and writes them back."""
    import spherogram

    link = spherogram.Link(pd_code(code))
    written = _from_pd(link.PD_code(min_strand_index=1)) if code.nx else GaussCode()
    # spherogram picks the base point of a diagram of one crossing itself
    assert written in ([code, code.rebased(1)] if code.nx == 1 else [code])
    assert link.writhe() == code.writhe and len(link) == code.nx
    if code.nx > 1:
        assert _from_dt([*link.DT_code()[0]]) == code.plain
        # its own reader of DT codes fails at nugatory crossings, and may never return
        if without_nugatory(code):
            again = spherogram.Link(f"DT: [{tuple(_dt_code(code))}]")
            read = _from_dt([*again.DT_code()[0]])  # at another base point, or switched
            assert canonical(read, Symmetry.DIAGRAM) == canonical(code, Symmetry.DIAGRAM)
    link.simplify("basic")
    if link.crossings:
        link.simplify("global")
    if knot == "0_1":
        assert not link.crossings
    else:
        own = spherogram.Link(pd_code(diagram_of(knot))).knot_floer_homology()["ranks"]
        assert link.knot_floer_homology()["ranks"] in (own, mirrored(own))


def without_nugatory(code: GaussCode) -> bool:
    return 1 not in Counter(_parts(code)).values()


def mirrored(ranks: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    return {(-alexander, -maslov): rank for (alexander, maslov), rank in ranks.items()}


@pytest.mark.clients
def test_spherogram_reads_and_writes_every_code_of_up_to_four_crossings() -> None:
    pytest.importorskip("spherogram")
    for code, knot in listed_codes().items():
        require_same_abroad(code, knot)


@pytest.mark.clients
def test_spherogram_reads_and_writes_the_codes_of_random_ropes() -> None:
    pytest.importorskip("spherogram")
    for code in rope_codes(1000):
        assert _is_unknot(code)
        require_same_abroad(code, "0_1")


@pytest.mark.clients
def test_the_249_knots_are_those_of_knotinfo() -> None:
    rows = pytest.importorskip("database_knotinfo").link_list()[2:]
    info = {row["name"]: row for row in rows}
    assert len(_prime_diagrams()) == 249
    for name, code in _prime_diagrams().items():
        pd = json.loads(info[name]["pd_notation"])
        assert sorted(pd_code(code)) == sorted(pd) and _from_pd(pd) == code
        table_dt = parse_code(info[name]["dt_notation"])
        assert dt_text(table_dt) == info[name]["dt_notation"]
        assert knot_type(table_dt) in (name, "unknown")
        gauss = parse_code(f"KnotInfo:{info[name]['gauss_notation']}")
        assert canonical(gauss, Symmetry.DIAGRAM) == canonical(code, Symmetry.DIAGRAM)
        require_same_abroad(code, name)


@pytest.mark.clients
def test_snappy_sees_one_manifold_in_our_codes_and_in_knotinfos_name() -> None:
    snappy = pytest.importorskip("snappy")
    for name in ("4_1", "5_2", "8_20", "9_49", "10_161", "10_165"):
        code = diagram_of(name)
        ours = snappy.Link(pd_code(code)).exterior()
        dt = snappy.Manifold(f"DT:[{tuple(_dt_code(code))}]")
        assert ours.is_isometric_to(dt)
        # Rolfsen lists one knot twice, as 10_161 and 10_162
        rolfsen = name.replace("10_165", "10_166")
        assert ours.is_isometric_to(snappy.Manifold(rolfsen))


def test_gauss_codes_may_be_signed_numbers() -> None:
    trefoil = GaussCode.parse("1-,2+,3-,1+,2-,3+")
    for text in ("-1 2 -3 1 -2 3", "[-7,2,-3,7,-2,3]"):
        assert parse_code(text) == trefoil
    assert parse_code("4 6 2") == _from_dt([4, 6, 2])  # one sign for each number: a DT code
    with pytest.raises(InvalidInput, match="no planar diagram has it"):
        parse_code("1 -2 -1 2")


def hard_unknots() -> dict[str, GaussCode]:
    path = files("knotgym.topology") / "data/hard-unknots.txt"
    lines = [line.partition("#") for line in path.read_text("utf-8").splitlines()]
    return {name.strip(): parse_code(text) for text, _, name in lines if text}


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


@pytest.mark.parametrize(
    "text",
    [
        "O1-U2-O3-U1-O2-U3-",
        "o1- u2- o3- u1- o2- u3-",
        "-1 2 -3 1 -2 3 ---",
        "PD[\nX[0,3,1,4],\nX[4,1,5,2],\nX[2,5,3,0]\n];",
        "X[1,5,2,4]\nX[5,3,6,2]\nX[3,1,4,6]\n",
    ],
)
def test_other_programs_write_the_left_handed_trefoil(text: str) -> None:
    assert knot_type(parse_code(text)) == "3_1" and parse_code(text).chirality is not None


def test_a_notation_is_a_row_of_the_table_of_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    row = re.compile(r"Kinks:\d+"), lambda tight, _: GaussCode.parse(kinks_of(int(tight[6:])))
    monkeypatch.setattr(notation, "_READERS", (row, *notation._READERS))
    (code,) = parse_codes(["Kinks:3 # curls"])
    assert str(code) == kinks_of(3) and parse_code("[4,6,2]") == _from_dt([4, 6, 2])
    with pytest.raises(InvalidInput, match="cannot read the visit"):
        parse_code("Kinks:x")


def kinks_of(count: int) -> str:
    return ",".join(f"{k}+,{k}-" for k in range(1, count + 1))


def test_a_list_has_a_code_a_line() -> None:
    lines = ["# five", "O1U1", "4 6 8 2", "4 6 8 2 # twice the figure-eight knot", "[[1,1,2,2]]"]
    lines += ["PD[", "X[1,5,2,4],", "", "X[5,3,6,2],X[3,1,4,6]", "];"]
    codes = [*parse_codes(lines)]
    assert [code.nx for code in codes] == [1, 4, 4, 1, 3] and codes[4] == TREFOIL
    with pytest.raises(InvalidInput, match="line 4: "):
        [*parse_codes([*lines[:3], "[[1,2", "]]"])]


@pytest.mark.parametrize(
    ("gauss", "pd"),
    [
        ("-1, 3, -2, 1, -3, 2", "X1425 X3641 X5263"),
        ("1, -4, 3, -1, 2, -3, 4, -2", "X4251 X8615 X6374 X2738"),
    ],
)
def test_the_knot_atlas_says_one_knot_in_both_notations(gauss: str, pd: str) -> None:
    assert parse_code(f"GaussCode[{gauss}]") == parse_code(pd).plain


@pytest.mark.clients
def test_spherogram_writes_alphabetical_dt_codes_as_they_are_read() -> None:
    spherogram = pytest.importorskip("spherogram")
    for name in ("3_1", "4_1", "8_20", "9_49", "10_161"):
        link = spherogram.Link(name)
        numbers, letters = link.DT_code()[0], link.DT_code(DT_alpha=True)
        assert parse_code(letters) == _from_dt(numbers)
        assert knot_type(parse_code(letters)) == name


def test_signs_between_visits_may_part_them_or_be_the_crossings() -> None:
    parted, signed = parse_code("O1-U2-O3-U1-O2-U3"), parse_code("O1+U2+O3+U1+O2+U3+")
    assert parted == signed.plain and signed.signs == (1, 1, 1)


def test_knotinfo_is_read_by_its_name_because_its_plus_is_under() -> None:
    assert parse_code("KnotInfo:{-1,2,-3,1,-2,3}") == parse_code("1 -2 3 -1 2 -3")
    with pytest.raises(InvalidInput, match="KnotInfo:"):
        parse_code("{-1,2,-3,1,-2,3}")
