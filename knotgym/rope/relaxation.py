"""Relaxation without physics: strands part in the picture, bends ease, and the Gauss code stays.

For pictures, which need a rope that could lie so and no actions that lead there; it takes a
thousandth of the time that moving the rope in the simulator would. Each iteration pushes
apart vertices whose strands come near in the picture, straightens bends, lifts the strands at
crossings apart, and gives every bead its length again (position-based dynamics, Müller et al.,
2007).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from knotgym.common.configuration import InvalidConfig, check_numbers
from knotgym.rope.model import Array, InvalidCurve, Rope
from knotgym.topology.crossings import label


@dataclass(frozen=True, kw_only=True)
class RelaxationConfig:
    """What an iteration does; shares are of what there is to mend.

    Attributes:
        iterations: of a round.
        reach: metres in the picture within which strands push each other apart; 0.045 are nine
            pixels.
        apart: beads along the rope that are the same strand.
        push: bead lengths that strands on top of each other push each other at once.
        bending: share of a bend straightened at once.
        crossing: bead lengths in the picture within which strands cross, or nearly.
        height: metres that the axes of crossing strands are brought apart.
        lifting: share of the height lacking that each of them is lifted or lowered at once.
        most: bead lengths that a vertex moves at once, along each axis.
        passes: over the beads that give them their length again.
    """

    iterations: int = 20
    reach: float = 0.045
    apart: int = 5
    push: float = 0.012
    bending: float = 0.03
    crossing: float = 1.5
    height: float = 0.0125
    lifting: float = 0.25
    most: float = 0.15
    passes: int = 8

    def __post_init__(self) -> None:
        check_numbers(
            self,
            counts=("iterations", "apart", "passes"),
            positive=("reach", "most"),
            non_negative=("push", "bending", "crossing", "height", "lifting"),
        )


def relaxed(points: Array, rounds: int, rope: Rope, config: RelaxationConfig) -> Array | None:
    """Let a configuration relax.

    Args:
        points: float64 (beads, 3), metres; left alone.
        rounds: at least 1; it ends before the first that would change the code.
        rope: whose bead length and overlap it keeps to.
        config: what a round does.

    Returns:
        float64 (beads, 3), a configuration of the rope with the code of `points`; None if it can't
        be had.

    Raises:
        InvalidConfig: fewer than 1 round.
    """
    if rounds < 1:
        raise InvalidConfig(f"rounds must be at least 1, got {rounds}")
    code = label(points)
    moving, last = np.array(points, dtype=np.float64), None
    for _ in range(rounds):
        _relax(moving, rope.config.bead_length, config)
        if label(moving) != code:
            break
        last = moving.copy()
    if last is None:
        return None
    try:
        laid = rope.from_curve(last)
    except InvalidCurve:  # strands are too deep in each other
        return None
    return laid if label(laid) == code else None


def _relax(points: Array, length: float, config: RelaxationConfig) -> None:
    """One round, in place."""
    _iterate(
        points,
        length,
        config.iterations,
        config.reach,
        config.apart,
        config.push,
        config.bending,
        config.crossing,
        config.height,
        config.lifting,
        config.most,
        config.passes,
    )


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
    n = len(p)
    move = np.empty((n, 3))
    for _ in range(iterations):
        _straighten(p, move, bending)
        for i in range(n):
            for j in range(i + apart, n):
                if i + n - j < apart:
                    continue
                x, y = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                distance = np.sqrt(x * x + y * y)
                if distance >= reach:
                    continue
                if distance < crossing * length:  # over and under keep their distance
                    z = p[i, 2] - p[j, 2]
                    lack = height - abs(z)
                    if lack > 0:
                        lift = lifting * lack if z >= 0 else -lifting * lack
                        move[i, 2] += lift
                        move[j, 2] -= lift
                if distance > 1e-9:
                    strength = push * (1 - distance / reach) ** 2 * length / distance
                    move[i, 0] += strength * x
                    move[i, 1] += strength * y
                    move[j, 0] -= strength * x
                    move[j, 1] -= strength * y
        for i in range(n):
            for k in range(3):
                p[i, k] += min(most * length, max(-most * length, move[i, k]))
        _restore_lengths(p, length, passes)


@numba.njit(cache=True, nogil=True)
def _straighten(p: Array, move: Array, bending: float) -> None:
    """Set the moves to a share of what would straighten the bends (the biharmonic operator)."""
    n = len(p)
    for i in range(n):
        a, b, c, d = (i - 2) % n, (i - 1) % n, (i + 1) % n, (i + 2) % n
        for k in range(3):
            move[i, k] = -bending * (p[a, k] - 4 * p[b, k] + 6 * p[i, k] - 4 * p[c, k] + p[d, k])


@numba.njit(cache=True, nogil=True)
def _restore_lengths(p: Array, length: float, passes: int) -> None:
    """Bring neighbours a bead length apart, pass by pass."""
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
