"""Lay closed curves from files as states, and write the curves of states to files.

A curve is cut into beads, scaled to the rope's length, relaxed as little as needed
(`rope.relaxation`), laid in the simulator, left to rest and judged by the limits of drawn states.
It keeps the Gauss code that it shows from +z, and its knot must be certified.

    .csv    x,y,z in each line, or curve,x,y,z for several curves; a line of names may come first
    .obj    vertices; each `o` or `l` begins a curve, which `l` orders
    .npz    arrays (n, 3), one curve each
"""

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knotgym.common.atomic_files import require_regular
from knotgym.common.errors import InvalidInput, one_line
from knotgym.common.streams import Stream, key
from knotgym.generate.states.state_filter import judge
from knotgym.generate.states.state_rows import row_of, stacked, states_of
from knotgym.quality.limits import UNITS, Limits, Quality
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Array, Rope, RopeConfig
from knotgym.rope.relaxation import relaxed
from knotgym.rope.simulation import Simulation
from knotgym.states.schema import IMPORT
from knotgym.states.state_file import States
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import UNKNOWN, knot_type, possible_types

# Heights are scaled, which changes no code, and the curve is relaxed; the first to pass is kept.
_HEIGHTS, _ROUNDS = (1.0, 0.4, 0.15), (0, 1, 2, 4, 8, 16, 32, 64)
_REST = 20  # actions without force
_ONE = np.array([0])
_LARGEST = 64_000_000  # bytes of a file
_MOST = 100_000  # points of a curve
_SUFFIXES = (".csv", ".obj", ".npz")


class Curve(NamedTuple):
    """A closed curve, float64 (n, 3) in any unit, and where it was read."""

    name: str
    points: Array


def read_curves(path: str | Path) -> list[Curve]:
    """Read the closed curves in a file.

    Raises:
        MissingFile: there is no such file.
        InvalidInput: it holds no curves, or is too large.
    """
    given = Path(path)
    if given.suffix not in _SUFFIXES:
        raise InvalidInput(f"curves are read from {', '.join(_SUFFIXES)}, got {given.name!r}")
    require_regular(given, "file of curves", InvalidInput)
    if given.stat().st_size > _LARGEST:
        raise InvalidInput(f"{path} has more than {_LARGEST // 1_000_000} MB")
    reader = {".csv": _from_csv, ".obj": _from_obj, ".npz": _from_npz}[given.suffix]
    try:
        curves = [
            Curve(f"{given.name}:{name}" if name else given.name, np.asarray(points, np.float64))
            for name, points in reader(given)
        ]
    except (ValueError, OSError, IndexError, EOFError, MemoryError, zipfile.BadZipFile) as error:
        raise InvalidInput(f"{path} holds no curves: {one_line(error)}") from error
    for curve in curves:
        if curve.points.ndim != 2 or curve.points.shape[1] != 3 or len(curve.points) > _MOST:
            raise InvalidInput(
                f"{curve.name}: a curve is (n, 3) with at most {_MOST} points, got shape"
                f" {curve.points.shape}"
            )
    if not curves:
        raise InvalidInput(f"{path} holds no curves")
    return curves


def import_curves(
    paths: Sequence[str | Path],
    *,
    split: str = "train",
    limits: Limits | None = None,
    seed: int = 0,
) -> States:
    """Lay the curves of files as states, in order of crossings.

    Args:
        split: "train" or "test", the split of all states.
        limits: that a state must keep; those of drawn states by default.
        seed: part of the keys in the rows' provenance.

    Raises:
        InvalidInput: a curve can't be laid; the line says why.
    """
    limits, simulation = limits or Limits(), simulation_of(1, RopeConfig())
    curves = [curve for path in paths for curve in read_curves(path)]
    made = [_laid(one, number, seed, limits, simulation) for number, one in enumerate(curves)]
    order = sorted(range(len(made)), key=lambda number: made[number]["nx"])
    config = {
        "curves": [curves[number].name for number in order],
        "limits": asdict(limits),
        "seed": seed,
        "engine": simulation.engine,
    }
    rows = stacked([made[number] for number in order])
    return states_of(rows, np.full(len(made), split), simulation.engine, config)


def _laid(
    curve: Curve, number: int, seed: int, limits: Limits, simulation: Simulation
) -> dict[str, Any]:
    """Lay a curve as a row of states; raise InvalidInput if that isn't possible."""
    rope = simulation.rope
    try:
        code = label(rope.from_curve(curve.points, max_overlap=np.inf))
    except InvalidInput as error:
        raise InvalidInput(f"{curve.name}: {error}") from error
    if label(curve.points) != code:
        raise InvalidInput(
            f"{curve.name}: with {rope.config.beads} beads it shows another Gauss code; it is too"
            " intricate for this rope"
        )
    if knot_type(code) == UNKNOWN:
        several = possible_types(code)
        which = f"; it is one of {', '.join(several)}, which share polynomials" if several else ""
        raise InvalidInput(
            f"{curve.name}: its knot, of {code.nx} crossings, can't be certified{which}"
        )
    stream, rest = key(Stream.IMPORT, seed, code.nx, number), np.zeros((_REST, 6), dtype=np.float32)
    why = "its strands can't be moved apart"
    for height, rounds in product(_HEIGHTS, _ROUNDS):
        points = _candidate(curve.points * (1, 1, height), rounds, code, rope)
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
                policy=IMPORT,
            )
        why = ", ".join(_missed(fault, judgement.quality, limits) for fault in judgement.faults)
    raise InvalidInput(f"{curve.name}: refused, relaxed and flattened too: {why}")


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


def _from_csv(path: Path) -> Iterator[tuple[str, list[list[float]]]]:
    lines = [line.split(",") for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
    curves: dict[str, list[list[float]]] = {}
    for number, words in enumerate(lines):
        if len(words) not in (3, 4):
            raise InvalidInput(f"line {number + 1} has {len(words)} values, should be 3 or 4")
        try:
            point = [float(word) for word in words[-3:]]
        except ValueError:
            if number:
                raise
            continue  # names of the columns
        curves.setdefault(words[0].strip() if len(words) == 4 else "", []).append(point)
    yield from curves.items()


def _from_obj(path: Path) -> Iterator[tuple[str, list[list[float]]]]:
    vertices: list[list[float]] = []
    walks: list[list[int]] = []
    for line in path.read_text("utf-8").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "l":
            numbers = [int(word.partition("/")[0]) for word in words]
            walks.append([n - 1 if n > 0 else len(vertices) + n for n in numbers])
    # segments "l 1 2", "l 2 3" make up one walk
    joined: list[list[int]] = []
    for walk in walks:
        if joined and joined[-1][-1] == walk[0] and joined[-1][0] != joined[-1][-1]:
            joined[-1] += walk[1:]
        else:
            joined.append(walk)
    for number, walk in enumerate(joined or [[*range(len(vertices))]] * bool(vertices)):
        if min(walk) < 0:
            raise InvalidInput(f"line element {number + 1} names a vertex before the first")
        yield (str(number) if len(joined) > 1 else ""), [vertices[n] for n in walk]


def _from_npz(path: Path) -> Iterator[tuple[str, Array]]:
    with np.load(path, allow_pickle=False) as archive:
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise InvalidInput("it isn't an .npz archive")
        for name in archive.files:
            if sum(info.file_size for info in zipfile.ZipFile(path).infolist()) > _LARGEST:
                raise InvalidInput(f"it unpacks to more than {_LARGEST // 1_000_000} MB")
            values = archive[name]
            if values.dtype.kind not in "fiu":
                raise InvalidInput(f"{name} isn't an array of real numbers")
            yield name if len(archive.files) > 1 else "", values
