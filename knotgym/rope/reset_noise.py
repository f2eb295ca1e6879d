"""Reset noise: small random perturbations of a configuration, so that episodes start differently.

The noise keeps the rope closed; at reset it also keeps the Gauss code, chirality included.

After a change run `pytest tests/rope/test_reset_noise.py` and `-m slow` there: of 10,000 resets
none may lose its code.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from knotgym.rope.closed_curves import clearance, close_loops
from knotgym.rope.model import Array, Rope
from knotgym.topology import GaussCode, label_many

# Of 1,000 resets of states whose noise survival is 0.25, the least that sets allow, 3 need more
# than FULL_DRAWS (0.75^20); SMALLER_DRAWS end at a millionth of the scale, where no code changes.
FULL_DRAWS = 20  # draws at full scale
SMALLER_DRAWS = 20  # further draws, each at half the scale of the one before
_GAP = 1e-6  # metres; what is closed at all is closed within 1e-12


def start_qpos(
    rope: Rope,
    qpos: Array,
    points: Array,
    codes: Sequence[GaussCode],
    scale: float,
    rngs: Sequence[np.random.Generator],
    least: ArrayLike | None = None,
) -> Array:
    """Perturb the generalized positions of n ropes while keeping their Gauss codes and chirality.

    Noise that changes the code, or that deepens the overlap of two beads by more than 1 mm, is
    rejected and drawn again. After FULL_DRAWS rejections the scale halves with every draw; after
    SMALLER_DRAWS more the positions are returned without noise.

    Args:
        rope: the rope model.
        qpos: float64 (n, nq); not modified.
        points: float64 (n, beads, 3), metres, the vertices of qpos.
        codes: the Gauss codes of points.
        scale: scale of the noise, see `noised`.
        rngs: one for each rope, the source of its draws; not used if the scale is 0.
        least: (n,), `least_clearance` of each rope, if it is known.

    Returns:
        float64 (n, nq), a new array.
    """
    started = np.array(qpos, dtype=np.float64)
    if scale == 0:
        return started
    # a writable array, because numba would compile kernels again for a read-only one
    writable = np.require(points, np.float64, ["C", "W"])
    if least is None:
        least = [least_clearance(one, rope) for one in writable]
    bound = np.asarray(least, dtype=np.float64)
    # All ropes that are left draw at once, but each from its own generator: how often one is
    # refused changes nothing for the others.
    left = list(range(len(writable)))
    for draw in range(FULL_DRAWS + SMALLER_DRAWS):
        if not left:
            break
        reduced = scale * 0.5 ** max(0, draw - FULL_DRAWS + 1)
        moved = noised(writable[left], reduced, [rngs[row] for row in left])
        # much noise may leave a rope that no small correction closes
        # The chords are equal and their directions sum to 0, so the closing chord has a bead's
        # length unless Newton's method in `close_loops` didn't converge.
        gaps = np.linalg.norm(moved[:, 0] - moved[:, -1], axis=1) - rope.config.bead_length
        closed = np.abs(gaps) < _GAP
        moved[~closed] = writable[left][~closed]
        kept = [
            ok and code == codes[row] and clearance(one, bound[row]) >= bound[row]
            for row, one, code, ok in zip(left, moved, label_many(moved), closed, strict=True)
        ]
        taken = np.array(kept)
        started[np.array(left)[taken]] = rope.qpos(moved[taken])
        left = [row for row, fits in zip(left, kept, strict=True) if not fits]
    return started


def least_clearance(points: Array, rope: Rope) -> float:
    """Return how near noise may bring the beads of a rope, float64 (beads, 3), metres.

    Beads at rest may touch or overlap already, so the bound is relative to where they are now;
    beads that are apart may come to touch.
    """
    return clearance(points, 2 * rope.config.radius) - 0.001


def noised(points: ArrayLike, scale: float, rngs: Sequence[np.random.Generator]) -> Array:
    """Perturb every joint of n closed ropes, the whole ropes' orientation and their position.

    Each joint turns by a rotation vector drawn uniformly from [-scale, scale]^3 radians; their sum
    round the loop is subtracted evenly, so that the directions match where the loop closes. The
    whole rope turns by one more such vector and shifts by a vector from [-scale, scale]^3 metres.
    The smallest correction of the bead directions then closes the rope (`close_loops`).

    Args:
        points: float64 (n, beads, 3), metres; not modified.
        scale: scale of the uniform noise, radians and metres.
        rngs: one for each rope; always 3 * beads + 6 draws are taken from it.

    Returns:
        float64 (n, beads, 3), metres, with equal chords and exactly closed.
    """
    p = np.asarray(points, dtype=np.float64)
    beads = p.shape[1]
    # one call draws the same numbers as one for the joints, one for the turn and one for the shift
    drawn = np.array([rng.uniform(-scale, scale, (beads + 2, 3)) for rng in rngs])
    joint, turn, shift = drawn[:, :beads], drawn[:, beads, None], drawn[:, beads + 1, None]
    chord = np.roll(p, -1, axis=1) - p
    lengths = np.linalg.norm(chord, axis=2, keepdims=True)
    # Bead i turns by the sum of the joint rotations up to it. Rotation vectors are added as if they
    # commuted, which holds to first order in the small scale.
    turns = np.cumsum(joint, axis=1)
    # A Brownian bridge: the sum goes back to zero at the last bead, where the loop closes.
    turns -= ((np.arange(beads) + 1) / beads)[:, None] * turns[:, -1:]
    # The mean rotation is the whole rope's; take it out, so that `turn` alone decides it.
    turns += turn - turns.mean(axis=1, keepdims=True)
    along = np.ascontiguousarray(_rotate(chord / lengths, turns))
    close_loops(along)
    moved = np.zeros_like(p)
    np.cumsum(along[:, :-1], axis=1, out=moved[:, 1:])
    moved *= np.median(lengths, axis=1, keepdims=True)
    return moved - moved.mean(axis=1, keepdims=True) + p.mean(axis=1, keepdims=True) + shift


def _rotate(vectors: Array, by: Array) -> Array:
    """Rotate vectors (..., 3) by rotation vectors (..., 3), radians (Rodrigues' formula)."""
    angle = np.linalg.norm(by, axis=-1, keepdims=True)
    axis = by / np.maximum(angle, 1e-100)
    along = axis * (axis * vectors).sum(axis=-1, keepdims=True)
    return along + (vectors - along) * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle)
