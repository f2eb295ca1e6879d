"""HDF5 files are opened checked, and what is wrong with one is the reader's error, one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from knotgym.errors import KnotgymError, MissingFile
from knotgym.hdf5_files import hdf5_format, opened_hdf5


class Refused(KnotgymError, ValueError):
    """Of these tests."""


def read(path: Path, use: Callable[[h5py.File], Any] = dict) -> Any:
    with opened_hdf5(path, what="list", format="ours", versions=(2, 3), error=Refused) as file:
        return use(file)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    with h5py.File(tmp_path / "list.h5", "w") as file:
        file.attrs["format"], file.attrs["format_version"] = "ours", 3
        file["numbers"] = np.arange(5)
    return tmp_path / "list.h5"


def test_a_file_of_ours_is_read(path: Path) -> None:
    assert read(path, lambda file: file["numbers"][()].tolist()) == [0, 1, 2, 3, 4]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"no list at .*absent\.h5") as caught:
        read(tmp_path / "absent.h5")
    assert isinstance(caught.value, FileNotFoundError)


def test_another_format_is_named_with_what_can_be_read(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["format"] = "theirs"
    with pytest.raises(Refused, match="format 'theirs' version 3; .* 'ours' version 2 or 3"):
        read(path)


@pytest.mark.parametrize("version", [1, 4, "three"])
def test_another_version_is_refused(path: Path, version: object) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["format_version"] = version
    with pytest.raises(Refused, match=f"version {version}"):
        read(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_a_torn_file_is_refused_in_one_line(path: Path, share: float) -> None:
    raw = path.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(Refused, match="isn't a whole list") as caught:
        read(path, lambda file: file["numbers"][()])
    assert "\n" not in str(caught.value)


def test_what_is_missing_inside_is_named(path: Path) -> None:
    with pytest.raises(Refused, match="isn't a whole list: .*letters"):
        read(path, lambda file: file["letters"])


def test_the_readers_own_refusal_is_left_as_it_is(path: Path) -> None:
    def refuse(file: h5py.File) -> None:
        raise Refused("too many numbers")

    with pytest.raises(Refused, match="^too many numbers$"):
        read(path, refuse)


def test_the_format_of_a_file_is_what_it_says(path: Path, tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("not HDF5")
    h5py.File(tmp_path / "plain.h5", "w").close()
    assert hdf5_format(path) == "ours"
    assert hdf5_format(tmp_path / "text.h5") is hdf5_format(tmp_path / "plain.h5") is None
