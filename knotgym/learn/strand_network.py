"""A small network that finds the strands of a rope in a picture without relying on its colours.

It is fully convolutional: a picture of 256 pixels gives fields of 128 cells, so a cell is two
pixels wide. At a crossing two strands share a cell, but not their directions, so the centre lines
are lifted: each cell has ORIENTATIONS channels, and a strand lights that of its own direction. In
these lifted fields strands don't meet (`strand_walk`).

Directions are angles in the picture, x right and y down. A direction without an orientation is
written as the unit vector of twice its angle.

After a change run `pytest tests/learn/test_rope_reader.py`; weights that ship must still load.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

ORIENTATIONS = 16  # an even number, so that a quarter turn permutes them
CELL = 2  # pixels
_WIDTHS = (24, 32, 48, 80, 112)  # channels at 1, 1/2, 1/4, 1/8 and 1/16 of the picture's side
# Values below were set by hand; no record says what others would score.
_SIGMA, _TAU = 0.9, math.radians(9.0)  # widths of responses, cells and radians
_RARE = 9.0  # extra weight of cells with a full response, of which there are few
_REACH = 2  # cells around a line or a crossing
_BASE = 1.5  # width of the response at the base, cells
_UPPER, _ALONG = 2.0, 0.5  # weights of the losses of directions


class Fields(NamedTuple):
    """What the network returns for n pictures, at half of their side.

    Attributes:
        lines: (n, ORIENTATIONS, h, w), logit that the centre line of a strand, seen or hidden,
            passes here in direction pi k / ORIENTATIONS; at a sharp bend, in all directions between
            those of its sides.
        upper: (n, 2, h, w), direction of the upper strand at a crossing, doubled; shorter than 1
            where it is unsure.
        base: (n, h, w), logit that the white base bead is here.
        along: (n, 2, h, w), direction in which the rope leaves the base bead.
    """

    lines: Tensor
    upper: Tensor
    base: Tensor
    along: Tensor


class StrandNetwork(nn.Module):
    """A U-Net of residual blocks."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _Convolution(3, _WIDTHS[0])
        self.down, self.encode, self.decode, self.up = (nn.ModuleList() for _ in range(4))
        for above, width in zip(_WIDTHS, _WIDTHS[1:], strict=False):
            self.down.append(_Convolution(above, width, stride=2))
            self.encode.append(_Block(width))
        self.bottom = _Block(_WIDTHS[-1], dilation=2)
        for above, width in zip(_WIDTHS[1:], _WIDTHS[2:], strict=False):
            self.up.append(nn.Conv2d(width, above, 1))
            self.decode.append(_Block(above))
        self.head = nn.Sequential(_Convolution(_WIDTHS[1], 48), nn.Conv2d(48, ORIENTATIONS + 5, 1))
        # at first nearly every cell is predicted to be empty, as nearly every cell is
        nn.init.constant_(self.head[-1].bias, 0.0)
        nn.init.constant_(self.head[-1].bias[:ORIENTATIONS], -4.0)
        nn.init.constant_(self.head[-1].bias[ORIENTATIONS + 2], -4.0)

    def forward(self, pictures: Tensor) -> Fields:
        """Find strands in pictures (n, 3, side, side), levels 0 to 255."""
        # exposure and tint say nothing about the rope
        mean = pictures.mean(dim=(2, 3), keepdim=True)
        deviation = pictures.std(dim=(1, 2, 3), keepdim=True)
        x = self.stem((pictures - mean) / (deviation + 4.0))
        levels = []
        for down, encode in zip(self.down, self.encode, strict=True):
            x = encode(down(x))
            levels.append(x)
        x = self.bottom(levels.pop())
        for up, decode in zip(reversed(self.up), reversed(self.decode), strict=True):
            wide = functional.interpolate(
                up(x), scale_factor=2, mode="bilinear", align_corners=False
            )
            x = decode(wide + levels.pop())
        out = self.head(x)
        k = ORIENTATIONS
        upper, base, along = out[:, k:].split((2, 1, 2), 1)
        return Fields(out[:, :k], upper, base[:, 0], along)

    def signature(self) -> Tensor:
        """Return what the network makes of two oblique stripes."""
        y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        stripes = ((x - 2 * y).abs() < 9) | ((x + y - 60).abs() < 5)
        picture = (200.0 * stripes + x)[None, None].expand(1, 3, -1, -1)
        return torch.cat([part.flatten()[:: part.numel() // 12] for part in self(picture)])

    def loss(self, pictures: Tensor, line: Tensor, crossings: Tensor, base: Tensor) -> Tensor:
        """Return the mean loss of n pictures; places are in pixels, x right and y down.

        Args:
            pictures: float32 (n, 3, side, side), levels 0 to 255.
            line: float32 (n, m, 2), places evenly along the closed line of the rope.
            crossings: float32 (n, c, 5): place, cosine and sine of twice the angle of the upper
                strand, and 1; rows of zeros where there are fewer.
            base: float32 (n, 5): place of the base bead, unit direction of the walk there, and 1 if
                it is seen; zeros if it isn't marked.
        """
        fields = self(pictures)
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


class _Convolution(nn.Sequential):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.SiLU(),
        )


class _Block(nn.Module):
    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, 1, dilation, dilation, bias=False)
        self.second = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.norms = nn.ModuleList([nn.BatchNorm2d(width), nn.BatchNorm2d(width)])

    def forward(self, x: Tensor) -> Tensor:
        inner = functional.silu(self.norms[0](self.first(x)))
        return functional.silu(x + self.norms[1](self.second(inner)))


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
