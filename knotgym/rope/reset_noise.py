"""Reset noise: small random perturbations of a configuration, so that episodes start differently.

The noise keeps the rope closed; at reset it also keeps the Gauss code, chirality included.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from knotgym.rope.model import Array, Rope, clearance, closed_directions
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode

FULL_DRAWS = 20  # draws at full scale
SMALLER_DRAWS = 20  # further draws, each at half the scale of the one before


def start_qpos(
    rope: Rope,
    qpos: Array,
    points: Array,
    code: GaussCode,
    scale: float,
    rng: np.random.Generator,
) -> Array:
    """Perturb generalized positions while keeping the Gauss code, chirality included.

    Noise that changes the code, or that deepens the overlap of two beads by more than 1 mm, is
    rejected and drawn again. After FULL_DRAWS rejections the scale halves with every draw; after
    SMALLER_DRAWS more the positions are returned without noise.

    Args:
        rope: the rope model.
        qpos: float64 (nq,); not modified.
        points: float64 (beads, 3), metres, the vertices of qpos.
        code: the Gauss code of points.
        scale: scale of the noise, see `noised`.
        rng: source of every draw; not used if the scale is 0.

    Returns:
        float64 (nq,), a new array.
    """
    if scale == 0:
        return qpos.copy()
    # a writable array, because numba would compile `clearance` again for a read-only one
    writable = np.require(points, np.float64, ["C", "W"])
    # Beads at rest may touch or overlap already, so the bound is relative to where they are now;
    # beads that are apart may come to touch.
    min_clearance = min(clearance(writable), 2 * rope.config.radius) - 0.001
    for draw in range(FULL_DRAWS + SMALLER_DRAWS):
        moved = noised(points, scale * 0.5 ** max(0, draw - FULL_DRAWS + 1), rng)
        if clearance(moved) >= min_clearance and label(moved) == code:
            return rope.qpos(moved)
    return qpos.copy()


def noised(points: ArrayLike, scale: float, rng: np.random.Generator) -> Array:
    """Perturb every joint of a closed rope, the whole rope's orientation and its position.

    Each joint turns by a rotation vector drawn uniformly from [-scale, scale]^3 radians; their sum
    round the loop is subtracted evenly, so that the directions match where the loop closes. The
    whole rope turns by one more such vector and shifts by a vector from [-scale, scale]^3 metres.
    The smallest correction of the bead directions then closes the rope (`closed_directions`).

    Args:
        points: float64 (beads, 3), metres; not modified.
        scale: scale of the uniform noise, radians and metres.
        rng: always 3 * beads + 6 draws are taken from it.

    Returns:
        float64 (beads, 3), metres, with equal chords and exactly closed.
    """
    p = np.asarray(points, dtype=np.float64)
    beads = len(p)
    joint = rng.uniform(-scale, scale, (beads, 3))
    turn = rng.uniform(-scale, scale, 3)
    shift = rng.uniform(-scale, scale, 3)
    chord = np.roll(p, -1, axis=0) - p
    length = np.median(np.linalg.norm(chord, axis=1))
    # Bead i turns by the sum of the joint rotations up to it. Rotation vectors are added as if they
    # commuted, which holds to first order in the small scale.
    turns = np.cumsum(joint, axis=0)
    # A Brownian bridge: the sum goes back to zero at the last bead, where the loop closes.
    turns -= np.outer((np.arange(beads) + 1) / beads, turns[-1])
    # The mean rotation is the whole rope's; take it out, so that `turn` alone decides it.
    turns += turn - turns.mean(axis=0)
    along = closed_directions(_rotate(chord / np.linalg.norm(chord, axis=1, keepdims=True), turns))
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(along[:-1], axis=0)]) * length
    return moved - moved.mean(axis=0) + p.mean(axis=0) + shift


def _rotate(vectors: Array, by: Array) -> Array:
    """Rotate each vector (n, 3) by its rotation vector (n, 3), radians (Rodrigues' formula)."""
    angle = np.linalg.norm(by, axis=1, keepdims=True)
    axis = by / np.maximum(angle, 1e-100)
    along = axis * (axis * vectors).sum(axis=1, keepdims=True)
    return along + (vectors - along) * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle)
