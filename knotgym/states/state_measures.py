"""Verify the measures and the provenance of the rows of a state file.

Measures must equal those recomputed from the points. A seed must be the key of a random stream that
states come from, and agree with the rest of its row.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator, key
from knotgym.quality.limits import RESET_NOISE
from knotgym.quality.measures import NOISE_DRAWS, measure, noise_survival
from knotgym.rope.model import Array, Rope
from knotgym.states.schema import RANDOM_WALK
from knotgym.states.state_file import States
from knotgym.topology.crossings import Crossings
from knotgym.topology.gauss import GaussCode
from knotgym.topology.reference_labeller import pyknotid_code

# tolerance of a measure, relative to 1 + its modulus: other processors round differently
_ROUNDING = 1e-9
# streams of states with stored actions; their first counter is nx
_CHOSEN = (Stream.CANDIDATE, Stream.DRAWING, Stream.IMPORT)


def spread_faults(points: Array, rope: Rope) -> Iterator[str]:
    """Yield a fault if a configuration, (beads, 3) in metres, is wider than the rope is long.

    Measuring such a configuration makes no sense.
    """
    across = float(np.ptp(points, axis=0).max())
    if not across <= rope.config.length:
        yield f"points are {across:.3g} m apart, the rope is {rope.config.length:g} m long"


def recomputed_faults(stored: Mapping[str, Any], right: Mapping[str, Any]) -> Iterator[str]:
    """Yield the columns of a row that differ from the recomputed ones."""
    for name, value in right.items():
        if stored[name] != value:
            yield f"{name} is {stored[name]!s}, recomputed {value!s}"


def second_labeller_faults(points: Array, code: GaussCode) -> Iterator[str]:
    """Yield a fault if pyknotid reads another code than our labeller."""
    second = pyknotid_code(points)
    if second != code:
        yield f"pyknotid reads {second.chiral}, our labeller reads {code.chiral}"


def measure_faults(stored: Mapping[str, Any], right: Mapping[str, float]) -> Iterator[str]:
    """Yield the measures that differ from the recomputed ones by more than rounding."""
    for name, value in right.items():
        found = stored.get(name, value)
        if found is None or not abs(found - value) <= _ROUNDING * (1 + abs(value)):
            yield f"quality.{name} is {found!s}, recomputed {value!s}"


def quality_faults(states: States, row: int, crossings: Crossings | None = None) -> Iterator[str]:
    """Yield the measures of a row that aren't those of its points.

    Noise survival is estimated from random draws. For random walks, whose stream is known, the
    draws are repeated; for other rows it must be a multiple of 1 / NOISE_DRAWS.
    """
    stored = {name: float(values[row]) for name, values in states.quality.items()}
    right = asdict(measure(states.points[row], crossings))
    del right["noise_survival"]
    yield from measure_faults(stored, right)
    survival = stored.get("noise_survival", 1.0)
    if not (0 <= survival <= 1 and (survival * NOISE_DRAWS).is_integer()):
        yield f"quality.noise_survival is {survival}, should be a multiple of 1/{NOISE_DRAWS}"
    elif "noise_survival" in stored and _policy(states, row) == RANDOM_WALK:
        _, seed, rope, *_ = states.source["seed"][row].tolist()
        step = int(states.source["steps"][row])
        try:
            rng = generator(Stream.RANDOM_WALK_NOISE, seed, rope, step)
        except InvalidInput:
            return  # `source_faults` reports the seed
        again = noise_survival(states.points[row], RESET_NOISE, rng)
        yield from measure_faults({"noise_survival": survival}, {"noise_survival": again})


def stream_of(states: States, row: int) -> Stream | None:
    """Return the random stream whose key is a row's seed; None if the seed is no key."""
    seed = tuple(states.source["seed"][row].tolist())
    try:
        stream = Stream(seed[0])
        return stream if seed == key(stream, *seed[1:]) else None
    except (InvalidInput, ValueError, IndexError, TypeError):
        return None


def source_faults(states: States, row: int) -> Iterator[str]:
    """Yield faults of a row's seed, and provenance that contradicts its other columns."""
    source = states.source
    seed, stream = tuple(source["seed"][row].tolist()), stream_of(states, row)
    if stream not in (*_CHOSEN, Stream.RANDOM_WALK):
        yield f"seed {seed} is not a stream that states come from"
        return
    runs = _seeds(states)
    if runs and seed[1] not in runs:
        listed = " or ".join(map(str, sorted(runs)))
        yield f"seed {seed} is of a run with seed {seed[1]}, config says {listed}"
    if stream in _CHOSEN and seed[2] != states.nx[row]:
        yield f"seed {seed} is of nx {seed[2]}, the row has nx {states.nx[row]}"
    walked = _policy(states, row) == RANDOM_WALK
    if walked != (stream == Stream.RANDOM_WALK):
        yield f"seed {seed} is of {stream.name}, policy is {_policy(states, row)!r}"
    drawn = stream == Stream.DRAWING  # its demonstration ends elsewhere
    if not drawn and "step" in source and source["step"][row] != source["steps"][row]:
        yield f"step is {source['step'][row]}, should be steps, {source['steps'][row]}"
    if walked and "trajectory" in source and source["trajectory"][row] != seed[2]:
        yield f"trajectory is {source['trajectory'][row]}, its seed says rope {seed[2]}"


def repeated_sources(states: States) -> Iterator[str]:
    """Yield the rows of a run that share a drawing, a candidate, a step of a walk or an episode.

    Merged files are skipped, because two runs may use the same seeds.
    """
    if isinstance(json.loads(states.attributes.get("config", "{}")), list):
        return
    seeds = [tuple(seed) for seed in states.source["seed"].tolist()]
    # the rope of a walk may give several rows, at different steps
    steps = states.source["steps"].tolist()
    keyed = [
        (seed if seed[0] in _CHOSEN else (*seed, step)) if seed else None
        for seed, step in zip(seeds, steps, strict=True)
    ]
    yield from _repeated("come from one seed", keyed)
    if {"dataset", "trajectory"} <= states.source.keys():
        columns = (states.source[name].tolist() for name in ("dataset", "trajectory"))
        named = [one if one[0] else None for one in zip(*columns, strict=True)]
        yield from _repeated("end one episode", named)


def _repeated(what: str, keys: list[Any]) -> Iterator[str]:
    first: dict[Any, int] = {}
    for row, one in enumerate(keys):
        if one is not None and first.setdefault(one, row) != row:
            yield f"states.h5 rows {first[one]} and {row} {what}"


def _policy(states: States, row: int) -> str:
    return str(states.source["policy"][row]) if "policy" in states.source else ""


def _seeds(states: States) -> set[int]:
    """Return the seeds of the runs that generated the file, from its configuration."""
    config = json.loads(states.attributes.get("config", "{}"))
    return {
        one["seed"]
        for one in (config if isinstance(config, list) else [config])
        if isinstance(one, dict) and isinstance(one.get("seed"), int)
    }
