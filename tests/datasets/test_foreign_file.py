"""A file that the HDF5 library doesn't live through is one line; all others are let pass."""

import os
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from knotgym.common import InvalidFile
from knotgym.datasets.located import try_files
from knotgym.runs import executor


def test_a_sound_file_and_one_that_is_no_hdf5_pass(states_path: str, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("text")
    os.mkfifo(tmp_path / "pipe.h5")
    paths = [Path(states_path), *(tmp_path / name for name in ("a.h5", "pipe.h5", "none"))]
    with executor(1) as pool:
        try_files(paths, pool)


@pytest.mark.parametrize(("ends", "said"), [(BrokenProcessPool, "crash"), (TimeoutError, "hang")])
def test_a_crash_and_a_hang_are_one_line(
    states_path: str, monkeypatch: pytest.MonkeyPatch, ends: type[Exception], said: str
) -> None:
    future: Future[None] = Future()
    future.set_exception(ends())
    message = rf"{Path(states_path).name} makes the HDF5 library {said}"
    with executor(1) as pool, pytest.raises(InvalidFile, match=message):
        monkeypatch.setattr(pool, "submit", lambda *_: future)
        try_files([Path(states_path)], pool)
