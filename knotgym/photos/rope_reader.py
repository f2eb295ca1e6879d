"""Read the Gauss code off a picture of a rope of any one colour; no hue is used.

A network finds the strands and, at crossings, which is the upper one (`strand_network`); points
on them are linked to a closed line, whose crossings give the code. Mirror images and quarter turns
of the picture are read too, and their fields averaged.

Points are taken from the ridges of the lifted fields, each with the direction of its strand. A
point has two ends, one on either side, and every end is linked to one end of another point: the
cheapest links first, where short, straight and evenly bent ones are cheap. So each point has two
neighbours, and following them gives closed lines. Two strands that cross share places, but not
directions, so links between them are dear. Places are in cells, x right and y down; the centre of
cell (row, column) is (column, row).

After a change run `pytest tests/photos/test_rope_reader.py`: drawn lines must be
walked through their crossings, fields of turned pictures be turned back, and photos be read.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common import Array, Ids, InvalidInput, inner, kernel
from knotgym.photos.strand_network import CELL, ORIENTATIONS, Fields, StrandNetwork
from knotgym.topology import Crossings, GaussCode, find_crossings

# Chosen on training pictures, one by one. No file depends on them: after a change, ropes must be
# read as docs/perception.md says.
_LEAST = 0.3  # response of a point
_MOST = 6000  # candidates, at most; a picture with more shows no rope
# Of two points nearer than this, the weaker is dropped: cells, and radians.
_NEAR, _ALIKE = 1.3, 0.35
_REACH = 9.0  # length of a link at most, cells
_SWEEPS = 8  # over all pairs of links, at most
_ROUNDS = 20  # times that loose points are dropped, at most
_BEND = 2.5  # cost of a turn of one radian, cells
_SWERVE = 3.0  # cost of a link that doesn't point in the direction of both ends: share per radian^2

# Pixels: pictures are brought to this side, as the network saw no other in training. At 1,024 it
# reads 1 of 10 that it reads 10 of at 256; of 24 pictures drawn at 512 it reads 23, shrunk or not.
SIDE = 256
VIEWS = 8  # mirror images and quarter turns of a picture
_LOOP = 6.0  # length of the smallest loop, cells
_SHORT = 8  # points; fewer are no rope
_CROWDED = 1200  # points; more aren't a rope's
_BESIDE = [-2, -1, 0, 1, 2]  # points of the line that it reaches


@kernel
def _ridge_points(lines: NDArray[np.float32]) -> Array:
    """Return points on the ridges of fields.

    Args:
        lines: float32 (orientations, h, w), in [0, 1].

    Returns:
        float64 (n, 4): x, y, direction in radians, and response.
    """
    count, h, w = lines.shape
    found = np.empty((_MOST, 4))
    n = 0
    for k in range(count):
        angle = k * np.pi / count
        across_x, across_y = -np.sin(angle), np.cos(angle)
        for row in range(h):
            for column in range(w):
                here = lines[k, row, column]
                if here < _LEAST or n == _MOST:
                    continue
                left = _at(lines, k, column - across_x, row - across_y)
                right = _at(lines, k, column + across_x, row + across_y)
                if here < left or here <= right:
                    continue
                # the top of the parabola through the three responses
                aside = 0.5 * (right - left) / max(2 * here - left - right, 1e-6)
                less, more = lines[k - 1, row, column], lines[(k + 1) % count, row, column]
                turn = 0.5 * (more - less) / max(2 * here - less - more, 1e-6)
                found[n, 0] = column + min(max(aside, -0.5), 0.5) * across_x
                found[n, 1] = row + min(max(aside, -0.5), 0.5) * across_y
                found[n, 2] = angle + min(max(turn, -0.5), 0.5) * np.pi / count
                found[n, 3] = here
                n += 1
    found = found[:n]
    found = found[np.argsort(-found[:, 3])]
    kept = np.empty(n, np.int64)
    m = 0
    for i in range(n):
        new = True
        for j in range(m):
            k = kept[j]
            dx, dy = found[i, 0] - found[k, 0], found[i, 1] - found[k, 1]
            if dx * dx + dy * dy < _NEAR * _NEAR:
                off = abs(found[i, 2] - found[k, 2]) % np.pi
                if min(off, np.pi - off) < _ALIKE:
                    new = False
                    break
        if new:
            kept[m] = i
            m += 1
    return found[kept[:m]]


@inner
def _link_cost(points: Array, i: int, j: int) -> float:
    """Return the cost of linking end i to end j, cells; end 2 k + 1 of point k is that ahead."""
    a, b = i // 2, j // 2
    one, other = (1.0 if i % 2 else -1.0), (-1.0 if j % 2 else 1.0)
    # directions in which the rope leaves the first point and arrives at the second
    ax, ay = one * np.cos(points[a, 2]), one * np.sin(points[a, 2])
    bx, by = other * np.cos(points[b, 2]), other * np.sin(points[b, 2])
    dx, dy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    length = np.sqrt(dx * dx + dy * dy)
    turn = np.arccos(min(max(ax * bx + ay * by, -1.0), 1.0))
    # an even bend leads along the middle of both directions
    mx, my = ax + bx, ay + by
    swerve = 0.0
    if length > 1e-6:
        swerve = abs(np.arctan2(mx * dy - my * dx, mx * dx + my * dy))
    return length * (1 + _SWERVE * swerve * swerve) + _BEND * turn


@kernel
def _link(points: Array) -> tuple[Ids, Array]:
    """Link the ends of points, the cheapest first.

    Returns:
        int64 (2 n,), the end that each end is linked to, -1 for none; float64 (2 n,), the costs.
    """
    n = len(points)
    most = 120 * n + 1
    first, second, costs = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    m = 0
    for a in range(n):
        for b in range(a + 1, n):
            dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
            if dx * dx + dy * dy > _REACH * _REACH:
                continue
            for i in range(2 * a, 2 * a + 2):
                for j in range(2 * b, 2 * b + 2):
                    cost = _link_cost(points, i, j)
                    if cost < 2 * _REACH and m < len(costs):
                        first[m], second[m], costs[m] = i, j, cost
                        m += 1
    dear = np.argsort(costs[:m])
    alive = np.ones(n, np.bool_)
    partner, paid = np.full(2 * n, -1, np.int64), np.zeros(2 * n)
    for _ in range(_ROUNDS):
        partner[:] = -1
        for k in dear:
            i, j = first[k], second[k]
            if partner[i] < 0 and partner[j] < 0 and alive[i // 2] and alive[j // 2]:
                partner[i], partner[j] = j, i
                paid[i] = paid[j] = costs[k]
        # a point with a loose end was found twice: of those near each other, drop the weakest
        loose = alive & ((partner[::2] < 0) | (partner[1::2] < 0))
        if not loose.any():
            break
        for a in np.flatnonzero(loose)[::-1]:  # the weakest first
            if loose[a]:
                alive[a] = False
                for b in range(n):
                    dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
                    if dx * dx + dy * dy < _REACH * _REACH:
                        loose[b] = False
    return partner, paid


@kernel
def _exchange(points: Array, partner: Ids, paid: Array) -> None:
    """Exchange the ends of two links, in place, as long as that makes them cheaper together."""
    for _ in range(_SWEEPS):
        better = False
        for i in range(len(partner)):
            for j in range(i + 1, len(partner)):
                one, other = partner[i], partner[j]
                if one < 0 or other < 0 or one == j or i // 2 == j // 2 or one // 2 == other // 2:
                    continue
                dx = points[i // 2, 0] - points[j // 2, 0]
                dy = points[i // 2, 1] - points[j // 2, 1]
                if dx * dx + dy * dy > _REACH * _REACH:
                    continue
                left, right = _link_cost(points, i, j), _link_cost(points, one, other)
                if left + right < paid[i] + paid[j] - 1e-6:
                    partner[i], partner[j], partner[one], partner[other] = j, i, other, one
                    paid[i] = paid[j] = left
                    paid[one] = paid[other] = right
                    better = True
        if not better:
            return


@kernel
def _longest_line(partner: Ids) -> Ids:
    """Follow links from end to end; return the points of the longest line that closes, int64."""
    n = len(partner) // 2
    order, longest = np.empty(n, np.int64), np.empty(0, np.int64)
    seen = np.zeros(n, np.bool_)
    for start in range(n):
        # a point is left by the end across from that at which it was reached
        m, point, after = 0, start, 2 * start
        while after >= 0 and not seen[point]:
            seen[point] = True
            order[m] = point
            m += 1
            after = partner[after ^ 1]
            point = after // 2
        if after >= 0 and point == start and m > len(longest):
            longest = order[:m].copy()
    return longest


@inner
def _at(lines: NDArray[np.float32], k: int, x: float, y: float) -> float:
    """Interpolate one field between cells."""
    _, h, w = lines.shape
    column, row = int(np.floor(x)), int(np.floor(y))
    dx, dy = x - column, y - row
    out = 0.0
    for r in range(2):
        for c in range(2):
            if 0 <= row + r < h and 0 <= column + c < w:
                weight = (dy if r else 1 - dy) * (dx if c else 1 - dx)
                out += weight * lines[k, row + r, column + c]
    return out


class RopeReading(NamedTuple):
    """What a picture shows.

    Attributes:
        code: Gauss code with chirality, from the white base bead in the direction marked there;
            without such a mark from anywhere, in either direction.
        confidence: a score in [0, 1], higher where the code is surer to be right.
        line: float64 (n, 3), the rope's centre line from the base bead: x and y in pixels, and a
            level, which is 1 on the upper strand of a crossing, -1 on the lower one, 0 elsewhere.
    """

    code: GaussCode
    confidence: float
    line: Array


class RopeReader:
    """Reads pictures by a trained network."""

    def __init__(self, network: StrandNetwork) -> None:
        self.network = network.eval()

    def read(self, picture: NDArray[np.uint8], views: int = VIEWS) -> RopeReading | None:
        """Read a picture of any size.

        Args:
            picture: uint8 (side, side, 3), RGB.
            views: mirror images and turns that are read, 1 to VIEWS; fewer are faster.

        Returns:
            None if no closed line is found.

        Raises:
            InvalidInput: it isn't such a picture, or there are no such views.
        """
        picture = np.asarray(picture)
        side = len(picture) if picture.ndim else 0
        if picture.shape != (side, side, 3) or not side or picture.dtype != np.uint8:
            raise InvalidInput(
                "a picture must be uint8 of shape (side, side, 3), RGB, got"
                f" {picture.dtype} {picture.shape}"
            )
        if not 1 <= views <= VIEWS:
            raise InvalidInput(f"views must be from 1 to {VIEWS}, got {views}")
        # the mean over the area of a pixel, where bilinear interpolation would skip pixels
        method = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
        seen = cv2.resize(picture.astype(np.float32), (SIDE, SIDE), interpolation=method)
        with inference():
            fields = _averaged(self.network, torch.from_numpy(seen).permute(2, 0, 1)[None], views)
        found = _line_in(fields)
        if found is None:
            return None
        line, confidence = found
        base = np.array([_bilinear(fields.base[None], x, y)[0] for x, y in line[:, :2]])
        start = int(base.argmax())
        step = line[(start + 1) % len(line), :2] - line[start - 1, :2]
        if step @ _bilinear(fields.along, *line[start, :2]) < 0:
            line, base, start = line[::-1], base[::-1], len(line) - 1 - start
        line, base = (np.roll(one, -start, axis=0) for one in (line, base))
        # the middle of the response lies between points
        line[0, :2] = np.average(line[_BESIDE, :2], axis=0, weights=base[_BESIDE])
        line[:, :2] = (line[:, :2] + 0.5) * CELL * side / SIDE
        return RopeReading(_crossings_of(line).code, confidence, line)


@contextmanager
def inference() -> Iterator[None]:
    """Run networks without gradients and on one thread.

    With more threads, the order of sums, and so their rounding, depends on the machine, and the
    threads of several worker processes wait for each other, which is many times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)


def _averaged(network: StrandNetwork, picture: Tensor, views: int) -> Fields:
    """Find strands in a picture (1, 3, side, side), averaged over the first views of eight.

    Returns:
        Its fields as float32 arrays, with responses in [0, 1] instead of logits.
    """
    found = []
    for turns, flip in (divmod(view, 2) for view in range(views)):
        seen = torch.flip(picture, (3,)) if flip else picture
        found.append(_turned_back(network(torch.rot90(seen, turns, (2, 3))), turns, bool(flip)))
    mean = Fields(*(torch.stack(part).mean(0)[0] for part in zip(*found, strict=True)))
    mean = mean._replace(lines=torch.sigmoid(mean.lines), base=torch.sigmoid(mean.base))
    return Fields(*(part.numpy() for part in mean))


def _turned_back(fields: Fields, turns: int, flip: bool) -> Fields:
    """Return the fields of a picture that was flipped or not, and then turned by quarters."""
    lines, upper, base, along = (torch.rot90(part, -turns, (-2, -1)) for part in fields)
    # torch.rot90 turns the picture by -90 degrees as angles go here (y down)
    lines = torch.roll(lines, turns * (ORIENTATIONS // 2), 1)
    upper = upper * (-1) ** turns
    for _ in range(turns):
        along = torch.stack([-along[:, 1], along[:, 0]], 1)
    if flip:
        lines, upper, base, along = (
            torch.flip(part, (-1,)) for part in (lines, upper, base, along)
        )
        lines = lines[:, -torch.arange(ORIENTATIONS) % ORIENTATIONS]
        upper = upper * torch.tensor([1.0, -1.0], device=upper.device)[:, None, None]
        along = along * torch.tensor([-1.0, 1.0], device=along.device)[:, None, None]
    return Fields(lines, upper, base, along)


def _line_in(fields: Fields) -> tuple[Array, float] | None:
    """Walk along the rope, and lift it at its crossings.

    Args:
        fields: of one picture, as `_averaged` returns them.

    Returns:
        float64 (n, 3), cells, a closed line and its levels; and a score of its code by its least
        certain crossing and by the share of the points found that it passes. None if no line
        closes.
    """
    points = _ridge_points(fields.lines)
    if len(points) > _CROWDED:
        return None
    partner, paid = _link(points)
    _exchange(points, partner, paid)
    own = _longest_line(partner)
    if len(own) < _SHORT:
        return None
    line = _smooth(points[own, :2])
    if len(line) < _SHORT:
        return None
    flat = _crossings_of(np.column_stack([line, np.zeros(len(line))]))
    # per crossing, the doubled directions of both strands, against that of the upper one
    margin, level = 1.0, np.zeros(len(line))
    for over, under, position in zip(flat.over_place, flat.under_place, flat.position, strict=True):
        one, other = (_doubled(line, int(place)) for place in (over, under))
        between = one - other
        seen = _bilinear(fields.upper, position[0], -position[1])
        vote = float(seen @ between / max(np.hypot(*between), 1e-6))
        margin = min(margin, abs(vote))
        for place, lift in ((over, vote), (under, -vote)):
            level[[int(place) % len(line), (int(place) + 1) % len(line)]] = np.sign(lift)
    lifted, passed = np.column_stack([line, level]), len(own) / len(points)
    score = margin * passed**4 * 0.99 ** _crossings_of(lifted).nx
    return lifted, float(np.clip(score, 0.0, 1.0))


def _smooth(line: Array) -> Array:
    """Smooth a closed line (n, 2), and cut off loops too small to be a strand's."""
    for _ in range(2):
        line = 0.25 * (np.roll(line, 1, 0) + 2 * line + np.roll(line, -1, 0))
    flat = find_crossings(np.column_stack([line, np.zeros(len(line))]))
    step = np.hypot(*(np.roll(line, -1, 0) - line).T)
    kept = np.ones(len(line), dtype=bool)
    for first, last in np.sort(np.column_stack([flat.over_place, flat.under_place])).astype(int):
        inside = np.arange(first + 1, last + 1)
        outside = np.arange(last + 1, first + 1 + len(line)) % len(line)
        for loop in (inside, outside):
            if step[loop].sum() < _LOOP:
                kept[loop] = False
    return line[kept]


def _crossings_of(line: Array) -> Crossings:
    """Find the crossings of a line, float64 (n, 3), y down, with heights or levels."""
    return find_crossings(line * (1.0, -1.0, 1.0))


def _doubled(line: Array, place: int) -> Array:
    step = line[(place + 3) % len(line)] - line[(place - 2) % len(line)]
    angle = 2 * np.arctan2(step[1], step[0])
    return np.array([np.cos(angle), np.sin(angle)])


def _bilinear(field: NDArray[np.float32], x: float, y: float) -> Array:
    """Interpolate a field (c, h, w) at a place."""
    column, row = (int(np.clip(v, 0, field.shape[1] - 2)) for v in (x, y))
    dx, dy = x - column, y - row
    part = field[:, row : row + 2, column : column + 2].astype(np.float64)
    return (part * np.outer([1 - dy, dy], [1 - dx, dx])).sum(axis=(1, 2))
