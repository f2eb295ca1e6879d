"""A file that the HDF5 library doesn't live through is one line; all others are let pass."""

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from knotgym.common.errors import InvalidFile
from knotgym.datasets.foreign_file import try_files


def test_a_sound_file_and_one_that_is_no_hdf5_pass(states_path: str, tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_text("text")
    os.mkfifo(tmp_path / "pipe.h5")
    try_files([Path(states_path), *(tmp_path / name for name in ("a.h5", "pipe.h5", "none"))])


@pytest.mark.parametrize(("ends", "said"), [(-signal.SIGSEGV, "crash"), (None, "hang")])
def test_a_crash_and_a_hang_are_one_line(
    states_path: str, monkeypatch: pytest.MonkeyPatch, ends: int | None, said: str
) -> None:
    def run(words: list[str], **more: Any) -> subprocess.CompletedProcess[bytes]:
        if ends is None:
            raise subprocess.TimeoutExpired(words, more["timeout"])
        return subprocess.CompletedProcess(words, ends, b"begun\n")

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(
        InvalidFile, match=rf"{Path(states_path).name} makes the HDF5 library {said}"
    ):
        try_files([Path(states_path)])
