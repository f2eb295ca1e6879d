"""Curves of others become states with the code that pyknotid reads, or one line says why not."""

import codecs
import io
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from pytest_types import Capture, Patch

from knotgym.common import InvalidInput
from knotgym.drawing import drawn_curve
from knotgym.generate import verify
from knotgym.generate.curve_files import read_curves
from knotgym.generate.imported_curves import _shown_code, import_curves
from knotgym.rope import Rope, RopeConfig
from knotgym.states import read_states, shipped, write_states
from knotgym.topology import knot_type, label, parse_codes, pyknotid_code, with_chirality

from ..conftest import trefoil
from ..small_job import knotgym
from ..topology.test_knots import figure_eight

Points = NDArray[np.float64]


def hopf_link() -> tuple[Points, Points]:
    at = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    flat = np.stack([np.cos(at), np.sin(at), 0.1 * np.sin(2 * at)], axis=1)
    return flat, np.stack([1 + np.cos(at), 0.1 * np.sin(3 * at), np.sin(at)], axis=1)


def table(points: Iterable[Iterable[object]], parted_by: str = ",", end: str = "\n") -> str:
    return "".join(parted_by.join(map(str, row)) + end for row in points)


def numbered(points: Points, first: object = 0) -> list[list[object]]:
    """Rows with a first column: a count from a number, or a name."""
    rows = enumerate(points.tolist(), first if isinstance(first, int) else 0)
    return [[count if isinstance(first, int) else first, *point] for count, point in rows]


def npy(values: object) -> bytes:
    file = io.BytesIO()
    np.save(file, np.asarray(values), allow_pickle=True)
    return file.getvalue()


def closed(points: Points) -> Points:
    return np.concatenate([points, points[:1]])


# how others write one closed curve
ONE: dict[str, Callable[[Points], str | bytes]] = {
    "commas.csv": table,
    "names of columns.csv": lambda p: "x,y,z\n" + table(p),
    "other order.csv": lambda p: "z,y,x\n" + table(p[:, ::-1]),
    "other columns.csv": lambda p: "name,radius,x,y,z,bead\n" + table(
        ["k", 0.5, *point, k] for k, point in enumerate(p)
    ),
    "time and place.txt": lambda p: "t x y z\n" + table(
        [[k / len(p), *point] for k, point in enumerate(p)], " "
    ),
    "time of a box.dat": lambda p: "t = 0\n\n" + table(p, " "),
    "quoted numbers.csv": lambda p: table([[f'"{x}"' for x in row] for row in p]),
    "names after a mark.csv": lambda p: codecs.BOM_UTF8 + b"x,y,z\n" + table(p).encode(),
    "of a spreadsheet.txt": lambda p: table(p, "\t").encode("utf-16"),
    "comments.csv": lambda p: "# a\n#\n" + table(p[:9]) + "# b\n" + table(p[9:], end=" # c\n"),
    "index of pandas.csv": lambda p: ",x,y,z\n" + table(numbered(p)),
    "curve and name.csv": lambda p: "curve,x,y,z\n" + table(numbered(p, "3_1#4_1")),
    "empty rows at the end.csv": lambda p: table(p) + ",,\n,,\n\n",
    "repeated first point.csv": lambda p: table(closed(p)),
    "count from 1.tsv": lambda p: table(numbered(p, 1), "\t"),
    "spaces.txt": lambda p: table(p, " "),
    "fortran.dat": lambda p: "\n".join(
        " ".join(f"{value:.17e}".replace("e", "D") for value in row) for row in p
    ),
    "residues.xyz": lambda p: table(numbered(p, 17), " "),
    "molecule.xyz": lambda p: f"{len(p)}\na knot\n" + table(numbered(p, "C"), " "),
    "atoms.xyz": lambda p: f"{len(p)}\n1 2 3 4 5\n" + table(
        [["CN"[k % 2], *point] for k, point in enumerate(p)], " "
    ),
    "number of rows.txt": lambda p: f"{len(p)}\n" + table(p, " "),
    "count that begins again.csv": lambda p: table([*numbered(p, 1), [1, *p[0].tolist()]]),
    "float64.npy": npy,
    "integers.npy": lambda p: npy((p * 1e6).astype(np.int32)),
}  # fmt: skip
# the same of several curves with names of their own
SEVERAL: dict[str, Callable[[Points, Points], str | bytes]] = {
    "names.csv": lambda p, q: "curve,x,y,z\n" + table(numbered(p, "a") + numbered(q, "b")),
    "empty rows.csv": lambda p, q: table(numbered(p, "a")) + "\n" + table(numbered(q, "b")),
    "numbers.txt": lambda p, q: table(numbered(p, "0") + numbered(q, "1"), " "),
}  # fmt: skip

KNOTS = ("3_1", "4_1", "0_1", "m3_1")
ROPE = Rope()


def knot(number: int) -> Points:
    """A curve that nothing is special of, seen from +z: one of KNOTS."""
    loop = hopf_link()[0] * (1, 1, 4)
    curve = (trefoil(), figure_eight(), loop, trefoil() * (1, 1, -1))[number % 4]
    q, r = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    turned: Points = curve @ (q * np.sign(np.linalg.det(q)))
    return turned


def wrote(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("number", range(len(ONE)), ids=list(ONE))
def test_a_curve_of_others_has_the_code_that_pyknotid_reads(tmp_path: Path, number: int) -> None:
    name, write = list(ONE.items())[number]
    points = knot(number)
    right = pyknotid_code(points)
    (curve,) = read_curves(wrote(tmp_path / name, write(points)))
    code = _shown_code(curve.points, ROPE)
    assert code == right
    assert knot_type(code) == KNOTS[number % 4].removeprefix("m")


P, (A, B) = knot(0), hopf_link()
SHADOW = np.concatenate([P[:, :2], P[:, :1] * 0], axis=1)
REFUSED: list[tuple[str, str | bytes, str]] = [
    ("blank.csv", table(A) + "\n" + table(B), "a link, 2 components"),
    ("name.csv", table(numbered(A, "a") + numbered(B, "b") + numbered(A, "a")), "link, 2 .* of a"),
    ("joined.csv", table(np.concatenate([A, B])), "points 100 and 101 are .* times as far apart"),
    ("shadow.csv", table(SHADOW), "after point 105 it meets itself after point 277"),
    ("spike.csv", table([*P[:9], P[8] + P[8] - P[7], P[8] * 0.5 + P[7] * 0.5, *P[9:]]), "embedded"),
    ("typed.csv", "O.5,0,1\n" + table(P), "line 1: "),
    ("frames.dat", ("t 0\n" + table(A, " ")) * 2, "a link, 2 components"),
    ("flat and counted.csv", table(numbered(P[:, :2])), "its first column counts the rows"),
    ("radius.npy", npy(np.hstack([P, P[:, :1]])), r"\(n, 3\) array of points, got shape"),
    ("open.csv", table(P[:200]), "isn't closed"),
    ("walk.npy", npy(np.random.default_rng(0).normal(size=(5_000, 3))), "more than 100 crossings"),
    ("fine.npy", npy(np.random.default_rng(0).normal(size=(20_001, 3))), "at most 20000 points"),
    ("pickled.npy", npy(np.array([{}], dtype=object)), "can't be read"),
    ("many.npy", npy(np.zeros((1_000_001, 3), np.int8)), "more than 1000000 points"),
    ("curves.csv", table([f"n{k}", 0, 0, 0] for k in range(20_001)), "20001 curves, more than"),
    ("knot.stl", "solid", "curves are read from .csv"),
]


@pytest.mark.parametrize(("name", "content", "problem"), REFUSED, ids=[one[0] for one in REFUSED])
def test_what_is_no_closed_curve_is_refused_in_one_line(
    tmp_path: Path, name: str, content: str | bytes, problem: str
) -> None:
    path = wrote(tmp_path / name, content)
    with pytest.raises(InvalidInput, match=problem) as caught:
        import_curves([path])
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600
    assert name in str(caught.value)


def test_sizes_are_limited_before_anything_is_parsed(tmp_path: Path, monkeypatch: Patch) -> None:
    for name in ("a.csv", "a.npy"):
        with open(tmp_path / name, "wb") as file:
            file.truncate(64_000_001)
        with pytest.raises(InvalidInput, match="more than 64 MB"):
            read_curves(tmp_path / name)
    monkeypatch.setattr("knotgym.generate.curve_files._MOST", 9)
    with pytest.raises(InvalidInput, match="more than 9 lines"):
        read_curves(wrote(tmp_path / "a.csv", "\n" * 10))


@given(st.sampled_from(sorted(ONE)), st.lists(st.tuples(st.integers(0), st.binary(max_size=3))))
def test_any_file_is_curves_or_refused(
    tmp_path_factory: pytest.TempPathFactory, name: str, edits: list[tuple[int, bytes]]
) -> None:
    content = ONE[name](knot(0)[::10])
    content = content.encode() if isinstance(content, str) else content
    for place, put in edits:
        at = place % len(content)
        content = content[:at] + put + content[at + 1 :]
    try:
        read_curves(wrote(tmp_path_factory.getbasetemp() / name, content))
    except InvalidInput as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize("name", SEVERAL)
def test_curves_with_names_of_their_own_stay_apart(tmp_path: Path, name: str) -> None:
    path = wrote(tmp_path / name, SEVERAL[name](knot(0), knot(1)))
    codes = [_shown_code(curve.points, ROPE) for curve in read_curves(path)]
    assert [knot_type(code) for code in codes] == ["3_1", "4_1"]


def test_every_shipped_state_comes_back_from_a_table(tmp_path: Path) -> None:
    states = read_states(shipped(), images=False)
    named = {f"s{k}": points for k, points in enumerate(states.points)}
    rows = "".join(table(numbered(points, name)) for name, points in named.items())
    path = wrote(tmp_path / "states.csv", rows)
    for row, curve in enumerate(read_curves(path)):
        assert np.array_equal(curve.points[:100], states.points[row])
        assert _shown_code(curve.points, ROPE).chiral == states.gauss_code_chiral[row]


def test_a_knotted_curve_is_laid_with_its_code_and_knot(tmp_path: Path) -> None:
    path = wrote(tmp_path / "curve.csv", table(40 * trefoil() + 7))
    states, refused = import_curves([path])
    assert states.knot.tolist() == ["3_1"] and not refused
    assert states.gauss_code_chiral[0] == label(trefoil()).chiral
    write_states(tmp_path / "states.h5", states)
    assert verify(tmp_path / "states.h5") == []


def test_refused_curves_are_named_and_the_others_imported(tmp_path: Path, capfd: Capture) -> None:
    text = table(numbered(trefoil(), "good") + numbered(SHADOW, "shadow"))
    mixed = wrote(tmp_path / "mixed.csv", text)
    link = wrote(tmp_path / "link.csv", table(A) + "\n" + table(B))
    out = tmp_path / "states.h5"
    assert knotgym("dataset", "import", mixed, link, "--out", out, "--quiet") == 1
    said = capfd.readouterr()
    assert "link.csv holds a link" in said.out and "mixed.csv:shadow: " in said.out
    assert len(said.out.splitlines()) == 2 and said.err.startswith("knotgym: 2 files or curves")
    assert read_states(out).knot.tolist() == ["3_1"]


def test_without_any_curve_nothing_is_written(tmp_path: Path) -> None:
    link = wrote(tmp_path / "link.csv", table(A) + "\n" + table(B))
    assert knotgym("dataset", "import", link, "--out", tmp_path / "x.h5") == 2
    assert knotgym("dataset", "import", tmp_path / "no.csv", "--out", tmp_path / "x.h5") == 2
    assert not (tmp_path / "x.h5").exists()


def test_knots_that_share_polynomials_are_refused(tmp_path: Path) -> None:
    code = with_chirality(
        *parse_codes(["[4, 12, 14, 16, 18, 20, 2, 10, 8, 6]"])
    )  # KnotInfo's 10_25, not as in its PD
    points = drawn_curve(code, np.random.default_rng(0), Rope(RopeConfig.of(200)))
    with pytest.raises(InvalidInput, match="of 10 crossings, can't be certified"):
        import_curves([wrote(tmp_path / "ten.csv", table(points))])


def test_a_curve_that_cannot_be_laid_says_which_limit_it_misses(tmp_path: Path) -> None:
    at = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    radius = 2 + 0.5 * np.cos(23 * at)
    coil = [radius * np.cos(2 * at), radius * np.sin(2 * at), 0.5 * np.sin(23 * at)]
    with pytest.raises(InvalidInput, match=r"coil\.csv: "):
        import_curves([wrote(tmp_path / "coil.csv", table(np.stack(coil, axis=1)))])
