"""Patch the official TD-MPC2 at run time: the paper's encoder, and devices other than CUDA."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any


def patch(latent_dim: int, device: str) -> None:
    """Patch the official modules; call this before an agent is created."""
    torch = importlib.import_module("torch")
    layers: Any = importlib.import_module("common.layers")
    layers.conv = wider_conv(torch, layers.conv, latent_dim)
    if device != "cuda:0":
        for name in ("tdmpc2", "common.scale", "common.buffer", "trainer.online_trainer"):
            vars(importlib.import_module(name))["torch"] = _TorchOn(torch, device)


def wider_conv(torch: Any, official: Callable[..., Any], latent_dim: int) -> Callable[..., Any]:
    """Extend the official picture encoder as the paper does.

    Adds Conv2d(5, stride 2) + ReLU after its 5 x 5 layer, and a Linear before its last activation.
    """
    nn = torch.nn

    def conv(in_shape: tuple[int, ...], num_channels: int, act: Any = None) -> Any:
        layers = list(official((in_shape[0], 64, 64), num_channels, act))
        kernels = [getattr(layer, "kernel_size", None) for layer in layers]
        behind = kernels.index((5, 5)) + 2  # after the layer's ReLU
        layers[behind:behind] = [nn.Conv2d(num_channels, num_channels, 5, stride=2), nn.ReLU()]
        with torch.no_grad():
            flat = nn.Sequential(*layers[2:-1])(torch.zeros(1, *in_shape)).shape[1]
        layers[-1:-1] = [nn.Linear(flat, latent_dim)]
        return nn.Sequential(_both_halves(torch, layers[0]), *layers[1:])

    return conv


def _both_halves(torch: Any, shift: Any) -> Any:
    """Apply the official augmentation, made for squares, to both halves with the same shift."""

    class BothHalves(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.shift = shift

        def forward(self, pictures: Any) -> Any:
            halves = self.shift(torch.cat(pictures.chunk(2, dim=-1), dim=1))
            return torch.cat(halves.chunk(2, dim=1), dim=-1)

    return BothHalves()


class _TorchOn:
    """A stand-in for torch that maps every device to ours and ignores marks of CUDA graphs.

    The official code hard-codes its device. Off CUDA, the marks would only load an unused compiler.
    """

    def __init__(self, torch: Any, device: str) -> None:
        self._torch, self._device = torch, device
        self.compiler = SimpleNamespace(cudagraph_mark_step_begin=lambda: None)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._torch, name)

    def device(self, _: str) -> Any:
        """Return our device, whatever is requested."""
        return self._torch.device(self._device)
