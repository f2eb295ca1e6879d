"""A small network that finds the strands of a rope in a picture without relying on its colours.

It is fully convolutional: a picture of 256 pixels gives fields of 128 cells, so a cell is two
pixels wide. At a crossing two strands share a cell, but not their directions, so the centre lines
are lifted: each cell has ORIENTATIONS channels, and a strand lights that of its own direction. In
these lifted fields strands don't meet (`rope_reader`).

Directions are angles in the picture, x right and y down. A direction without an orientation is
written as the unit vector of twice its angle. `examples/perception/photos.py` trains it.

After a change run `pytest tests/photos/test_rope_reader.py`; weights that ship must still load.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

ORIENTATIONS = 16  # an even number, so that a quarter turn permutes them
CELL = 2  # pixels
# lines and upper strands; networks of earlier versions also have the base bead and its direction
_OUTPUTS = (ORIENTATIONS, 2, 1, 2)
_WIDTHS = (24, 32, 48, 80, 112)  # channels at 1, 1/2, 1/4, 1/8 and 1/16 of the picture's side


class Fields(NamedTuple):
    """What the network returns for n pictures, at half of their side.

    Attributes:
        lines: (n, ORIENTATIONS, h, w), logit that the centre line of a strand, seen or hidden,
            passes here in direction pi k / ORIENTATIONS; at a sharp bend, in all directions between
            those of its sides.
        upper: (n, 2, h, w), direction of the upper strand at a crossing, doubled; shorter than 1
            where it is unsure.
    """

    lines: Tensor
    upper: Tensor


class StrandNetwork(nn.Module):
    """A U-Net of residual blocks; of `outputs` those behind the first 18 are not used."""

    def __init__(self, outputs: int = sum(_OUTPUTS[:2])) -> None:
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
        self.head = nn.Sequential(_Convolution(_WIDTHS[1], 48), nn.Conv2d(48, outputs, 1))
        # at first nearly every cell is predicted to be empty, as nearly every cell is
        nn.init.constant_(self.head[-1].bias, 0.0)
        nn.init.constant_(self.head[-1].bias[:ORIENTATIONS], -4.0)

    def forward(self, pictures: Tensor) -> Fields:
        """Find strands in pictures (n, 3, side, side), levels 0 to 255."""
        return Fields(*self._outputs(pictures)[:2])

    def _outputs(self, pictures: Tensor) -> tuple[Tensor, ...]:
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
        return out.split(_OUTPUTS[: 2 if out.shape[1] == sum(_OUTPUTS[:2]) else 4], 1)

    def signature(self) -> Tensor:
        """Return what the network makes of two oblique stripes."""
        y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        stripes = ((x - 2 * y).abs() < 9) | ((x + y - 60).abs() < 5)
        picture = (200.0 * stripes + x)[None, None].expand(1, 3, -1, -1)
        return torch.cat([part.flatten()[:: part.numel() // 12] for part in self._outputs(picture)])


class _Convolution(nn.Sequential):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.SiLU()
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
