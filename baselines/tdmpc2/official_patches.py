"""What is changed of the official TD-MPC2 while it runs: its encoder, as the paper tells, and the
device, which it has written into its code.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any


def patch(latent_dim: int, device: str) -> None:
    """Change the official modules, which are imported by now or never."""
    torch = importlib.import_module("torch")
    layers: Any = importlib.import_module("common.layers")
    layers.conv = wider_conv(torch, layers.conv, latent_dim)
    if device != "cuda:0":
        for name in ("tdmpc2", "common.scale", "common.buffer", "trainer.online_trainer"):
            vars(importlib.import_module(name))["torch"] = _TorchOn(torch, device)


def wider_conv(torch: Any, official: Callable[..., Any], latent_dim: int) -> Callable[..., Any]:
    """The official encoder of pictures with one more Conv2d(5, stride 2) + ReLU behind its 5 x 5
    layer, and a Linear before its last activation.
    """
    nn = torch.nn

    def conv(in_shape: tuple[int, ...], num_channels: int, act: Any = None) -> Any:
        layers = list(official((in_shape[0], 64, 64), num_channels, act))
        kernels = [getattr(layer, "kernel_size", None) for layer in layers]
        behind = kernels.index((5, 5)) + 2  # its ReLU too
        layers[behind:behind] = [nn.Conv2d(num_channels, num_channels, 5, stride=2), nn.ReLU()]
        with torch.no_grad():
            flat = nn.Sequential(*layers[2:-1])(torch.zeros(1, *in_shape)).shape[1]
        layers[-1:-1] = [nn.Linear(flat, latent_dim)]
        return nn.Sequential(_both_halves(torch, layers[0]), *layers[1:])

    return conv


def _both_halves(torch: Any, shift: Any) -> Any:
    """The official augmentation, which takes squares, on two of them side by side, moved alike."""

    class BothHalves(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shift = shift

        def forward(self, pictures: Any) -> Any:
            halves = self.shift(torch.cat(pictures.chunk(2, dim=-1), dim=1))
            return torch.cat(halves.chunk(2, dim=1), dim=-1)

    return BothHalves()


class _TorchOn:
    """torch, but for the device that the official code asks for by name, and for the marks of CUDA
    graphs, which elsewhere only load a compiler that nothing is compiled by.
    """

    def __init__(self, torch: Any, device: str) -> None:
        self._torch, self._device = torch, device
        self.compiler = SimpleNamespace(cudagraph_mark_step_begin=lambda: None)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._torch, name)

    def device(self, _: str) -> Any:
        """Ours, whatever is asked for."""
        return self._torch.device(self._device)
