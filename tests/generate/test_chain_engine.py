"""Everything that a run writes with engine="chain" says so, is the same bytes however it was made,
and is replayed and verified with that engine alone.
"""

import os
import subprocess
import sys
from pathlib import Path

import h5py
import pytest


@pytest.mark.slow  # compiles for a minute
def test_fresh_and_cached_compilations_and_one_for_avx2_collect_the_same(tmp_path: Path) -> None:
    narrow = {
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": "+sse4.2,+popcnt,+avx,+avx2,+bmi,+bmi2,+fma",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    }
    words = "collect --task tie --policy random --episodes 2 --set task.horizon=5".split()
    found = []
    for name, processor in (("cold", {}), ("warm", {}), ("narrow", narrow)):
        subprocess.run(
            [sys.executable, "-m", "knotgym", *words, "--engine", "chain", "--workers", "1"]
            + ["--quiet", "--out", str(tmp_path / name), "--id", "a/b-v0"],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), **processor},
            check=True,
        )
        with h5py.File(tmp_path / name / "a/b-v0/data/episodes.h5") as file:  # it names the machine
            tables = file["episodes"], file["steps"]
            found.append([{name: table[name][()].tobytes() for name in table} for table in tables])
    assert found[0] == found[1] == found[2]
    assert any((tmp_path / "cache").rglob("solver.advance*.nbc"))
