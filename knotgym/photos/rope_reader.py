"""Read Gauss codes off photos of rope of any colour: open or closed, one or several.

A network finds the strands and, at crossings, which is the upper one (`strand_network`); the lines
that these fields hold (`strand_lines`) cross each other, which gives the code. Mirror images and
quarter turns of the picture are read too, and their fields averaged. A picture is read at two
scales, and at more if that leaves doubt: a code that both give is right 99 times of 100.

After a change run `pytest tests/photos/test_rope_reader.py`: drawn lines must be walked through
their crossings, fields of turned pictures be turned back, and photos be read.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from knotgym.common import Array, InvalidInput
from knotgym.photos.line_mending import Line, response_at
from knotgym.photos.strand_lines import lines_in
from knotgym.photos.strand_network import CELL, ORIENTATIONS, Fields, StrandNetwork
from knotgym.topology import GaussCode, RopesCode, find_ropes_crossings, knot_type

# Pixels: pictures are brought to this side, as the network saw no other in training. At 1,024 it
# reads 1 of 10 that it reads 10 of at 256; of 24 pictures drawn at 512 it reads 23, shrunk or not.
SIDE = 256
VIEWS = 8  # mirror images and quarter turns of a picture
# Chosen on drawn photos and on mBEST's S1 0 to 44 (docs/photos.md has what came of it).
_SCALES = (1.0, 1.5, 0.8, 0.65, 0.5)  # of the picture's longer side; larger for thin ropes
_FEW = 2  # views at scales that are only looked at
# Logarithm of the odds that a reading is right: so much for any, for one whose code both of the
# first scales give, for one at a scale larger than the first, for one at a smaller scale or
# confirmed by one, for each crossing, and so much times the logarithm of the weakest response along
# its lines. Fitted to 840 drawn photos of both looks, of diagrams that no network was trained on.
_ANY, _CONFIRMED, _LARGER, _SMALLER, _EACH, _RESPONSE = 1.0, 4.55, 0.97, -3.3, -0.1, 3.4
_FAIR = 0.5  # chance at which no smaller scale is looked at
_LOOP = 6.0  # length of the smallest loop, cells
_TIP = 2.5  # points at a loose end, where a crossing is the end lying on a strand
_EDGE = 6.0  # a loose end nearer to the edge of the picture is where the rope leaves it, cells
_LEAST = 0.02  # of responses, before their logarithms are taken
_NOTHING = 0.5  # chance that there is no rope where no line is found
_ALTERNATIVE = 0.6  # share of the best chance at which a reading with ends forbids a closed code
_ALIKE = 0.02  # added to the distance of directions, squared, so that like ones count less


@dataclass(frozen=True, eq=False)
class Rope:
    """A rope in a picture.

    Attributes:
        closed: whether it has no ends.
        gauss_code: its visits; labels are those of the picture, from 1 in order of first visit.
        confidence: the chance, in [0, 1], that its code is right.
        knot: knot type of a closed rope, of its crossings with itself; None if it is open.
        line: float64 (n, 2), its centre line, x and y in pixels.
    """

    closed: bool
    gauss_code: str
    confidence: float
    knot: str | None
    line: Array

    @property
    def crossings(self) -> int:
        """The number of crossings that it passes."""
        return len({word.strip("+-") for word in self.gauss_code.split(",") if word})


@dataclass(frozen=True, eq=False)
class PhotoReading:
    """What a picture shows.

    Attributes:
        ropes: the longest first.
        code: the code of them all, the smallest of all directions and starts; None without a rope.
        confidence: that of the least sure rope.
        places: float64 (n, 2), the crossings in order of labels, x and y in pixels.
        votes: float64 (n,), how sure it is which strand is on top there, in [0, 1].
        over: float64 (n, 2), unit vectors along the upper strands.
        loose: float64 (m, 2), the loose ends, pixels.
        reason: why no closed code is given, "" where one is.
    """

    ropes: tuple[Rope, ...] = ()
    code: RopesCode | None = None
    confidence: float = 0.0
    places: Array = field(default_factory=lambda: np.empty((0, 2)))
    votes: Array = field(default_factory=lambda: np.empty(0))
    over: Array = field(default_factory=lambda: np.empty((0, 2)))
    loose: Array = field(default_factory=lambda: np.empty((0, 2)))
    reason: str = "no rope"

    @property
    def crossings(self) -> int:
        """The number of crossings."""
        return len(self.places)

    @property
    def closed(self) -> bool:
        """Whether there is a rope and none has ends."""
        return bool(self.ropes) and all(rope.closed for rope in self.ropes)

    @property
    def row(self) -> dict[str, Any]:
        """Everything but lines and places, as JSON has it."""
        names = ("closed", "crossings", "gauss_code", "confidence", "knot")
        ropes = [{name: getattr(rope, name) for name in names} for rope in self.ropes]
        whole = {"crossings": self.crossings, "closed": self.closed, "reason": self.reason or None}
        return {"ropes": ropes, **whole}


class RopeReader:
    """Reads pictures by a trained network."""

    def __init__(self, network: StrandNetwork) -> None:
        self.network = network.eval()

    def read(
        self, picture: NDArray[np.uint8], views: int = 4, scales: Sequence[float] = _SCALES
    ) -> PhotoReading:
        """Read a picture of any size and shape.

        Args:
            picture: uint8 (height, width, 3), RGB, or (height, width), grey.
            views: mirror images and turns that are read, 1 to VIEWS; fewer are faster.
            scales: of the picture in what the network sees, the first with all views. The first
                two are looked at, others until a reading is more likely right than wrong.

        Raises:
            InvalidInput: it isn't such a picture, or there are no such views.
        """
        picture = np.asarray(picture)
        if picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=2)
        if (
            picture.ndim != 3
            or picture.shape[2] != 3
            or not picture.size
            or picture.dtype != np.uint8
        ):
            raise InvalidInput(
                "a picture must be uint8 of shape (height, width, 3), RGB, or (height, width), got"
                f" {picture.dtype} {picture.shape}"
            )
        if not 1 <= views <= VIEWS:
            raise InvalidInput(f"views must be from 1 to {VIEWS}, got {views}")
        looks = list[_Look]()
        for scale in scales:
            seen, shift, step = _placed(picture, scale)
            with inference():
                tensor = torch.from_numpy(seen).permute(2, 0, 1)[None]
                fields = _averaged(self.network, tensor, views if not looks else min(views, _FEW))
            looks.append(_Look(*_reading(fields, picture.shape, shift, step), scale))
            best = _best(looks)
            if len(looks) > 1 and best[1] >= _FAIR:
                break
        return best[0]


class _Look(NamedTuple):
    """A reading at one scale, and the weakest response along each of its ropes."""

    reading: PhotoReading
    weakest: Array
    scale: float

    def chance(self, weakest: float, confirmed: bool, late: bool) -> float:
        """The chance that the reading is right, which another scale may confirm, early or late."""
        if not self.reading.ropes:
            return _NOTHING
        odds = _ANY + _CONFIRMED * confirmed + _EACH * self.reading.crossings
        odds += _RESPONSE * np.log(max(weakest, _LEAST))
        odds += _SMALLER if self.scale < 1 or late else _LARGER if self.scale > 1 else 0.0
        return float(1 / (1 + np.exp(-odds)))


def _agree(one: PhotoReading, other: PhotoReading) -> bool:
    """Tell whether two readings have the same code, or both no rope."""
    codes = [reading.code.plain for reading in (one, other) if reading.code]
    shapes = [sorted(zip(code.closed, map(len, code.visits), strict=True)) for code in codes]
    if len(codes) < 2 or shapes[0] != shapes[1]:
        return not codes
    return codes[0].smallest(ordered=False) == codes[1].smallest(ordered=False)


def _best(looks: Sequence[_Look]) -> tuple[PhotoReading, float]:
    """Choose among the readings of one picture at several scales.

    A closed code is withheld where no second scale confirms it, and a reading with ends is nearly
    as likely.

    Returns:
        The reading, and the chance that it is right.
    """
    pairs = ((i, j) for j in range(len(looks)) for i in range(j))
    both = next((pair for pair in pairs if _agree(*(looks[k].reading for k in pair))), ())
    late = both not in ((), (0, 1))
    chances = [
        one.chance(one.weakest.min(initial=1.0), k in both, late and k in both)
        for k, one in enumerate(looks)
    ]
    best = int(np.argmax(chances))
    look, reading, chance, confirmed = looks[best], looks[best].reading, chances[best], best in both
    # an unsure vote for an upper strand makes its ropes unsure
    ropes = list[Rope]()
    for rope, walk, weakest in zip(
        reading.ropes, reading.code.visits if reading.code else (), look.weakest, strict=True
    ):
        told = 0.5 + 0.5 * reading.votes[[abs(visit) - 1 for visit in walk]].min(initial=1.0)
        sure = look.chance(weakest, confirmed, late and confirmed) * float(told)
        ropes.append(replace(rope, confidence=round(sure, 3)))
    confidence = min((one.confidence for one in ropes), default=0.0)
    others = [
        other for one, other in zip(looks, chances, strict=True)
        if one.reading.loose.size and other >= _ALTERNATIVE * chance
    ]  # fmt: skip
    if reading.closed and others and not confirmed:
        reason = f"two readings, {chance:.1f} and {max(others):.1f}"
        return PhotoReading(confidence=confidence, reason=reason), chance
    return replace(reading, ropes=tuple(ropes), confidence=confidence), chance


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


def _placed(picture: NDArray[np.uint8], scale: float) -> tuple[NDArray[np.float32], Array, float]:
    """Put a picture into the middle of a square of SIDE pixels, or more if its scale is above 1.

    Returns:
        float32 (side, side, 3), where beside the picture is the median colour of its border; the
        picture's upper left corner in it, (2,), x and y; and its pixels for each of the picture's.
    """
    (height, width), side = picture.shape[:2], round(SIDE * max(scale, 1.0))
    step = scale * SIDE / max(height, width)
    size = max(round(width * step), 1), max(round(height * step), 1)
    # the mean over the area of a pixel, where bilinear interpolation would skip pixels
    method = cv2.INTER_AREA if step < 1 else cv2.INTER_LINEAR
    small = cv2.resize(picture.astype(np.float32), size, interpolation=method)
    border = np.concatenate([small[0], small[-1], small[:, 0], small[:, -1]])
    square = np.empty((side, side, 3), np.float32)
    square[:] = np.median(border, axis=0)
    left, top = (side - size[0]) // 2, (side - size[1]) // 2
    square[top : top + size[1], left : left + size[0]] = small
    return square, np.array([left, top], float), step


def _averaged(network: StrandNetwork, picture: Tensor, views: int) -> Fields:
    """Find strands in a picture (1, 3, side, side), averaged over the first views of eight.

    Returns:
        Its fields as float32 arrays, with responses in [0, 1] instead of logits.
    """
    fields = []
    for turns, flip in (divmod(view, 2) for view in range(views)):
        seen = torch.flip(picture, (3,)) if flip else picture
        fields.append(_turned_back(network(torch.rot90(seen, turns, (2, 3))), turns, bool(flip)))
    mean = Fields(*(torch.stack(part).mean(0)[0] for part in zip(*fields, strict=True)))
    mean = mean._replace(lines=torch.sigmoid(mean.lines))
    return Fields(*(part.numpy() for part in mean))


def _turned_back(fields: Fields, turns: int, flip: bool) -> Fields:
    """Return the fields of a picture that was flipped or not, and then turned by quarters."""
    lines, upper = (torch.rot90(part, -turns, (-2, -1)) for part in fields)
    # torch.rot90 turns the picture by -90 degrees as angles go here (y down)
    lines = torch.roll(lines, turns * (ORIENTATIONS // 2), 1)
    upper = upper * (-1) ** turns
    if flip:
        lines, upper = (torch.flip(part, (-1,)) for part in (lines, upper))
        lines = lines[:, -torch.arange(ORIENTATIONS) % ORIENTATIONS]
        upper = upper * torch.tensor([1.0, -1.0], device=upper.device)[:, None, None]
    return Fields(lines, upper)


def _reading(
    fields: Fields, shape: Sequence[int], shift: Array, step: float
) -> tuple[PhotoReading, Array]:
    """Read the fields of a picture that was placed as `_placed` says.

    Returns:
        The reading, without confidence, and the weakest response along each rope, in [0, 1].
    """
    height, width = shape[:2]
    frame = np.append(shift, shift + step * np.array([width, height])) / CELL - 0.5
    lines = [_without_loops(line) for line in lines_in(fields.lines, frame)]
    lines = [line for line in lines if len(line.points) > 3]
    if not lines:
        return PhotoReading(), np.empty(0)
    code, places, votes, over = _crossed(lines, fields.upper)
    response, weakest, ropes = fields.lines.max(axis=0), list[float](), list[Rope]()
    for k, line in enumerate(lines):
        # of three cells each, so that one cell decides nothing
        along = np.convolve(response_at(response, line.points), np.ones(3) / 3, "valid")
        weakest.append(float(along.min()))
        knot = _knot(code.rope(k)) if line.closed else None
        pixels = ((line.points + 0.5) * CELL - shift) / step
        ropes.append(Rope(line.closed, code.texts[k], 0.0, knot, pixels))
    tips = [rope.line[[0, -1]] for rope in ropes if not rope.closed]
    loose = np.concatenate(tips) if tips else np.empty((0, 2))
    pixels = ((places + 0.5) * CELL - shift) / step
    reason = _reason(loose, shape, _EDGE * CELL / step)
    reading = PhotoReading(tuple(ropes), code, 0.0, pixels, votes, over, loose, reason)
    return reading, np.array(weakest)


def _knot(code: GaussCode) -> str:
    try:
        return knot_type(code)
    except InvalidInput:  # no closed curve in the plane has this code
        return "unknown"


def _reason(loose: Array, shape: Sequence[int], near: float) -> str:
    """Say where a picture's ropes end; "" if none does."""
    if not len(loose):
        return ""
    height, width = shape[:2]
    room = np.minimum(loose, (width, height) - loose).min(axis=1)
    each = [f"({x:.0f}, {y:.0f})" for x, y in loose]
    inside = [text for text, far in zip(each, room, strict=True) if far >= near]
    cut = [text for text, far in zip(each, room, strict=True) if far < near]
    counted = {1: "one loose end", 2: "two loose ends"}
    said = f"{counted.get(len(inside), f'{len(inside)} loose ends')} at {' and '.join(inside)}"
    leaves = f"a rope leaves the picture at {' and '.join(cut)}"
    return "; ".join([said] * bool(inside) + [leaves] * bool(cut))


def _without_loops(line: Line) -> Line:
    """Cut off loops of a line that are too small to be a strand's."""
    points = line.points
    met = find_ropes_crossings([_flat(line)], line.closed)
    step = np.hypot(*(np.roll(points, -1, 0) - points).T)
    kept = np.ones(len(points), dtype=bool)
    for first, last in np.sort(np.column_stack([met.over_place, met.under_place])).astype(int):
        inside = np.arange(first + 1, last + 1)
        outside = np.arange(last + 1, first + 1 + len(points)) % len(points)
        for loop in (inside, outside) if line.closed else (inside,):
            if step[loop].sum() < _LOOP:
                kept[loop] = False
    return Line(points[kept], line.closed)


def _flat(line: Line) -> Array:
    return np.column_stack([line.points * (1.0, -1.0), np.zeros(len(line.points))])


def _crossed(
    lines: Sequence[Line], upper: NDArray[np.float32]
) -> tuple[RopesCode, Array, Array, Array]:
    """Find the crossings of lines, and which strand is the upper one.

    Args:
        lines: in cells.
        upper: float32 (2, h, w), see `Fields`.

    Returns:
        The code of the lines as they are walked; places of the crossings, float64 (n, 2), cells;
        votes for the upper strands, in [0, 1]; and unit vectors along these, float64 (n, 2).
    """
    met = find_ropes_crossings([_flat(line) for line in lines], [chain.closed for chain in lines])
    starts = np.cumsum([0, *(len(line.points) for line in lines)])
    count, dropped = len(met.sign), set[int]()
    votes, over = np.empty(count), np.empty((count, 2))
    both = np.stack([met.over_place, met.under_place], axis=1)
    for k, (x, y) in enumerate(met.position * (1.0, -1.0)):
        ways = []
        for place in both[k]:
            owner = int(np.searchsorted(starts, place, "right")) - 1
            line, at = lines[min(owner, len(lines) - 1)], place - starts[owner]
            ways.append(_doubled(line, int(at)))
            if not line.closed and not _TIP <= at <= len(line.points) - 1 - _TIP:
                dropped.add(k + 1)
        between = ways[0] - ways[1]
        # 1 if the network says one of both; 2 p - 1 if it gives that a chance of p
        votes[k] = _bilinear(upper, x, y) @ between / (0.5 * between @ between + _ALIKE)
        half = 0.5 * np.arctan2(*ways[int(votes[k] < 0)][::-1])
        over[k] = np.cos(half), np.sin(half)
    # a vote against the strand that is visited first switches the crossing
    switched = {k + 1 for k in np.flatnonzero(votes < 0).tolist()}
    walks = [
        [-visit if abs(visit) in switched else visit for visit in walk if abs(visit) not in dropped]
        for walk in met.code.visits
    ]
    letters = {
        k: ("a" if letter == "c" else "c") if k in switched else letter
        for k, letter in enumerate(met.code.chirality or "", 1)
    }
    code = GaussCode.relabelled([visit for walk in walks for visit in walk], letters)
    kept = list(dict.fromkeys(abs(visit) for walk in walks for visit in walk))
    rows = np.array(kept, int) - 1
    parts = iter(code.visits)
    visits = tuple(tuple(next(parts) for _ in walk) for walk in walks)
    whole = RopesCode(visits, tuple(chain.closed for chain in lines), code.chirality)
    sure = np.minimum(np.abs(votes[rows]), 1.0)
    return whole, met.position[rows] * (1.0, -1.0), sure, over[rows]


def _doubled(line: Line, place: int) -> Array:
    """Return the unit vector of twice the angle of a line at a point."""
    n, (first, last) = len(line.points), (place - 2, place + 3)
    if line.closed:
        first, last = first % n, last % n
    step = line.points[min(last, n - 1)] - line.points[max(first, 0)]
    angle = 2 * np.arctan2(step[1], step[0])
    return np.array([np.cos(angle), np.sin(angle)])


def _bilinear(field: NDArray[np.float32], x: float, y: float) -> Array:
    """Interpolate a field (c, h, w) at a place."""
    column, row = (int(np.clip(v, 0, field.shape[1] - 2)) for v in (x, y))
    dx, dy = x - column, y - row
    part = field[:, row : row + 2, column : column + 2].astype(np.float64)
    return (part * np.outer([1 - dy, dy], [1 - dx, dx])).sum(axis=(1, 2))
