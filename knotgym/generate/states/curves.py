"""Closed curves that begin a rope: knots, a few by formula, any other from a file; and plain loops
of any shape.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from knotgym.common.configuration import check_numbers
from knotgym.common.errors import KnotgymError
from knotgym.quality.measures import Limits, measure
from knotgym.rope.model import Array, InvalidCurve, Rope
from knotgym.topology.crossings import label
from knotgym.topology.knots import knot_type

_SAMPLES = 600


class InvalidCurveFile(KnotgymError, ValueError):
    """A file that holds no closed curve, or a name that no formula is known for."""


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How plain loops are shaped: as sums of waves round the loop, drawn at random.

    Attributes:
        waves: the shortest of which goes so often round the loop.
        falling: power by which a shorter wave is weaker, from and to; one draw a loop. The weaker,
            the rounder.
        height: of waves along z, of those along x and y, from and to; one draw a loop.
        draws: at most; then it is a circle.
    """

    waves: int = 3
    falling: tuple[float, float] = (0.0, 3.0)
    height: tuple[float, float] = (0.0, 0.5)
    draws: int = 400

    def __post_init__(self) -> None:
        check_numbers(self, counts=("waves", "draws"), ranges=("falling", "height"))


def plain_loop(rope: Rope, config: LoopConfig, limits: Limits, rng: np.random.Generator) -> Array:
    """A bent, long, folded or tilted loop without crossings, legible: float64 (beads, 3)."""
    turn = np.linspace(0, 2 * np.pi, _SAMPLES, endpoint=False)
    wave = np.arange(1, config.waves + 1)
    phase = wave[:, None] * turn
    falling, height = rng.uniform(*config.falling), rng.uniform(*config.height)
    scale = wave[:, None] ** -falling * np.array([1.0, 1.0, height])
    for _ in range(config.draws):
        cosines, sines = rng.normal(size=(2, config.waves, 3)) * scale
        try:
            points = rope.from_curve(np.cos(phase).T @ cosines + np.sin(phase).T @ sines)
        except InvalidCurve:
            continue
        if not label(points).nx and not limits.faults(measure(points), 0):
            return points
    return rope.loop()


def torus_knot(p: int, q: int) -> Array:
    """The (p, q) torus knot, p times round the axis: float64 (n, 3), closed by its first point."""
    t = np.linspace(0, 2 * np.pi, _SAMPLES, endpoint=False)
    radius = 2 + 0.9 * np.cos(q * t)
    return np.stack([radius * np.cos(p * t), radius * np.sin(p * t), 0.9 * np.sin(q * t)], axis=1)


def figure_eight_knot() -> Array:
    """The figure-eight knot, 4_1: float64 (n, 3)."""
    t = np.linspace(0, 2 * np.pi, _SAMPLES, endpoint=False)
    radius = 2 + np.cos(2 * t)
    return np.stack([radius * np.cos(3 * t), radius * np.sin(3 * t), np.sin(4 * t)], axis=1)


KNOTS: dict[str, Callable[[], Array]] = {
    "3_1": lambda: torus_knot(2, 3),
    "4_1": figure_eight_knot,
    "5_1": lambda: torus_knot(2, 5),
}


def knot_curve(knot: str) -> Array:
    """A closed curve (n, 3) of a knot type.

    Args:
        knot: its name ("3_1"), or a file: .npy, or text with three numbers a line.

    Raises:
        InvalidCurveFile: neither.
    """
    if knot in KNOTS:
        return KNOTS[knot]()
    path = Path(knot)
    if not path.is_file():
        raise InvalidCurveFile(
            f"no knot {knot!r}; there is 0_1, {', '.join(KNOTS)}, or a file with a closed curve,"
            " three numbers a line or .npy; more knots go with --source drawing"
        )
    try:
        with warnings.catch_warnings(action="error"):  # NumPy only warns of a text without numbers
            if path.suffix == ".npy":
                curve = np.load(path, mmap_mode="r", allow_pickle=False)
            else:
                curve = np.loadtxt(path, delimiter="," if path.suffix == ".csv" else None)
    except (ValueError, OSError, EOFError, OverflowError, MemoryError, UserWarning) as error:
        raise InvalidCurveFile(f"{path} holds no curve: {' '.join(str(error).split())}") from error
    if not isinstance(curve, np.ndarray) or curve.dtype.kind not in "fiu":
        raise InvalidCurveFile(f"{path} holds no curve: it isn't one array of real numbers")
    return np.asarray(curve, dtype=np.float64)


def knot_of(knot: str | os.PathLike[str]) -> str:
    """The certified type of a named knot or a file's curve, "unknown" if it isn't certified.

    Raises:
        InvalidCurveFile, InvalidCurve: it can't be a rope.
    """
    return knot_type(label(Rope().from_curve(knot_curve(os.fspath(knot)))))
