"""Relaxation without physics: spread strands in the picture and straighten bends.

The Gauss code is kept. The result is a configuration that the rope could take, without actions that
lead to it, at a thousandth of the cost of simulation. Each iteration

1. straightens bends,
2. pushes apart vertices of different strands that are close in the picture,
3. separates the two strands of each crossing in height,
4. restores the length of every bead by projection.

Source of step 4: position-based dynamics, Müller et al., 2007.

After a change run `pytest tests/rope/test_rope.py`: a relaxed curve must keep its code, and all
of its edges get the length of a bead.
"""

from dataclasses import astuple

import numba
import numpy as np

from knotgym.common.configuration import Count, NonNegative, Positive, configuration
from knotgym.common.errors import InvalidInput
from knotgym.rope.model import Array, Rope
from knotgym.topology.crossings import label


@configuration
class RelaxationConfig:
    """Settings of one round of relaxation.

    Attributes:
        iterations: iterations per round.
        reach: distance in the picture within which strands repel each other, metres; 0.045 is
            nine pixels.
        apart: vertices fewer than this many beads apart along the rope don't repel each other.
        push: largest repulsion per iteration, bead lengths, of strands at distance 0.
        bending: coefficient of the straightening step per iteration.
        crossing: distance in the picture within which two strands count as crossing, bead
            lengths.
        height: target difference in height between crossing strands, metres.
        lifting: fraction of the missing height by which each of the two strands moves per
            iteration.
        most: largest displacement of a vertex per iteration along each axis, bead lengths.
        passes: projection sweeps over the beads per iteration.
    """

    iterations: Count = 20
    reach: Positive = 0.045
    apart: Count = 5
    push: NonNegative = 0.012
    bending: NonNegative = 0.03
    crossing: NonNegative = 1.5
    height: NonNegative = 0.0125
    lifting: NonNegative = 0.25
    most: Positive = 0.15
    passes: Count = 8


def relaxed(points: Array, rounds: int, rope: Rope, config: RelaxationConfig) -> Array | None:
    """Relax a configuration.

    Args:
        points: float64 (beads, 3), metres; not modified.
        rounds: number of rounds, at least 1; relaxation stops before the first round that would
            change the code.
        rope: supplies the bead length and the limit on overlap.
        config: settings of a round.

    Returns:
        float64 (beads, 3), metres, a configuration of the rope with the code of `points`; None if
        the first round changes the code or the result is no valid configuration.

    Raises:
        InvalidInput: fewer than 1 round.
    """
    if rounds < 1:
        raise InvalidInput(f"rounds must be at least 1, got {rounds}")
    code = label(points)
    moving, last = np.array(points, dtype=np.float64), None
    for _ in range(rounds):
        _iterate(moving, rope.config.bead_length, *astuple(config))
        if label(moving) != code:
            break
        last = moving.copy()
    if last is None:
        return None
    try:
        laid = rope.from_curve(last)
    except InvalidInput:  # strands overlap too deeply
        return None
    return laid if label(laid) == code else None


@numba.njit(cache=True, nogil=True)
def _iterate(
    p: Array,
    length: float,
    iterations: int,
    reach: float,
    apart: int,
    push: float,
    bending: float,
    crossing: float,
    height: float,
    lifting: float,
    most: float,
    passes: int,
) -> None:
    """Run one round in place; the settings are the fields of RelaxationConfig, in their order."""
    n = len(p)
    move = np.empty((n, 3))
    for _ in range(iterations):
        # Moves are computed from the same positions for all vertices, then applied together.
        _straighten(p, move, bending)
        for i in range(n):
            for j in range(i + apart, n):
                if i + n - j < apart:  # neighbours across the base bead
                    continue
                x, y = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                distance = np.sqrt(x * x + y * y)
                if distance >= reach:
                    continue
                # At a crossing the upper strand rises and the lower one sinks, which keeps the
                # code's over and under.
                if distance < crossing * length:
                    z = p[i, 2] - p[j, 2]
                    lack = height - abs(z)
                    if lack > 0:
                        lift = lifting * lack if z >= 0 else -lifting * lack
                        move[i, 2] += lift
                        move[j, 2] -= lift
                # Repulsion falls from push at distance 0 to 0 at reach, quadratically, so that
                # there is no kink at reach; dividing by the distance normalizes (x, y).
                if distance > 1e-9:
                    strength = push * (1 - distance / reach) ** 2 * length / distance
                    move[i, 0] += strength * x
                    move[i, 1] += strength * y
                    move[j, 0] -= strength * x
                    move[j, 1] -= strength * y
        for i in range(n):
            for k in range(3):
                # by default 2 mm, well below the rope's radius: strands can't jump each other
                p[i, k] += min(most * length, max(-most * length, move[i, k]))
        _restore_lengths(p, length, passes)


@numba.njit(cache=True, nogil=True)
def _straighten(p: Array, move: Array, bending: float) -> None:
    """Set the moves to one explicit step of the biharmonic flow, which straightens bends."""
    # The fourth difference, stencil (1, -4, 6, -4, 1), is the gradient of the discrete bending
    # energy sum |p[i - 1] - 2 p[i] + p[i + 1]|^2 / 2. Its largest eigenvalue is 16, so that the
    # step is stable for bending < 2 / 16.
    n = len(p)
    for i in range(n):
        a, b, c, d = (i - 2) % n, (i - 1) % n, (i + 1) % n, (i + 2) % n
        for k in range(3):
            move[i, k] = -bending * (p[a, k] - 4 * p[b, k] + 6 * p[i, k] - 4 * p[c, k] + p[d, k])


@numba.njit(cache=True, nogil=True)
def _restore_lengths(p: Array, length: float, passes: int) -> None:
    """Move neighbours to one bead length apart, constraint by constraint."""
    # Gauss-Seidel: each correction is applied at once and splits evenly between both vertices
    # (equal masses), so that the centre of mass stays. What error remains after the passes is
    # removed by `Rope.from_curve`.
    n = len(p)
    for _ in range(passes):
        for i in range(n):
            j = (i + 1) % n
            x, y, z = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
            now = np.sqrt(x * x + y * y + z * z)
            share = 0.5 * (now - length) / max(now, 1e-12)
            p[i, 0] += share * x
            p[i, 1] += share * y
            p[i, 2] += share * z
            p[j, 0] -= share * x
            p[j, 1] -= share * y
            p[j, 2] -= share * z
