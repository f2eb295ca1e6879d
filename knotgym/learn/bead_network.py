"""A convolutional network over the beads of a closed rope, with circular padding.

After a change run what `shape_hypotheses` says; weights that ship must still load.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional


class BeadNetwork(nn.Module):
    """A residual network from per-bead inputs to per-bead outputs, at half resolution inside."""

    def __init__(self, inputs: int, outputs: int, width: int, dilations: tuple[int, ...]) -> None:
        super().__init__()
        # names of modules are keys of stored weights, so a rename breaks checkpoints
        self.inward = nn.Conv1d(inputs, width, 6, stride=2)
        self.blocks = nn.ModuleList(
            nn.ModuleList(
                [_CircularConvolution(width, width, 3, dilation), nn.Conv1d(width, width, 1)]
            )
            for dilation in dilations
        )
        self.outward = nn.ConvTranspose1d(width, width // 2, 2, stride=2)
        # at full resolution, past the blocks
        self.beside = _CircularConvolution(inputs, width // 2, 3)
        self.last = _CircularConvolution(width // 2, outputs, 3)

    def forward(self, beads: Tensor) -> Tensor:
        """Map float32 (n, inputs, beads) to float32 (n, outputs, beads)."""
        # kernel 6 and stride 2 need two beads of padding on either side to halve the beads exactly
        x = self.inward(functional.pad(beads, (2, 2), mode="circular"))
        for mix, after in self.blocks:
            x = x + after(functional.relu(mix(functional.relu(x))))
        # the skip connection `beside` brings back what halving the resolution lost
        y = self.outward(functional.relu(x)) + self.beside(beads)
        return self.last(functional.relu(y))


class _CircularConvolution(nn.Module):
    """A convolution with circular padding that keeps the number of beads."""

    def __init__(self, inputs: int, outputs: int, kernel: int, dilation: int = 1) -> None:
        super().__init__()
        # as much on either side as keeps the number of beads; odd kernels only
        self._margin = dilation * (kernel - 1) // 2
        self.convolution = nn.Conv1d(inputs, outputs, kernel, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        padded = functional.pad(x, (self._margin, self._margin), mode="circular")
        return self.convolution(padded)


def initialize(network: BeadNetwork, seed: int) -> BeadNetwork:
    """Reset a network's weights in place from a seed, independently of torch's global generator."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        if parameter.dim() > 1:
            # variance 1 / (3 fan-in), that of torch's default initialization, but normal; biases 0
            fan = parameter[0].numel()
            with torch.no_grad():
                parameter.normal_(0.0, (1.0 / (3.0 * fan)) ** 0.5, generator=generator)
        else:
            nn.init.zeros_(parameter)
    return network
