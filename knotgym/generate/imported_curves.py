"""Lay closed curves from files as states.

A curve is cut into beads, scaled to the rope's length, relaxed as little as needed
without physics, laid in the simulator, left to rest and judged by the limits of drawn states. It
keeps the Gauss code that it shows from +z, and its knot must be certified.

Relaxation gives a configuration that the rope could take, without actions that lead to it, at a
thousandth of the cost of simulation. Each iteration

1. straightens bends,
2. pushes apart vertices of different strands that are close in the picture,
3. separates the two strands of each crossing in height,
4. restores the length of every bead by projection.

Source of step 4: position-based dynamics, Müller et al., 2007.

After a change run `pytest tests/generate/test_imported_curves.py`: a relaxed curve must keep
its code, and all of its edges get the length of a bead.
"""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import Array, Counts, InvalidInput, Stream, inner, kernel
from knotgym.generate.curve_files import Curve, read_curves
from knotgym.generate.state_rows import judge, row_of, stacked, states_of
from knotgym.quality import Limits, Quality
from knotgym.rope import Rope, RopeConfig, Simulation, simulation_of
from knotgym.states import States
from knotgym.topology import UNKNOWN, GaussCode, knot_type, label

# Heights are scaled, which changes no code, and the curve is relaxed; the first to pass is kept.
_HEIGHTS, _ROUNDS = (1.0, 0.4, 0.15), (0, 1, 2, 4, 8, 16, 32, 64)
_REST = 20  # actions without force
_ONE = np.array([0])

# Set by hand when pictures were relaxed, too; what other values gave was not recorded. A change
# must keep every curve of tests/generate/test_imported_curves.py.
_ITERATIONS = 20  # per round
_REACH = 0.045  # distance in the picture within which strands repel each other, metres; nine pixels
_APART = 5  # vertices fewer than this many beads apart along the rope don't repel each other
_PUSH = 0.012  # largest repulsion per iteration, bead lengths, of strands at distance 0
_BENDING = 0.03  # coefficient of the straightening step per iteration
_CROSSING = 1.5  # distance in the picture within which two strands count as crossing, bead lengths
_HEIGHT = 0.0125  # target difference in height between crossing strands, metres
_LIFTING = 0.25  # fraction of the missing height by which each strand moves per iteration
# Largest displacement of a vertex per iteration along each axis, bead lengths: 2 mm, well below the
# rope's radius, so that strands can't jump each other.
_MOST = 0.15
_PASSES = 8  # projection sweeps over the beads per iteration


def import_curves(paths: Sequence[str | Path]) -> tuple[States, list[str]]:
    """Lay the curves of files as states, in order of crossings, all in split train.

    Returns:
        The states, and a line for each file or curve that was refused.

    Raises:
        MissingFile: there is no such file.
        InvalidInput: all were refused.
    """
    simulation = simulation_of(1, RopeConfig())
    curves: list[Curve] = []
    refused: list[str] = []
    for path in paths:
        try:
            curves += read_curves(path)
        except InvalidInput as error:
            refused.append(str(error))
    made: list[tuple[str, dict[str, Any]]] = []
    for number, curve in enumerate(Counts.over(curves, "relaxing curves")):
        try:
            made.append((curve.name, _laid(curve.points, number, simulation)))
        except InvalidInput as error:
            refused.append(f"{curve.name}: {error}")
    if not made:
        more = len(refused) - 1
        raise InvalidInput(refused[0] + f"; {more} more are refused" * bool(more))
    made.sort(key=lambda named: named[1]["nx"])
    names = [name for name, _ in made]
    config = {"curves": names, "limits": asdict(Limits()), "engine": simulation.engine}
    rows = stacked([row for _, row in made])
    return states_of(rows, np.full(len(made), "train"), simulation.engine, config), refused


def _laid(curve: Array, number: int, simulation: Simulation) -> dict[str, Any]:
    """Lay a curve as a row of states; raise InvalidInput if that isn't possible."""
    rope, limits = simulation.rope, Limits()
    code = _shown_code(curve, rope)
    if knot_type(code) == UNKNOWN:
        raise InvalidInput(f"its knot, of {code.nx} crossings, can't be certified")
    stream, rest = Stream.IMPORT.key(0, code.nx, number), np.zeros((_REST, 6), dtype=np.float32)
    why = "its strands can't be moved apart"
    for height, rounds in product(_HEIGHTS, _ROUNDS):
        points = _candidate(curve * (1, 1, height), rounds, code, rope)
        if points is None:
            continue
        start = rope.qpos(points)
        simulation.set_qpos(start[None], _ONE)
        for action in rest:
            simulation.act(action[None])
        points, qpos = simulation.points[0].copy(), simulation.qpos(_ONE)[0]
        judgement = judge(points, [limits], code=code)
        if not judgement.faults:
            made = {"start_qpos": start, "actions": rest, "steps": _REST, "seed": np.array(stream)}
            return row_of(judgement, points, qpos, **made, policy="import")
        why = ", ".join(_missed(fault, judgement.quality, limits) for fault in judgement.faults)
    raise InvalidInput(f"refused, relaxed and flattened too: {why}")


def _shown_code(curve: Array, rope: Rope) -> GaussCode:
    """Return the Gauss code of a closed curve (n, 3) from +z, which the rope must show, too.

    Raises:
        InvalidInput: it is no embedded closed curve, or too intricate for the rope.
    """
    laid = rope.from_curve(curve, max_overlap=np.inf, embedded=True)
    code = label(curve, most=rope.config.beads)
    if label(laid) != code:
        raise InvalidInput(
            f"with {rope.config.beads} beads it shows another Gauss code: it is too intricate for"
            " this rope, or strands lie exactly above each other"
        )
    return code


def _candidate(curve: Array, rounds: int, code: GaussCode, rope: Rope) -> Array | None:
    """Return a curve as a configuration with its code; None if that isn't possible.

    Args:
        curve: float64 (n, 3), in any unit.
        rounds: of relaxation, which stops before the first one that would change the code.
        code: that the curve shows.
        rope: gives the bead length and the limit on overlap.

    Returns:
        float64 (beads, 3), metres.
    """
    try:
        laid = rope.from_curve(curve, max_overlap=np.inf if rounds else 0.001)
        if rounds and label(laid) == code:
            moving, last = laid.copy(), None
            for _ in range(rounds):
                _iterate(moving, rope.config.bead_length)
                if label(moving) != code:
                    break
                last = moving.copy()
            if last is None:
                return None
            laid = rope.from_curve(last)
    except InvalidInput:  # strands overlap too deeply
        return None
    return laid if label(laid) == code else None


def _missed(fault: str, quality: Quality, limits: Limits) -> str:
    if fault not in Quality.UNITS:
        return fault
    value, unit = getattr(quality, fault), Quality.UNITS[fault]
    return f"{fault} is {value:.3g} {unit}, limit {getattr(limits, fault)}"


@kernel
def _iterate(p: Array, length: float) -> None:
    """Run one round in place."""
    n = len(p)
    move = np.empty((n, 3))
    for _ in range(_ITERATIONS):
        # Moves are computed from the same positions for all vertices, then applied together.
        _straighten(p, move, _BENDING)
        for i in range(n):
            for j in range(i + _APART, n):
                if i + n - j < _APART:  # neighbours across the base bead
                    continue
                x, y = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                distance = np.sqrt(x * x + y * y)
                if distance >= _REACH:
                    continue
                # At a crossing the upper strand rises and the lower one sinks, which keeps the
                # code's over and under.
                if distance < _CROSSING * length:
                    z = p[i, 2] - p[j, 2]
                    lack = _HEIGHT - abs(z)
                    if lack > 0:
                        lift = _LIFTING * lack if z >= 0 else -_LIFTING * lack
                        move[i, 2] += lift
                        move[j, 2] -= lift
                # Repulsion falls from push at distance 0 to 0 at reach, quadratically, so that
                # there is no kink at reach; dividing by the distance normalizes (x, y).
                if distance > 1e-9:
                    strength = _PUSH * (1 - distance / _REACH) ** 2 * length / distance
                    for k, away in enumerate((x, y)):
                        move[i, k] += strength * away
                        move[j, k] -= strength * away
        for i in range(n):
            for k in range(3):
                p[i, k] += min(_MOST * length, max(-_MOST * length, move[i, k]))
        _restore_lengths(p, length, _PASSES)


@inner
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


@inner
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
            part = 0.5 * (now - length) / max(now, 1e-12)
            for k, along in enumerate((x, y, z)):
                p[i, k] += part * along
                p[j, k] -= part * along
