"""Curves from files become states, or one line says why not; curves of states come back."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.common.errors import InvalidInput
from knotgym.control.verification import verify
from knotgym.datasets.exports.curves_export import write_curves
from knotgym.generate.states.imported_curves import import_curves, read_curves
from knotgym.states.state_file import read_states, shipped, write_states
from knotgym.topology.crossings import label

from ..conftest import trefoil
from ..small_job import knotgym


def figure_eight() -> NDArray[np.float64]:
    at = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    radius = 2 + np.cos(2 * at)
    return np.stack([radius * np.cos(3 * at), radius * np.sin(3 * at), np.sin(4 * at)], axis=1)


@pytest.mark.parametrize("suffix", ["csv", "obj", "npz"])
def test_several_curves_come_back_exactly(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"two.{suffix}"
    write_curves(path, np.stack([trefoil(), figure_eight()]))
    for curve, right in zip(read_curves(path), (trefoil(), figure_eight()), strict=True):
        assert np.array_equal(curve.points[:300], right)


def test_a_knotted_curve_is_laid_with_its_code_and_knot(tmp_path: Path) -> None:
    path = tmp_path / "curve.csv"
    np.savetxt(path, 40 * trefoil() + 7, delimiter=",")
    states = import_curves([path])
    assert states.knot.tolist() == ["3_1"]
    assert states.gauss_code_chiral[0] == label(trefoil()).chiral
    write_states(tmp_path / "states.h5", states)
    assert verify(tmp_path / "states.h5") == []


def test_exported_states_are_imported_again(tmp_path: Path) -> None:
    given = ("dataset", "export", shipped("hard-unknots"), "--to", "curves")
    assert knotgym(*given, "--out", tmp_path / "hard.obj", "--quiet") == 0
    states = read_states(shipped("hard-unknots"), images=False)
    curves = read_curves(tmp_path / "hard.obj")
    assert len(curves) == len(states)
    write_curves(tmp_path / "one.npz", curves[0].points[None])
    again = import_curves([tmp_path / "one.npz"], split="test")
    assert again.gauss_code_chiral[0] == states.gauss_code_chiral[0]
    assert again.split[0] == "test"


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.txt", "1,2,3", "curves are read from"),
        ("a.csv", "", "holds no curves"),
        ("a.csv", "1,2\n3,4", "has 2 values, should be 3 or 4"),
        ("a.csv", "x,y,z\n1,2,x", "holds no curves"),
        ("a.csv", "0,0,0\n1,0,0\n1,1,0", "at least 4 different points"),
        ("a.csv", "nan,0,0\n1,0,0\n1,1,0\n0,1,0", "finite"),
        ("a.obj", "v 0 0 0\nl 1 9", "holds no curves"),
        ("a.npz", "x", "holds no curves"),
    ],
)
def test_what_is_no_curve_is_refused_in_one_line(
    tmp_path: Path, name: str, text: str, problem: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InvalidInput, match=problem) as caught:
        import_curves([tmp_path / name])
    assert "\n" not in str(caught.value)
    assert knotgym("dataset", "import", tmp_path / name, "--out", tmp_path / "x.h5") == 2
    assert not (tmp_path / "x.h5").exists()


def test_a_curve_that_cannot_be_laid_says_which_limit_it_misses(tmp_path: Path) -> None:
    at = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    radius = 2 + 0.5 * np.cos(23 * at)
    coil = [radius * np.cos(2 * at), radius * np.sin(2 * at), 0.5 * np.sin(23 * at)]
    np.savetxt(tmp_path / "coil.csv", np.stack(coil, axis=1), delimiter=",")
    with pytest.raises(InvalidInput, match=r"coil\.csv: "):
        import_curves([tmp_path / "coil.csv"])
