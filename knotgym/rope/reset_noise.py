"""Noise at reset: a configuration shaken a little, so that no two episodes begin alike.

The noise keeps the rope closed; at reset it also keeps the Gauss code, chirality included.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from knotgym.rope.model import Array, Rope, clearance, closed_directions
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

FULL_DRAWS = 20  # at full scale; then the scale halves with every further draw
SMALLER_DRAWS = 20


def start_qpos(
    rope: Rope,
    qpos: Array,
    points: Array,
    code: GaussCode,
    scale: float,
    rng: np.random.Generator,
) -> Array:
    """Generalized positions shaken by noise that keeps their Gauss code, chirality included.

    A draw that changes the code, or presses two beads more than 1 mm further into each other than
    they were, is drawn again; after FULL_DRAWS draws the noise shrinks, and ends at none.

    Args:
        rope: that lies there.
        qpos: float64 (nq,); left alone.
        points: float64 (beads, 3), metres, of qpos.
        code: what it shows.
        scale: of the noise, see `noised`.
        rng: every draw comes from it; none where the scale is 0.

    Returns:
        float64 (nq,), a new array.
    """
    if scale == 0:
        return qpos.copy()
    free = clearance(
        np.require(points, np.float64, ["C", "W"])
    )  # else compiled anew for read-only ones
    least = min(free, 2 * rope.config.radius) - 0.001
    for draw in range(FULL_DRAWS + SMALLER_DRAWS):
        moved = noised(points, scale * 0.5 ** max(0, draw - FULL_DRAWS + 1), rng)
        if clearance(moved) >= least and label(moved) == code:
            return rope.qpos(moved)
    return qpos.copy()


def noised(points: ArrayLike, scale: float, rng: np.random.Generator) -> Array:
    """Move every joint of a closed rope a little and keep it closed.

    The 100 joints turn by rotation vectors drawn uniformly from [-scale, scale]^3 radians (their
    sum round the loop taken out evenly, so that the ends meet in direction), the whole rope turns
    by one more such vector and shifts by [-scale, scale]^3 metres; the least change of the bead
    directions that makes the ends meet in place is added.

    Args:
        points: float64 (beads, 3), metres; left alone.
        scale: of the uniform noise, radians and metres.
        rng: three hundred and six draws at 100 beads are taken from it, whatever happens.

    Returns:
        float64 (beads, 3), equal chords, exactly closed.
    """
    p = np.asarray(points, dtype=np.float64)
    beads = len(p)
    joint = rng.uniform(-scale, scale, (beads, 3))
    turn = rng.uniform(-scale, scale, 3)
    shift = rng.uniform(-scale, scale, 3)
    chord = np.roll(p, -1, axis=0) - p
    length = np.median(np.linalg.norm(chord, axis=1))
    wander = np.cumsum(joint, axis=0)
    wander -= np.outer((np.arange(beads) + 1) / beads, wander[-1])
    wander += turn - wander.mean(axis=0)
    along = closed_directions(_rotate(chord / np.linalg.norm(chord, axis=1, keepdims=True), wander))
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(along[:-1], axis=0)]) * length
    return moved - moved.mean(axis=0) + p.mean(axis=0) + shift


def _rotate(vectors: Array, by: Array) -> Array:
    """Rotate each vector (n, 3) by its rotation vector (n, 3), radians (Rodrigues)."""
    angle = np.linalg.norm(by, axis=1, keepdims=True)
    axis = by / np.maximum(angle, 1e-100)
    along = axis * (axis * vectors).sum(axis=1, keepdims=True)
    return along + (vectors - along) * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle)
