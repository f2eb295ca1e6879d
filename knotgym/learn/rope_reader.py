"""Read the Gauss code off a picture of a rope of any one colour; no hue is used.

A network finds the strands and, at crossings, which is the upper one (`strand_network`); points
on them are linked to a closed line (`strand_walk`), whose crossings give the code. Mirror images
and quarter turns of the picture are read too, and their fields averaged.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from knotgym.common.errors import InvalidFile, InvalidInput, one_line
from knotgym.learn.checkpoint import ROPE_READER, policy_folder, read_weights
from knotgym.learn.reader import inference
from knotgym.learn.strand_network import CELL, DEPTH, ORIENTATIONS, Fields, StrandNetwork
from knotgym.learn.strand_walk import exchange, follow, link, ridge_points, unite
from knotgym.topology.crossings import Crossings, find_crossings
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float64]

LEAST = 256  # pixels; smaller pictures are enlarged
VIEWS = 8  # mirror images and quarter turns of a picture
_FILL = 0.8  # share of the side that an enlarged rope takes; one that takes much less is enlarged
_LOOP = 6.0  # length of the smallest loop, cells
_CROWDED = 1200  # points; more aren't a rope's
_BASE = 0.3  # least response at the base bead


class RopeReading(NamedTuple):
    """What a picture shows.

    Attributes:
        code: Gauss code with chirality, from the white base bead in the direction marked there;
            without such a mark from anywhere, in either direction.
        confidence: in [0, 1], about how likely the code is right.
        line: float64 (n, 3), the rope's centre line from the base bead: x and y in pixels, and a
            level, which is 1 on the upper strand of a crossing, -1 on the lower one, 0 elsewhere.
        based: whether the base bead is seen.
    """

    code: GaussCode
    confidence: float
    line: Array
    based: bool


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

    def read(self, picture: NDArray[np.uint8], views: int = VIEWS) -> RopeReading | None:
        """Read a picture.

        Args:
            picture: uint8 (side, side, 3), RGB.
            views: mirror images and turns that are read, 1 to VIEWS; fewer are faster.

        Returns:
            None if no closed line is found.

        Raises:
            InvalidInput: it isn't such a picture.
        """
        picture = np.asarray(picture)
        square = picture.ndim == 3 and picture.shape[:2] == picture.shape[:1] * 2
        if not (square and picture.shape[2] == 3 and picture.dtype == np.uint8):
            raise InvalidInput(
                "a picture must be uint8 of shape (side, side, 3), got"
                f" {picture.dtype} {picture.shape}"
            )
        box = np.array([0.0, 0.0, len(picture)])  # x, y and side, pixels
        found = self._read(picture, box, 1)
        if found is not None:
            low, high = found[0][:, :2].min(axis=0), found[0][:, :2].max(axis=0)
            side = (high - low).max() / _FILL
            if side < _FILL * len(picture):  # the rope is small: look closer
                box = np.append(0.5 * (low + high) - 0.5 * side, side)
        found = self._read(picture, box, views) or found
        if found is None:
            return None
        line, code, margin, share, based = found
        return RopeReading(code, _confidence(code.nx, margin, share), line, based)

    def _read(
        self, picture: NDArray[np.uint8], box: Array, views: int
    ) -> tuple[Array, GaussCode, float, float, bool] | None:
        """Read a square of a picture, given by x, y and side in pixels, as the line is."""
        side = max(LEAST, -(-int(box[2]) // DEPTH) * DEPTH)
        scale = box[2] / side
        # from -1 to 1 across the picture, as `grid_sample` counts
        axis = (np.arange(side) + 0.5) * scale
        x, y = ((axis + box[k]) * 2 / len(picture) - 1 for k in (0, 1))
        grid = torch.from_numpy(np.stack(np.meshgrid(x, y), axis=2)[None]).float()
        whole = torch.from_numpy(picture.copy()).permute(2, 0, 1)[None].float()
        seen = functional.grid_sample(whole, grid, padding_mode="border", align_corners=False)
        with inference():
            maps = maps_of(self.network, seen, views)[0]
        found = read_maps(maps)
        if found is None:
            return None
        line, code, margin, share = found
        based = False
        base = [float(_bilinear(maps.base[None], x, y)[0]) for x, y in line[:, :2]]
        if max(base) > _BASE:
            start, based = int(np.argmax(base)), True
            line = np.roll(line, -start, axis=0)
            step = line[1, :2] - line[-1, :2]
            if step @ _bilinear(maps.along, *line[0, :2]) < 0:
                line = np.roll(line[::-1], 1, axis=0)
            code = _lifted(line).code
        line = np.column_stack([(line[:, :2] + 0.5) * CELL * scale + box[:2], line[:, 2]])
        return line, code, margin, share, based


def load_rope_reader(name: str = ROPE_READER) -> RopeReader:
    """Load the weights of a reader of ropes: a folder, or ROPE_READER, which ships.

    Raises:
        InvalidFile: they are missing, changed or another network's.
    """
    network, folder = StrandNetwork(), policy_folder(name)
    try:
        tensors = {name: own.float() for name, own in read_weights(folder).items()}
        missing, unknown = network.load_state_dict(tensors, strict=False)
        if unknown or any(not name.endswith("num_batches_tracked") for name in missing):
            raise ValueError(f"missing {missing[:3]}, unknown {unknown[:3]}")
    except (RuntimeError, ValueError) as error:
        raise InvalidFile(f"{folder} isn't a reader of ropes: {one_line(error)[:200]}") from error
    return RopeReader(network)


def _confidence(nx: int, margin: float, share: float) -> float:
    """Estimate how likely a code is right."""
    return float(np.clip(margin * share**4 * 0.99**nx, 0.0, 1.0))


def maps_of(network: StrandNetwork, pictures: Tensor, votes: int) -> list[Maps]:
    """Find strands in n pictures (n, 3, side, side), averaged over the first views of eight."""
    with torch.no_grad():
        views = fields_of(network, pictures, votes)
    lines, upper, base, along = (torch.stack(part).mean(0) for part in zip(*views, strict=True))
    parts = torch.sigmoid(lines), upper, torch.sigmoid(base), along
    return [Maps(*one) for one in zip(*(part.cpu().numpy() for part in parts), strict=True)]


def read_maps(maps: Maps) -> tuple[Array, GaussCode, float, float] | None:
    """Return the line, float64 (n, 3), cells, its code, the margin and the share of `traced`."""
    found = traced(maps)
    if found is None:
        return None
    return *coded(found[0], maps), found[1]


def fields_of(network: StrandNetwork, pictures: Tensor, votes: int) -> list[Fields]:
    """Run the network on `votes` of the eight mirror images and turns; turn the fields back."""
    found = []
    for vote in range(votes):
        turns, flip = vote // 2 % 4, vote % 2
        seen = torch.flip(pictures, (3,)) if flip else pictures
        fields = Fields(*(part.float() for part in network(torch.rot90(seen, turns, (2, 3)))))
        found.append(turned_back(fields, turns, bool(flip)))
    return found


def turned_back(fields: Fields, turns: int, flip: bool) -> Fields:
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
        order = -torch.arange(ORIENTATIONS) % ORIENTATIONS
        lines = lines[:, order]
        upper = upper * torch.tensor([1.0, -1.0], device=upper.device)[:, None, None]
        along = along * torch.tensor([-1.0, 1.0], device=along.device)[:, None, None]
    return Fields(lines, upper, base, along)


def traced(maps: Maps) -> tuple[Array, float] | None:
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
    unite(points, partner, paid)
    order, line = follow(partner)
    closed = np.bincount(line[line >= 0]) if (line >= 0).any() else np.zeros(1)
    if closed.max() < 8:
        return None
    own = order[line == closed.argmax()] // 2
    return smooth(points[own, :2]), len(own) / len(points)


def smooth(line: Array) -> Array:
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


def coded(line: Array, maps: Maps) -> tuple[Array, GaussCode, float]:
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
