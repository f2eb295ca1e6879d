"""Lay closed curves from files as states.

A curve is cut into beads, scaled to the rope's length, relaxed as little as needed
(`relaxation`), laid in the simulator, left to rest and judged by the limits of drawn states.
It keeps the Gauss code that it shows from +z, and its knot must be certified.
"""

from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common import InvalidInput, Stream
from knotgym.generate.states.curve_files import Curve, read_curves
from knotgym.generate.states.relaxation import relaxed
from knotgym.generate.states.state_rows import judge, row_of, stacked, states_of
from knotgym.quality import UNITS, Limits, Quality
from knotgym.rope import (
    Array,
    Rope,
    RopeConfig,
    Simulation,
    require_embedded,
    simulation_of,
)
from knotgym.states import States
from knotgym.topology import UNKNOWN, GaussCode, knot_type, label, possible_types

# Heights are scaled, which changes no code, and the curve is relaxed; the first to pass is kept.
_HEIGHTS, _ROUNDS = (1.0, 0.4, 0.15), (0, 1, 2, 4, 8, 16, 32, 64)
_REST = 20  # actions without force
_ONE = np.array([0])


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
    for number, curve in enumerate(curves):
        try:
            made.append((curve.name, _laid(curve.points, number, simulation)))
        except InvalidInput as error:
            refused.append(f"{curve.name}: {error}")
    if not made:
        more = len(refused) - 1
        raise InvalidInput(refused[0] + f"; {more} more are refused" * bool(more))
    made.sort(key=lambda one: one[1]["nx"])
    names = [name for name, _ in made]
    config = {"curves": names, "limits": asdict(Limits()), "engine": simulation.engine}
    rows = stacked([row for _, row in made])
    return states_of(rows, np.full(len(made), "train"), simulation.engine, config), refused


def _laid(curve: Array, number: int, simulation: Simulation) -> dict[str, Any]:
    """Lay a curve as a row of states; raise InvalidInput if that isn't possible."""
    rope, limits = simulation.rope, Limits()
    code = _shown_code(curve, rope)
    if knot_type(code) == UNKNOWN:
        several = possible_types(code)
        which = f"; it is one of {', '.join(several)}, which share polynomials" if several else ""
        raise InvalidInput(f"its knot, of {code.nx} crossings, can't be certified{which}")
    stream, rest = Stream.IMPORT.key(0, code.nx, number), np.zeros((_REST, 6), dtype=np.float32)
    why = "its strands can't be moved apart"
    for height, rounds in product(_HEIGHTS, _ROUNDS):
        points = _candidate(curve * (1, 1, height), rounds, code, rope)
        if points is None:
            continue
        start = rope.qpos(points)
        simulation.lay(start[None], _ONE)
        for action in rest:
            simulation.act(action[None])
        points, qpos = simulation.points[0].copy(), simulation.qpos(_ONE)[0]
        judgement = judge(points, [limits], code=code)
        if not judgement.faults:
            return row_of(
                judgement,
                points,
                qpos,
                start_qpos=start,
                actions=rest,
                steps=_REST,
                seed=np.array(stream),
                policy="import",
            )
        why = ", ".join(_missed(fault, judgement.quality, limits) for fault in judgement.faults)
    raise InvalidInput(f"refused, relaxed and flattened too: {why}")


def _shown_code(curve: Array, rope: Rope) -> GaussCode:
    """Return the Gauss code of a closed curve (n, 3) from +z, which the rope must show, too.

    Raises:
        InvalidInput: it is no embedded closed curve, or too intricate for the rope.
    """
    laid = rope.from_curve(curve, max_overlap=np.inf)
    require_embedded(curve)
    code = label(curve, most=rope.config.beads)
    if label(laid) != code:
        raise InvalidInput(
            f"with {rope.config.beads} beads it shows another Gauss code: it is too intricate for"
            " this rope, or strands lie exactly above each other"
        )
    return code


def _candidate(curve: Array, rounds: int, code: GaussCode, rope: Rope) -> Array | None:
    """Return a curve as a relaxed configuration with its code; None if that isn't possible."""
    try:
        rough = rope.from_curve(curve, max_overlap=np.inf if rounds else 0.001)
    except InvalidInput:
        return None
    points = relaxed(rough, rounds, rope) if rounds else rough
    return points if points is not None and label(points) == code else None


def _missed(fault: str, quality: Quality, limits: Limits) -> str:
    if fault not in UNITS:
        return fault
    return (
        f"{fault} is {getattr(quality, fault):.3g} {UNITS[fault]}, limit {getattr(limits, fault)}"
    )
