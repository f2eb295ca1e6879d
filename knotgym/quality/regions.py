"""Regions of the background that a drawn rope encloses: how many there are, and the smallest.

The rope is drawn as a band on a canvas of dots, dot by dot as OpenCV's `polylines` draws it, and
its background falls into regions of dots that are connected by sides or corners.

After a change run `pytest tests/quality`: the canvas is compared with OpenCV's.
"""

import numpy as np

from knotgym.common import Array, Ids, inner

# dots to a pixel, pixels of border, and binary places of a dot's fractions: of the ends of lines
# and of their edges
_FINE, _BORDER, _END, _EDGE = 3, 4, 4, 16
_ONE = 1 << _EDGE


@inner
def regions(pixels: Array, width: float) -> tuple[int, float]:
    """Count the regions beside a closed band; return the smallest area, too, square pixels.

    Args:
        pixels: float64 (beads, 2), the middle of the band.
        width: of the band, pixels.
    """
    beads, unit = len(pixels), 1 << (_EDGE - _END)
    low, high, dots = np.empty(2), np.empty(2), np.empty((beads, 2), np.int64)
    # a border keeps the outside connected, and the band within the canvas
    border = _BORDER + int(width / 2)
    for axis in range(2):
        low[axis] = high[axis] = pixels[0, axis]
        for i in range(beads):
            low[axis] = min(low[axis], pixels[i, axis])
            high[axis] = max(high[axis], pixels[i, axis])
        low[axis] = np.floor(low[axis]) - border
        for i in range(beads):
            dot = (pixels[i, axis] - low[axis]) * _FINE * (1 << _END)
            dots[i, axis] = int(np.rint(dot)) * unit
        high[axis] = (np.ceil(high[axis]) + border - low[axis]) * _FINE
    canvas = np.zeros((int(high[1]), int(high[0])), np.uint8)
    # Background is 8-connected, so that a line of one dot would leak diagonally; two dots don't.
    thick = max(2, int(np.rint(width * _FINE)))
    for i in range(beads):
        _band(canvas, dots[i - 1], dots[i], thick)
        _disc(canvas, _dot(dots[i, 0]), _dot(dots[i, 1]), (thick + 1) // 2)
    return _counted(canvas)


@inner
def _dot(place: int) -> int:
    """Return the nearest dot."""
    return (place + _ONE // 2) >> _EDGE


@inner
def _band(canvas: Array, start: Ids, end: Ids, thick: int) -> None:
    """Draw a line of some width between two places, (2,) each, in units of 2**-16 dots."""
    dx, dy = (start[0] - end[0]) / _ONE, (end[1] - start[1]) / _ONE
    length = np.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return
    half = (thick * (_ONE // 2) + thick % 2 * _ONE * 0.5) / length
    across, up, first = int(np.rint(dy * half)), int(np.rint(dx * half)), 0
    corners = np.empty((4, 2), np.int64)
    for k in range(4):
        middle, side = start if k < 2 else end, 1 if k % 3 == 0 else -1
        corners[k, 0], corners[k, 1] = middle[0] + side * across, middle[1] + side * up
        first = k if corners[k, 1] < corners[first, 1] else first
    for k in range(4):
        _line(canvas, corners[k - 1], corners[k])
    # Fill it from the top: two chains of sides go down from the highest corner, by rising and by
    # falling numbers. In the row where a side ends, the next one of its chain begins.
    # The lowest corner is opposite the highest.
    row, stop = _dot(corners[first, 1]), _dot(corners[(first + 2) % 4, 1])
    sides, chains = 4, np.empty((2, 4), np.int64)
    for side in range(2):  # corner, row where the side ends, x, and its change in a row
        chains[side, 0], chains[side, 1], chains[side, 2], chains[side, 3] = first, row, -_ONE, 0
    while row <= stop:
        for side in range(2):
            chain = chains[side]
            while row >= chain[1] and sides > 0:
                sides -= 1
                start, end = chain[0], (chain[0] + (3 if side else 1)) % 4
                last = _dot(corners[end, 1])
                chain[0] = end
                if last > row:
                    chain[1], chain[2] = last, corners[start, 0]
                    wide, high = corners[end, 0] - corners[start, 0], last - row
                    chain[3] = _quotient(2 * wide + high, 2 * high)
        begin, end = min(chains[0, 2], chains[1, 2]), max(chains[0, 2], chains[1, 2])
        for column in range(_dot(begin), _dot(end) + 1):
            canvas[row, column] = 1
        chains[0, 2] += chains[0, 3]
        chains[1, 2] += chains[1, 3]
        row += 1


@inner
def _quotient(number: int, by: int) -> int:
    """Divide by a positive number and round towards zero, as C does."""
    return number // by if number >= 0 else -(-number // by)


@inner
def _line(canvas: Array, start: Ids, end: Ids) -> None:
    """Draw a line of one dot in every row, or in every column if it is rather level."""
    level = abs(end[0] - start[0]) > abs(end[1] - start[1])
    major = 0 if level else 1
    if end[major] < start[major]:
        start, end = end, start
    canvas[_dot(end[1]), _dot(end[0])] = 1
    long, wide = end[major] - start[major], end[1 - major] - start[1 - major]
    step = _quotient(wide * _ONE, long | 1)
    at, other = _dot(start[major]), start[1 - major] + _ONE // 2
    for _ in range((long >> _EDGE) + 1):
        if level:
            canvas[other >> _EDGE, at] = 1
        else:
            canvas[at, other >> _EDGE] = 1
        at, other = at + 1, other + step


@inner
def _disc(canvas: Array, x: int, y: int, radius: int) -> None:
    """Fill a circle (Bresenham)."""
    error, dx, dy = 0, radius, 0
    while dx >= dy:
        for column in range(x - dx, x + dx + 1):
            canvas[y - dy, column] = canvas[y + dy, column] = 1
        for column in range(x - dy, x + dy + 1):
            canvas[y - dx, column] = canvas[y + dx, column] = 1
        error += 2 * dy + 1
        dy += 1
        if error > 0:
            error -= 2 * dx - 1
            dx -= 1


@inner
def _counted(canvas: Array) -> tuple[int, float]:
    """Count the regions of 0, connected by sides and corners; return the least area, pixels."""
    rows, columns = canvas.shape
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
                column += 1
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
    return regions, least / _FINE**2


@inner
def _leader(leaders: Ids, run: int) -> int:
    while leaders[run] != run:
        leaders[run] = leaders[leaders[run]]
        run = leaders[run]
    return run
