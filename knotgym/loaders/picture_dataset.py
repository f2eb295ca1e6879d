"""A torch dataset over a perception table. Importing this module needs torch."""

import os
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from knotgym.common import InvalidFile
from knotgym.datasets import GRADES, arrow, read_table
from knotgym.topology import GaussCode

_COLUMNS = ("image", "gauss_code_chiral", "nx", "crossings", "grade", "accepted", "split")
_CROSSING_FIELDS = ("x", "y", "over_place", "under_place")


class PictureDataset(Dataset[dict[str, Any]]):
    """Pictures with labels, zero-padded to max_nx crossings. An item is a dict of tensors:

        image       uint8 (3, size, size), RGB
        nx          int64 ()
        visits      int64 (2 max_nx,): +k at the over strand of crossing k, -k at its under strand,
                    in the order of the walk
        signs       int64 (max_nx,): +1 for "c", -1 for "a", by crossing number
        crossings   float32 (max_nx, 4): x and y in pixels, positions of the over and the under
                    strand along the rope in beads
        grade       int64 (): index in `knotgym.datasets.image_table.GRADES`
        accepted    bool ()

    The PNGs are kept in memory (about 3 kB for a picture of 128 x 128) and shared by forked
    workers; they are decoded on demand. Pictures of one size batch with the default collate
    function; for several sizes, pass your own batch sampler or collate function.

    Attributes:
        max_nx: number of crossings that labels are padded to.
        codes: str (n,), the Gauss codes.
        splits: str (n,).
        labels: name -> tensor (n, ...); all of the above except the images.
    """

    def __init__(
        self, path: str | os.PathLike[str], split: str | None = None, max_nx: int | None = None
    ) -> None:
        """Read a table; see `knotgym.loaders.images`."""
        table = read_table(path, split, columns=_COLUMNS)
        nx = np.array(table["nx"].to_pylist(), dtype=np.int64)
        whole = table if split is None else read_table(path, columns=["nx"])
        most = max([0, *whole["nx"].to_pylist()]) if max_nx is None else max_nx
        if nx.max(initial=0) > most:
            raise InvalidFile(
                f"max_nx must be at least {nx.max()}, the crossings of a picture here, got {most}"
            )
        self.max_nx = most
        self._png = arrow("pyarrow.compute").struct_field(table["image"].combine_chunks(), "bytes")
        self.codes: list[str] = []
        self.splits: list[str] = table["split"].to_pylist()
        visits = np.zeros((len(nx), 2 * most), dtype=np.int64)
        signs = np.zeros((len(nx), most), dtype=np.int64)
        for row, text in enumerate(table["gauss_code_chiral"].to_pylist()):
            code = GaussCode.parse(text)
            self.codes.append(str(code))
            visits[row, : 2 * code.nx], signs[row, : code.nx] = code.visits, code.signs
        self.labels = {
            "nx": torch.from_numpy(nx),
            "visits": torch.from_numpy(visits),
            "signs": torch.from_numpy(signs),
            "crossings": torch.from_numpy(_crossings(table["crossings"].to_pylist(), most)),
            "grade": torch.tensor(
                [GRADES.index(grade) for grade in table["grade"].to_pylist()], dtype=torch.int64
            ),
            "accepted": torch.tensor(table["accepted"].to_pylist(), dtype=torch.bool),
        }

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"index {index} is outside a dataset of {len(self)}")
        row = index % len(self)
        return {
            "image": torch.from_numpy(self.picture(row)),
            **{name: column[row] for name, column in self.labels.items()},
        }

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Decode the picture of a row: uint8 (3, size, size), RGB."""
        image = cv2.imdecode(
            np.frombuffer(self._png[row].as_buffer(), dtype=np.uint8), cv2.IMREAD_COLOR_RGB
        )
        return np.ascontiguousarray(np.moveaxis(np.asarray(image, dtype=np.uint8), -1, 0))


def _crossings(rows: list[list[dict[str, float]]], most: int) -> NDArray[np.float32]:
    padded = np.zeros((len(rows), most, 4), dtype=np.float32)
    for row, crossings in enumerate(rows):
        for number, crossing in enumerate(crossings):
            padded[row, number] = [crossing[name] for name in _CROSSING_FIELDS]
    return padded
