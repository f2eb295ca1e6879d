"""The learner keeps several hypotheses of the rope's shape; motion tells them apart."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.learn.colour_reading import BEADS
from knotgym.learn.shape_hypotheses import MOST_IMAGINED, ShapeHypotheses, imagine
from knotgym.rope import ChainSimulation, Rope

pytestmark = pytest.mark.clients
Array = NDArray[np.float64]


class TwoReadings:
    """Read every picture as the true rope and as its mirror image, equally likely."""

    def __init__(self, rope: Array) -> None:
        self.rope = rope

    def read(self, picture: Any) -> tuple[Array, Array]:
        mirrored = self.rope * (1.0, 1.0, -1.0)
        return np.stack([mirrored, self.rope]), np.array([0.5, 0.5])

    def perturb(self, picture: Any, ropes: Array, count: int, rng: Any) -> Array:
        return np.repeat(ropes, count, axis=0)

    def follow(self, picture: Any, predicted: Array, moves: Array) -> Array:
        followed = predicted.copy()
        followed[..., :2] = self.rope[:, :2]
        return followed


def tilted_loop() -> Array:
    """Return a circle tilted out of the plane, so that its mirror image differs."""
    angle = 2 * np.pi * np.arange(BEADS) / BEADS
    return Rope().from_curve(np.stack([np.cos(angle), np.sin(angle), 0.5 * np.cos(angle)], axis=1))


@pytest.fixture
def tracked() -> tuple[ShapeHypotheses, TwoReadings]:
    """Return hypotheses and the reader that they use."""
    reader: Any = TwoReadings(tilted_loop())
    rng = np.random.default_rng(0)
    chain = ChainSimulation(MOST_IMAGINED)
    return ShapeHypotheses(reader, chain, np.zeros((1, 3)), rng), reader


def test_motion_tells_a_rope_from_its_mirror(tracked: tuple[ShapeHypotheses, TwoReadings]) -> None:
    hypotheses, reader = tracked
    picture = np.zeros((128, 128, 3), dtype=np.uint8)
    hypotheses._start(picture)
    chain = ChainSimulation(1)
    rope, speeds, force = tilted_loop()[None], np.zeros((1, BEADS, 3)), np.array([0.3, 0.2, 0.8])
    for _ in range(3):
        named = hypotheses.ropes[0][25] + hypotheses.position.positions.mean(axis=0)
        bead = np.linalg.norm(rope[0] - named, axis=1).argmin()
        rope, speeds = imagine(chain, rope, speeds, np.array([bead]), force[None])
        reader.rope = rope[0] - rope[0].mean(axis=0)
        hypotheses._update(picture, named, force)
    likeliest, true = hypotheses.ropes[0], tilted_loop()
    off, mirrored = (np.abs(likeliest[:, 2] - sign * true[:, 2]).mean() for sign in (1, -1))
    assert off < mirrored and hypotheses.weights[0] > 0.5
    assert np.isclose(hypotheses.weights.sum(), 1.0)
