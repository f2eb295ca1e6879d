"""HDF5 files are checked when read; faults are one-line errors of the reader's class."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from knotgym.common.errors import KnotgymError, MissingFile
from knotgym.common.hdf5_files import Column, hdf5_format, opened_hdf5, read_attribute, read_column


class Refused(KnotgymError, ValueError):
    """The reader's error in these tests."""


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


NUMBERS = Column("numbers", "int64", ("rows",), least=0)


def harmed(path: Path, harm: Callable[[h5py.File], Any]) -> Path:
    with h5py.File(path, "a") as file:
        del file["numbers"]
        harm(file)
    return path


def numbers_of(file: h5py.File) -> Any:
    return read_column(file, NUMBERS, {"rows": 5})


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.zeros(5), "float64"),
        (np.zeros(5, dtype=complex), "complex128"),
        (np.zeros(5, dtype=bool), "bool"),
        (np.zeros(5, dtype="i4,f8"), "a compound"),
        (np.zeros(5, dtype="V3"), "opaque"),
        (np.array([b"a"] * 5), "text"),
        (["a"] * 5, "text"),
    ],
)
def test_another_type_is_named_with_the_one_wanted(path: Path, values: Any, found: str) -> None:
    harmed(path, lambda file: file.create_dataset("numbers", data=values))
    with pytest.raises(Refused, match=rf"whole list: numbers is {found}\S*, should be int64"):
        read(path, numbers_of)


@pytest.mark.parametrize(
    ("dtype", "found"),
    [
        (h5py.ref_dtype, "references"),
        (h5py.enum_dtype({"a": 0}), "an enumeration"),
        (h5py.vlen_dtype(np.int64), "arrays of any length"),
        (np.dtype((np.int64, (2,))), "arrays"),
    ],
)
def test_a_type_that_only_hdf5_has_is_refused(path: Path, dtype: Any, found: str) -> None:
    harmed(path, lambda file: file.create_dataset("numbers", (5,), dtype=dtype))
    with pytest.raises(Refused, match=f"numbers is {found}, should be int64"):
        read(path, numbers_of)


def test_a_narrower_type_of_the_class_is_widened(path: Path) -> None:
    harmed(path, lambda file: file.create_dataset("numbers", data=np.arange(5, dtype=">i2")))
    read_back = read(path, numbers_of)
    assert read_back.dtype == np.int64 and read_back.tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (np.arange(4), r"of shape \(4,\), should be \(5\)"),
        (np.arange(5) - 2, "is -2, should be at least 0"),
        (np.int64(3), r"of shape \(\), should be \(5\)"),
    ],
)
def test_another_size_or_range_is_named(path: Path, values: Any, said: str) -> None:
    harmed(path, lambda file: file.create_dataset("numbers", data=values))
    with pytest.raises(Refused, match=said):
        read(path, numbers_of)


def elsewhere(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((5,), "i8")
    layout[:] = h5py.VirtualSource("other.h5", "numbers", (5,))
    file.create_virtual_dataset("numbers", layout)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda file: file.update({"numbers": h5py.ExternalLink("o.h5", "/n")}), "is a link"),
        (lambda file: file.update({"numbers": h5py.SoftLink("/attic")}), "is a link"),
        (
            lambda file: file.create_dataset("numbers", (5,), "i8", external=[("raw", 0, 40)]),
            "is in other files",
        ),
        (elsewhere, "is in other files"),
        (lambda file: file.create_group("numbers"), "is a group"),
        (
            lambda file: file.create_dataset("numbers", (5,), "i8", compression="lzf"),
            "is compressed, but not with gzip",
        ),
    ],
)
def test_nothing_outside_the_file_is_reached(path: Path, harm: Any, said: str) -> None:
    harmed(path, harm)
    with pytest.raises(Refused, match=f"numbers {said}"):
        read(path, numbers_of)


def test_far_more_rows_than_are_stored_are_not_made(path: Path) -> None:
    harmed(path, lambda file: file.create_dataset("numbers", (10**10,), "i8", chunks=(1000,)))
    with pytest.raises(Refused, match="declares .* 80000000000 bytes, and stores 0"):
        read(path, lambda file: read_column(file, NUMBERS, {}))


def test_a_pipe_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(Refused, match="isn't a regular file"):
        read(tmp_path / "pipe.h5")
    assert hdf5_format(tmp_path / "pipe.h5") is None


@pytest.mark.parametrize("version", [3.0, True])
def test_a_version_is_a_whole_number(path: Path, version: object) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["format_version"] = version
    with pytest.raises(Refused, match=rf"version {version} \((float64|bool)\)"):
        read(path)


def test_text_that_a_terminal_would_obey_is_refused(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["name"], file["names"] = "\x1b[2J", ["a", "\x07"]
    with pytest.raises(Refused, match="name holds control characters"):
        read(path, lambda file: read_attribute(file, Column("name", "text", ())))
    with pytest.raises(Refused, match="names holds control characters"):
        read(path, lambda file: read_column(file, Column("names", "text", ("rows",)), {}))


@pytest.mark.parametrize("value", [1.5, ["a", "b"], h5py.Empty("f8")])
def test_an_attribute_of_another_type_is_refused(path: Path, value: object) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["name"] = value
    with pytest.raises(Refused, match="name is"):
        read(path, lambda file: read_attribute(file, Column("name", "text", ())))
