"""The loss by which `photos.py train` trains the network that reads photos.

Lines are drawn into lifted fields: each cell has channels for directions, and a strand lights that
of its own direction (`knotgym.photos.StrandNetwork`).
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

from knotgym.photos import StrandNetwork

ORIENTATIONS, CELL = 16, 2  # channels of the lifted fields; pixels of a cell
# Values below were set by hand; no record says what others would score.
_SIGMA, _TAU = 0.9, math.radians(9.0)  # widths of responses, cells and radians
_RARE = 9.0  # extra weight of cells with a full response, of which there are few
_FEW = 1000.0  # full responses that are counted at least, for pictures without a rope
_REACH = 2  # cells around a line or a crossing
_NEAR = 1.5  # width of the weight at a crossing, cells
_UPPER = 2.0  # weight of the loss of upper strands


def strand_loss(
    network: StrandNetwork, pictures: Tensor, line: Tensor, crossings: Tensor
) -> Tensor:
    """Return the mean loss of n pictures; places are in pixels, x right and y down.

    Args:
        network: in training.
        pictures: float32 (n, 3, side, side), levels 0 to 255.
        line: float32 (n, m, 3), places evenly along the lines of ropes, and whether a line leads
            from here to the next, 1 or 0; the last leads to the first.
        crossings: float32 (n, c, 5): place, cosine and sine of twice the angle of the upper
            strand, and 1; rows of zeros where there are fewer.
    """
    fields = network(pictures)
    lines = fields.lines.float()
    side = lines.shape[-1]
    wanted = lifted_lines(line, side)
    each = functional.binary_cross_entropy_with_logits(lines, wanted, reduction="none")
    # nearly all responses are 0; the mean is for each full one
    loss = ((1 + _RARE * wanted) * each).sum() / wanted.sum().clamp(min=_FEW)
    places, share = _window(crossings[..., :2], side)
    share = share * crossings[..., 4:]
    cells = places.flatten(1)[:, None].expand(-1, 2, -1)
    found = fields.upper.float().flatten(2).gather(2, cells).view(len(lines), 2, *places.shape[1:])
    off = (found - crossings[..., 2:4].transpose(1, 2)[..., None]).square().sum(1)
    return loss + _UPPER * (share * off).sum() / share.sum().clamp(min=1)


def lifted_lines(line: Tensor, side: int) -> Tensor:
    """Draw lines (n, m, 3) into lifted fields, float32 (n, ORIENTATIONS, side, side), in [0, 1].

    At a sharp bend all directions between those of its sides are lit, so that the line doesn't
    break there.
    """
    at, joined = line[..., :2] / CELL - 0.5, line[..., 2]
    step = at.roll(-1, 1) - at
    angle = torch.atan2(step[..., 1], step[..., 0])
    turn = (angle.roll(-1, 1) - angle + math.pi) % (2 * math.pi) - math.pi
    turn = turn * joined * joined.roll(-1, 1)
    # a piece has the directions from half of the turn before it to half of the turn after it
    middle, half = angle + 0.25 * (turn - turn.roll(1, 1)), 0.25 * (turn + turn.roll(1, 1)).abs()
    x, y, places, inside = _cells(at + 0.5 * step, side, _REACH)
    # squared distance of cells from the piece, which begins at `at`
    dx, dy = x - at[..., 0, None], y - at[..., 1, None]
    length = step.norm(dim=2, keepdim=True).clamp(min=1e-6)
    along = (dx * step[..., :1] + dy * step[..., 1:]) / length.square()
    along = along.clamp(0, 1)
    square = (dx - along * step[..., :1]).square() + (dy - along * step[..., 1:]).square()
    near = torch.exp(-square / (2 * _SIGMA**2)) * inside * joined[..., None]
    layers = torch.arange(ORIENTATIONS, device=line.device)
    off = layers * (math.pi / ORIENTATIONS) - middle[..., None]
    off = ((off + math.pi / 2) % math.pi - math.pi / 2).abs()
    alike = torch.exp(-(off - half[..., None]).clamp(min=0).square() / (2 * _TAU**2))
    index = layers[:, None] * side**2 + places[:, :, None]
    value = alike[..., None] * near[:, :, None]
    out = torch.zeros(len(line), ORIENTATIONS * side**2, device=line.device)
    out.scatter_reduce_(1, index.flatten(1), value.flatten(1), "amax")
    return out.view(len(line), ORIENTATIONS, side, side)


def _window(at: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Return the cells around places (n, k, 2), int64 (n, k, w), and how much they count."""
    at = at / CELL - 0.5
    x, y, places, inside = _cells(at, side, _REACH)
    square = (x - at[..., 0, None]).square() + (y - at[..., 1, None]).square()
    return places, torch.exp(-square / (2 * _NEAR**2)) * inside


def _cells(at: Tensor, side: int, reach: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the cells around places (n, k, 2), in cells: x, y, index and whether in the field."""
    off = torch.arange(-reach, reach + 1, device=at.device)
    y, x = (one.flatten() for one in torch.meshgrid(off, off, indexing="ij"))
    x, y = at[..., 0, None].round() + x, at[..., 1, None].round() + y
    inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    places = y.long().clamp(0, side - 1) * side + x.long().clamp(0, side - 1)
    return x, y, places, inside
