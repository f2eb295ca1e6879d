"""Items of a dataset: one row by its number, several by a slice, a list, an array or a tensor."""

import reprlib
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from knotgym.common import Ids

Index: TypeAlias = slice | ArrayLike


def rows_at(index: Index, count: int, *, several: bool = False) -> Ids:
    """Return the rows that an index means, int64 (n,), or () for one row.

    Args:
        index: a whole number, of Python, NumPy or torch; or several as a slice, a list, an array or
            a tensor. Negative ones count from the end.
        count: rows of the dataset.
        several: whether one row alone is refused.

    Raises:
        IndexError: it is something else, such as a mask, or out of range.
    """
    if isinstance(index, slice):
        return np.arange(count)[index]
    wanted: Any = np.asarray(index)
    wanted = wanted.astype(np.int64) if wanted.shape == (0,) else wanted
    if wanted.dtype.kind not in "iu" or wanted.ndim > 1 or (several and not wanted.ndim):
        wrong = wanted  # a mask would be taken for the rows 0 and 1
    else:
        wrong = wanted[(wanted < -count) | (wanted >= count)]
        if not wrong.size:
            return wanted.astype(np.int64) % max(1, count)
    given = reprlib.repr(wrong.tolist())
    kind = "a list of whole numbers" if several else "whole numbers"
    raise IndexError(f"rows must be {kind} below {count}, got {given}")
