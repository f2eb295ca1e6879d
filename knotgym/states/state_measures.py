"""What a state file says of its rows beside what they show: measures, seeds, where they come from.

Measures are those of the points, computed again; a seed is the key of a stream that states come
from, and agrees with the rest of its row.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from knotgym.common.streams import InvalidSeed, Stream, generator, key
from knotgym.quality.limits import RESET_NOISE
from knotgym.quality.measures import NOISE_DRAWS, measure, noise_survival
from knotgym.rope.model import Array, Rope
from knotgym.states.schema import RANDOM_WALK
from knotgym.states.state_file import States
from knotgym.topology.crossings import Crossings

# of a measure, beside 1: other processors round otherwise
ROUNDED = 1e-9
# streams that states come from: with rows of actions, and the first counter is nx
_CHOSEN = (Stream.CANDIDATE, Stream.DRAWING)


def spread_faults(points: Array, rope: Rope) -> Iterator[str]:
    """A configuration (beads, 3), metres, that no rope can reach across; it can't be measured."""
    across = float(np.ptp(points, axis=0).max())
    if not across <= rope.config.length:
        yield f"points lie {across:.3g} m apart, the rope is {rope.config.length:g} m long"


def measure_faults(stored: Mapping[str, Any], right: Mapping[str, float]) -> Iterator[str]:
    """Measures that differ from those computed again by more than rounding."""
    for name, value in right.items():
        if name not in stored:
            continue
        there = stored[name]
        if there is None or not abs(there - value) <= ROUNDED * (1 + abs(value)):
            yield f"quality.{name} is {there!s}, recomputed {value!s}"


def quality_faults(states: States, row: int, crossings: Crossings | None = None) -> Iterator[str]:
    """Measures of a row that aren't those of its points.

    Noise survival is drawn: it is drawn again where the stream of its draws is known, those of a
    random walk, and else it is a share of so many draws.
    """
    stored = {name: float(values[row]) for name, values in states.quality.items()}
    right = asdict(measure(states.points[row], crossings))
    del right["noise_survival"]
    yield from measure_faults(stored, right)
    survival = stored.get("noise_survival", 1.0)
    if not (0 <= survival <= 1 and (survival * NOISE_DRAWS).is_integer()):
        yield f"quality.noise_survival is {survival}, should be a share of {NOISE_DRAWS} draws"
    elif "noise_survival" in stored and _policy(states, row) == RANDOM_WALK:
        _, seed, rope, *_ = states.source["seed"][row].tolist()
        step = int(states.source["steps"][row])
        try:
            rng = generator(Stream.RANDOM_WALK_NOISE, seed, rope, step)
        except InvalidSeed:
            return  # a fault of the seed
        again = noise_survival(states.points[row], RESET_NOISE, rng)
        yield from measure_faults({"noise_survival": survival}, {"noise_survival": again})


def source_faults(states: States, row: int) -> Iterator[str]:
    """Seeds that states don't come from, and what doesn't go with the row's other columns."""
    source = states.source
    seed = tuple(source["seed"][row].tolist())
    try:
        stream = Stream(seed[0])
        known = seed == key(stream, *seed[1:])
    except (InvalidSeed, ValueError, IndexError, TypeError):
        known = False
    if not known or stream not in (*_CHOSEN, Stream.RANDOM_WALK):
        yield f"seed {seed} is no stream that states come from"
        return
    runs = _seeds(states)
    if runs and seed[1] not in runs:
        yield f"seed {seed} is of a run with seed {seed[1]}, config says {_listed(runs)}"
    if stream in _CHOSEN and seed[2] != states.nx[row]:
        yield f"seed {seed} is of nx {seed[2]}, the row has nx {states.nx[row]}"
    walked = _policy(states, row) == RANDOM_WALK
    if walked != (stream == Stream.RANDOM_WALK):
        yield f"seed {seed} is of {stream.name}, policy is {_policy(states, row)!r}"
    drawn = stream == Stream.DRAWING  # its demonstration ends elsewhere
    if not drawn and "step" in source and source["step"][row] != source["steps"][row]:
        yield f"step is {source['step'][row]}, steps {source['steps'][row]}: the state is the last"
    if walked and "trajectory" in source and source["trajectory"][row] != seed[2]:
        yield f"trajectory is {source['trajectory'][row]}, its rope by its seed {seed[2]}"


def repeated_sources(states: States) -> Iterator[str]:
    """Rows of one run that say they come from one drawing or candidate, or end one episode.

    Runs whose files were merged count each for itself, so that theirs may.
    """
    if isinstance(json.loads(states.attributes.get("config", "{}")), list):
        return
    seeds = [tuple(seed) for seed in states.source["seed"].tolist()]
    keyed = [seed if seed and seed[0] in _CHOSEN else None for seed in seeds]
    yield from _repeated("come from one seed", keyed)
    if {"dataset", "trajectory"} <= states.source.keys():
        named = zip(
            states.source["dataset"].tolist(), states.source["trajectory"].tolist(), strict=True
        )
        yield from _repeated("end one episode", [one if one[0] else None for one in named])


def _repeated(what: str, keys: list[Any]) -> Iterator[str]:
    first: dict[Any, int] = {}
    for row, one in enumerate(keys):
        if one is not None and first.setdefault(one, row) != row:
            yield f"states.h5 rows {first[one]} and {row} {what}"


def _policy(states: States, row: int) -> str:
    return str(states.source["policy"][row]) if "policy" in states.source else ""


def _seeds(states: States) -> set[int]:
    """The seeds of the runs that made the file, as far as its configuration says."""
    config = json.loads(states.attributes.get("config", "{}"))
    return {
        one["seed"]
        for one in (config if isinstance(config, list) else [config])
        if isinstance(one, dict) and isinstance(one.get("seed"), int)
    }


def _listed(numbers: set[int]) -> str:
    return " or ".join(map(str, sorted(numbers)))
