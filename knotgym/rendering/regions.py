"""Regions of a picture that a rope leaves, counted in compiled code.

After a change run `pytest tests/quality tests/photos`.
"""

import numpy as np

from knotgym.common import Array, Ids, inner


@inner
def count_regions(canvas: Array, columns: int) -> tuple[int, float]:
    """Count the regions of 0, connected by sides and corners; return the least area, pixels, too.

    Args:
        canvas: uint8 (rows, a multiple of 8), contiguous.
        columns: how many of its columns count.
    """
    rows, eights = len(canvas), canvas.view(np.uint64)
    most = columns // 2 + 1  # runs of a row
    runs = np.empty((2, most, 3), np.int64)  # begin, end and number: of the last row and of this
    # a run's region: that of its leader, whose own is itself
    leaders, dots, count, above = np.empty(rows * most, np.int64), np.empty(rows * most), 0, 0
    for row in range(rows):
        before, here, found, column, reached = runs[row % 2], runs[1 - row % 2], 0, 0, 0
        while column < columns:
            if canvas[row, column]:
                column += 1
                continue
            begin = column
            while column < columns and not canvas[row, column]:
                # most of a picture is no rope: eight pixels are looked at as one number
                clear = column & 7 == 0 and column + 8 <= columns and eights[row, column >> 3] == 0
                column += 8 if clear else 1
            run = here[found]
            run[0], run[1], run[2] = begin, column, count
            leaders[count], dots[count] = count, column - begin
            while reached < above and before[reached, 1] < begin:
                reached += 1
            k = reached
            while k < above and before[k, 0] <= column:
                one, other = _leader(leaders, before[k, 2]), _leader(leaders, count)
                if one != other:
                    leaders[other] = one
                    dots[one] += dots[other]
                k += 1
            count, found = count + 1, found + 1
        above = found
    regions, least = 0, np.inf
    for k in range(count):
        if leaders[k] == k:
            regions, least = regions + 1, min(least, dots[k])
    return regions, least


@inner
def _leader(leaders: Ids, run: int) -> int:
    while leaders[run] != run:
        leaders[run] = leaders[leaders[run]]
        run = leaders[run]
    return run
