"""A network over the beads of a closed rope: convolutions that run round the loop."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class BeadNetwork(nn.Module):
    """Numbers of every bead to other numbers of every bead, half the beads in between."""

    def __init__(self, inputs: int, outputs: int, width: int, dilations: tuple[int, ...]) -> None:
        super().__init__()
        self.inward = nn.Conv1d(inputs, width, 6, stride=2)
        self.blocks = nn.ModuleList(
            nn.ModuleList([_Round(width, width, 3, dilation), nn.Conv1d(width, width, 1)])
            for dilation in dilations
        )
        self.outward = nn.ConvTranspose1d(width, width // 2, 2, stride=2)
        self.beside = _Round(inputs, width // 2, 3)
        self.last = _Round(width // 2, outputs, 3)

    def forward(self, beads: Tensor) -> Tensor:
        """float32 (n, inputs, beads) to (n, outputs, beads)."""
        x = self.inward(functional.pad(beads, (2, 2), mode="circular"))
        for mix, after in self.blocks:
            x = x + after(functional.relu(mix(functional.relu(x))))
        y = self.outward(functional.relu(x)) + self.beside(beads)
        return self.last(functional.relu(y))


class _Round(nn.Module):
    """A convolution round the loop."""

    def __init__(self, inputs: int, outputs: int, kernel: int, dilation: int = 1) -> None:
        super().__init__()
        self._margin = dilation * (kernel - 1) // 2
        self.convolution = nn.Conv1d(inputs, outputs, kernel, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        padded = functional.pad(x, (self._margin, self._margin), mode="circular")
        return self.convolution(padded)


def grown(network: BeadNetwork, seed: int) -> BeadNetwork:
    """The network with fresh weights of this seed, whatever was drawn before."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        if parameter.dim() > 1:
            fan = parameter[0].numel()
            with torch.no_grad():
                parameter.normal_(0.0, (1.0 / (3.0 * fan)) ** 0.5, generator=generator)
        else:
            nn.init.zeros_(parameter)
    return network
