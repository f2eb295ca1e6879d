"""Pictures with labels as arrays."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from knotgym.common import InvalidFile, InvalidInput, MissingExtra
from knotgym.loaders.items import Index, rows_at
from knotgym.quality import GRADES
from knotgym.topology import GaussCode

_CROSSING_FIELDS = ("x", "y", "over_place", "under_place")


class Pictures:
    """Pictures with labels as arrays, zero-padded to max_nx crossings.

    Attributes:
        codes: str (n,), the Gauss codes.
        splits: str (n,).
        labels: name -> (n, ...), as `pytorch.PictureDataset` lists them.
    """

    COLUMNS = ("image", "gauss_code_chiral", "nx", "crossings", "grade", "accepted", "split")

    def __init__(self, table: Any, max_nx: int) -> None:
        """Read a pyarrow.Table with COLUMNS.

        Raises:
            InvalidFile: a row has more than max_nx crossings.
        """
        nx = np.array(table["nx"].to_pylist(), dtype=np.int64)
        if nx.max(initial=0) > max_nx:
            raise InvalidFile(
                f"max_nx must be at least {nx.max()}, the crossings of a picture here, got {max_nx}"
            )
        image = table["image"].combine_chunks()
        arrow = MissingExtra.imported("pyarrow.compute", "huggingface", "Parquet")
        self._png = arrow.struct_field(image, "bytes")
        codes = [GaussCode.parse(text) for text in table["gauss_code_chiral"].to_pylist()]
        self.codes, self.splits = [str(code) for code in codes], table["split"].to_pylist()
        visits = np.zeros((len(nx), 2 * max_nx), dtype=np.int64)
        signs = np.zeros((len(nx), max_nx), dtype=np.int64)
        for row, code in enumerate(codes):
            visits[row, : 2 * code.nx], signs[row, : code.nx] = code.visits, code.signs
        self.labels: dict[str, Any] = {
            "nx": nx,
            "visits": visits,
            "signs": signs,
            "crossings": _crossings(table["crossings"].to_pylist(), max_nx),
            "grade": np.array([*map(GRADES.index, table["grade"].to_pylist())], dtype=np.int64),
            "accepted": np.array(table["accepted"].to_pylist(), dtype=np.bool_),
        }

    def __len__(self) -> int:
        return len(self.codes)

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Decode the picture of a row: uint8 (3, size, size), RGB."""
        data = np.frombuffer(self._png[row].as_buffer(), dtype=np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
        return np.ascontiguousarray(np.moveaxis(np.asarray(image, dtype=np.uint8), -1, 0))

    def batch(self, rows: Index, **_: Any) -> dict[str, Any]:
        """Return rows as a dict of arrays, `image` uint8 (n, 3, size, size) among them.

        Raises:
            IndexError: a row is out of range, or no whole number.
            InvalidInput: the pictures have several sizes, or there are none.
        """
        rows = rows_at(rows, len(self), several=True)
        images = [self.picture(int(row)) for row in rows]
        if len(sizes := {image.shape for image in images}) != 1:
            raise InvalidInput(f"pictures of {len(sizes)} sizes make no batch; ask for one size")
        return {"image": np.stack(images), **{k: values[rows] for k, values in self.labels.items()}}


def _crossings(rows: list[list[dict[str, float]]], most: int) -> NDArray[np.float32]:
    padded = np.zeros((len(rows), most, 4), dtype=np.float32)
    for row, crossings in enumerate(rows):
        for number, crossing in enumerate(crossings):
            padded[row, number] = [crossing[name] for name in _CROSSING_FIELDS]
    return padded
