"""Read the Gauss code off a picture of a rope of any one colour; no hue is used.

A network finds the strands and, at crossings, which is the upper one (`strand_network`); points
on them are linked to a closed line (`strand_walk`), whose crossings give the code. Mirror images
and quarter turns of the picture are read too, and their fields averaged.

After a change run `pytest tests/learn/test_rope_reader.py`: fields of turned pictures must be
turned back, and photos be read.
"""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common import InvalidInput
from knotgym.learn.checkpoint import ROPE_READER, load_network, policy_folder, save_network
from knotgym.learn.reader import inference
from knotgym.learn.strand_network import CELL, ORIENTATIONS, Fields, StrandNetwork
from knotgym.learn.strand_walk import exchange, follow, link, ridge_points
from knotgym.topology import Crossings, GaussCode, find_crossings

Array = NDArray[np.float64]

# Pixels: pictures are brought to this side, as the network saw no other in training. At 1,024 it
# reads 1 of 10 that it reads 10 of at 256; of 24 pictures drawn at 512 it reads 23, shrunk or not.
SIDE = 256
VIEWS = 8  # mirror images and quarter turns of a picture
_LOOP = 6.0  # length of the smallest loop, cells
_SHORT = 8  # points; fewer are no rope
_CROWDED = 1200  # points; more aren't a rope's
_NEAR = [-2, -1, 0, 1, 2]  # points of the line that it reaches


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


class Maps(NamedTuple):
    """`Fields` of one picture as float32 arrays, responses in [0, 1] instead of logits."""

    lines: NDArray[np.float32]
    upper: NDArray[np.float32]
    base: NDArray[np.float32]
    along: NDArray[np.float32]


class RopeReader:
    """Reads pictures by a trained network."""

    def __init__(self, network: StrandNetwork) -> None:
        self.network = network.eval()

    def save(self, folder: Path, card: dict[str, Any]) -> None:
        """Write a folder that `load_rope_reader` reads; `card` adds how it was trained."""
        save_network(folder, self.network, ROPE_READER, card)

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
        way = cv2.INTER_AREA if side > SIDE else cv2.INTER_LINEAR
        seen = cv2.resize(picture.astype(np.float32), (SIDE, SIDE), interpolation=way)
        with inference():
            maps = _maps_of(self.network, torch.from_numpy(seen).permute(2, 0, 1)[None], views)[0]
        found = read_maps(maps)
        if found is None:
            return None
        line, code, margin, share = found
        base = _along(maps.base, line)
        start = int(base.argmax())
        step = line[(start + 1) % len(line), :2] - line[start - 1, :2]
        if step @ _bilinear(maps.along, *line[start, :2]) < 0:
            line, base, start = line[::-1], base[::-1], len(line) - 1 - start
        line, base = (np.roll(one, -start, axis=0) for one in (line, base))
        # the middle of the response lies between points
        line[0, :2] = np.average(line[_NEAR, :2], axis=0, weights=base[_NEAR])
        line[:, :2] = (line[:, :2] + 0.5) * CELL * side / SIDE
        score = _confidence(code.nx, margin, share)
        return RopeReading(_lifted(line).code, score, line)


def load_rope_reader(name: str = ROPE_READER) -> RopeReader:
    """Load the weights of a reader of ropes: a folder, or ROPE_READER, which ships.

    Raises:
        InvalidFile: as in `load_network`.
    """
    return RopeReader(load_network(policy_folder(name), ROPE_READER, lambda _: StrandNetwork())[0])


def _along(field: NDArray[np.float32], line: Array) -> Array:
    """Interpolate a field (h, w) at the points of a line, cells."""
    return np.array([_bilinear(field[None], x, y)[0] for x, y in line[:, :2]])


def _confidence(nx: int, margin: float, share: float) -> float:
    """Score a code by its least certain crossing and by the rope that the line leaves out."""
    return float(np.clip(margin * share**4 * 0.99**nx, 0.0, 1.0))


def _maps_of(network: StrandNetwork, pictures: Tensor, votes: int) -> list[Maps]:
    """Find strands in n pictures (n, 3, side, side), averaged over the first views of eight."""
    with torch.no_grad():
        views = _fields_of(network, pictures, votes)
    mean = Fields(*(torch.stack(part).mean(0) for part in zip(*views, strict=True)))
    parts = mean._replace(lines=torch.sigmoid(mean.lines), base=torch.sigmoid(mean.base))
    return [Maps(*one) for one in zip(*(part.cpu().numpy() for part in parts), strict=True)]


def read_maps(maps: Maps) -> tuple[Array, GaussCode, float, float] | None:
    """Return the line, float64 (n, 3), cells, its code, the margin and the share of `_traced`."""
    found = _traced(maps)
    if found is None:
        return None
    return *_coded(found[0], maps), found[1]


def _fields_of(network: StrandNetwork, pictures: Tensor, votes: int) -> list[Fields]:
    """Run the network on `votes` of the eight mirror images and turns; turn the fields back."""
    found = []
    for vote in range(votes):
        turns, flip = vote // 2 % 4, vote % 2
        seen = torch.flip(pictures, (3,)) if flip else pictures
        fields = Fields(*(part.float() for part in network(torch.rot90(seen, turns, (2, 3)))))
        found.append(turned_back(fields, turns, bool(flip)))
    return found


def turned_back(fields: Fields, turns: int, flip: bool) -> Fields:
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


def _traced(maps: Maps) -> tuple[Array, float] | None:
    """Walk along the rope.

    Returns:
        float64 (n, 2), cells, a closed line; and the share of the points found that it passes. None
        if no line closes.
    """
    points = ridge_points(maps.lines)
    if len(points) > _CROWDED:
        return None
    partner, paid = link(points)
    exchange(points, partner, paid)
    order, line = follow(partner)
    closed = np.bincount(line[line >= 0]) if (line >= 0).any() else np.zeros(1)
    if closed.max() < _SHORT:
        return None
    own = order[line == closed.argmax()] // 2
    line = _smooth(points[own, :2])
    return None if len(line) < _SHORT else (line, len(own) / len(points))


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


def _coded(line: Array, maps: Maps) -> tuple[Array, GaussCode, float]:
    """Lift a closed line (n, 2), cells, at its crossings; return it, its code and the margin."""
    points = np.column_stack([line[:, 0], -line[:, 1], np.zeros(len(line))])
    flat = find_crossings(points)
    # per crossing, the doubled directions of both strands, against that of the upper one
    margin = 1.0
    level = np.zeros(len(line))
    for over, under, position in zip(flat.over_place, flat.under_place, flat.position, strict=True):
        one, other = (_doubled(line, int(place)) for place in (over, under))
        apart = one - other
        seen = _bilinear(maps.upper, position[0], -position[1])
        vote = float(seen @ apart / max(np.hypot(*apart), 1e-6))
        margin = min(margin, abs(vote))
        for place, lift in ((over, vote), (under, -vote)):
            level[[int(place) % len(line), (int(place) + 1) % len(line)]] = np.sign(lift)
    lifted = np.column_stack([line, level])
    return lifted, _lifted(lifted).code, margin


def _lifted(line: Array) -> Crossings:
    """Find the crossings of a line, float64 (n, 3), y down, lifted by its levels."""
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
