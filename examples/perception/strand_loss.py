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
_REACH = 2  # cells around a line or a crossing
_BASE = 1.5  # width of the response at the base, cells
_UPPER, _ALONG = 2.0, 0.5  # weights of the losses of directions


def strand_loss(
    network: StrandNetwork, pictures: Tensor, line: Tensor, crossings: Tensor, base: Tensor
) -> Tensor:
    """Return the mean loss of n pictures; places are in pixels, x right and y down.

    Args:
        network: in training.
        pictures: float32 (n, 3, side, side), levels 0 to 255.
        line: float32 (n, m, 2), places evenly along the closed line of the rope.
        crossings: float32 (n, c, 5): place, cosine and sine of twice the angle of the upper
            strand, and 1; rows of zeros where there are fewer.
        base: float32 (n, 5): place of the base bead, unit direction of the walk there, and 1 if
            it is seen; zeros if it isn't marked.
    """
    fields = network(pictures)
    lines, bases = fields.lines.float(), fields.base.float()
    side = lines.shape[-1]
    wanted = lifted_lines(line, side)
    loss = _sparse_loss(lines, wanted, wanted.sum())
    seen = base[:, None, 4:]
    places, share = _window(base[:, None, :2], side, 2 * _REACH, _BASE)
    wanted = torch.zeros_like(bases).flatten(1)
    wanted.scatter_reduce_(1, places[:, 0], (share * seen)[:, 0], "amax")
    loss = loss + _sparse_loss(bases, wanted.view_as(bases), wanted.sum() + 5 * len(bases))
    pairs = ((fields.upper, crossings, _UPPER), (fields.along, base[:, None], _ALONG))
    for field, rows, weight in pairs:
        places, share = _window(rows[..., :2], side, _REACH, _BASE)
        share = share * rows[..., 4:]
        each = places.flatten(1)[:, None].expand(-1, 2, -1)
        found = field.float().flatten(2).gather(2, each).view(len(rows), 2, *places.shape[1:])
        off = (found - rows[..., 2:4].transpose(1, 2)[..., None]).square().sum(1)
        loss = loss + weight * (share * off).sum() / share.sum().clamp(min=1)
    return loss


def lifted_lines(line: Tensor, side: int) -> Tensor:
    """Draw lines (n, m, 2) into lifted fields, float32 (n, ORIENTATIONS, side, side), in [0, 1].

    At a sharp bend all directions between those of its sides are lit, so that the line doesn't
    break there.
    """
    at = line / CELL - 0.5
    step = at.roll(-1, 1) - at
    angle = torch.atan2(step[..., 1], step[..., 0])
    turn = (angle.roll(-1, 1) - angle + math.pi) % (2 * math.pi) - math.pi
    # a piece has the directions from half of the turn before it to half of the turn after it
    middle, half = angle + 0.25 * (turn - turn.roll(1, 1)), 0.25 * (turn + turn.roll(1, 1)).abs()
    x, y, places, inside = _cells(at + 0.5 * step, side, _REACH)
    # squared distance of cells from the piece, which begins at `at`
    dx, dy = x - at[..., 0, None], y - at[..., 1, None]
    length = step.norm(dim=2, keepdim=True).clamp(min=1e-6)
    along = (dx * step[..., :1] + dy * step[..., 1:]) / length.square()
    along = along.clamp(0, 1)
    square = (dx - along * step[..., :1]).square() + (dy - along * step[..., 1:]).square()
    near = torch.exp(-square / (2 * _SIGMA**2)) * inside
    layers = torch.arange(ORIENTATIONS, device=line.device)
    off = layers * (math.pi / ORIENTATIONS) - middle[..., None]
    off = ((off + math.pi / 2) % math.pi - math.pi / 2).abs()
    alike = torch.exp(-(off - half[..., None]).clamp(min=0).square() / (2 * _TAU**2))
    index = layers[:, None] * side**2 + places[:, :, None]
    value = alike[..., None] * near[:, :, None]
    out = torch.zeros(len(line), ORIENTATIONS * side**2, device=line.device)
    out.scatter_reduce_(1, index.flatten(1), value.flatten(1), "amax")
    return out.view(len(line), ORIENTATIONS, side, side)


def _sparse_loss(logits: Tensor, wanted: Tensor, count: Tensor) -> Tensor:
    """Return the cross-entropy of responses, nearly all of which are 0, for each full one."""
    each = functional.binary_cross_entropy_with_logits(logits, wanted, reduction="none")
    return ((1 + _RARE * wanted) * each).sum() / count


def _window(at: Tensor, side: int, reach: int, width: float) -> tuple[Tensor, Tensor]:
    """Return the cells around places (n, k, 2), int64 (n, k, w), and how much they count."""
    at = at / CELL - 0.5
    x, y, places, inside = _cells(at, side, reach)
    square = (x - at[..., 0, None]).square() + (y - at[..., 1, None]).square()
    return places, torch.exp(-square / (2 * width**2)) * inside


def _cells(at: Tensor, side: int, reach: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the cells around places (n, k, 2), in cells: x, y, index and whether in the field."""
    off = torch.arange(-reach, reach + 1, device=at.device)
    y, x = (one.flatten() for one in torch.meshgrid(off, off, indexing="ij"))
    x, y = at[..., 0, None].round() + x, at[..., 1, None].round() + y
    inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
    places = y.long().clamp(0, side - 1) * side + x.long().clamp(0, side - 1)
    return x, y, places, inside
