"""Lanes reckon as NumPy does, each for itself."""

from types import SimpleNamespace

import pytest

from knotgym.rope.chain.simd import NUMBA

from ...scripts import ROOT


def test_numba_is_bounded_as_in_the_package() -> None:
    (low, high), text = NUMBA, (ROOT / "pyproject.toml").read_text("utf-8")
    assert f'"numba>={low[0]}.{low[1]},<{high[0]}.{high[1]}"' in text


@pytest.mark.parametrize("version", [(0, 60), (0, 69), (1, 0)])
def test_another_numba_is_told(monkeypatch: pytest.MonkeyPatch, version: tuple[int, int]) -> None:
    monkeypatch.setattr("numba.version_info", SimpleNamespace(short=version))
    source = (ROOT / "knotgym" / "rope" / "chain" / "simd.py").read_text("utf-8")
    with pytest.raises(ImportError, match=r"from 0\.61 to before 0\.69, installed is"):
        exec(compile(source.partition("# Four float64 fill")[0], "simd", "exec"), {})
