"""States met by play: frames of ropes that random and scripted policies pull.

Ropes are pulled side by side (`phased_pulls`), and frames that pass the filter are kept: readable,
not over-twisted, new. All frames of a rope are in one split. Source random-walk is the same with
the published pulls, uniform random actions, and without limits on readability.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Failed, Table
from knotgym.generate.states.generate_config import GenerateConfig, PlayConfig
from knotgym.generate.states.phased_pulls import pulled_ropes
from knotgym.generate.states.selection import Selection
from knotgym.generate.states.state_rows import (
    joined,
    judge,
    row_of,
    stacked,
    with_report,
    without_report,
)
from knotgym.rope import Array
from knotgym.runs import Call, Recipe, Result
from knotgym.states import STATE_SPLITS, source_of
from knotgym.topology import UNKNOT, GaussCode, codes_of, label_many

_CALLS = 4  # between two looks at what is still missing
# A code may have this many times its even share of the states of an nx and split, and at least
# _LEAST: common codes would crowd out the others.
_UNEVEN, _LEAST = 1.6, 2
_READABLE = "play"  # the source whose states are readable, and of many codes


def rows_of_ropes(
    config: GenerateConfig, report: dict[str, Any], apart_from: Sequence[Array] = ()
) -> Recipe[Table]:
    """Take the states that a configuration asks for from pulled ropes.

    Args:
        config: of source play or random-walk.
        report: gets the run's counts.
        apart_from: points of other states, (n, beads, 3) each, which none may be near.

    Raises:
        Failed: states are missing, although `config.attempts` are used up.
    """
    ropes, selection = _pulls_of(config).ropes, Selection(apart_from)
    have, of_code = Counter[tuple[int, str]](), Counter[tuple[str, GaussCode]]()
    lived = 0
    while lacking := [
        (nx, split)
        for nx in config.nx
        for split in STATE_SPLITS
        if have[nx, split] < _wanted(config, nx, split)
    ]:
        if lived >= config.attempts * config.count:
            named = ", ".join(f"nx {nx} {split}" for nx, split in lacking)
            raise Failed(
                f"states are missing for {named} after {lived} ropes; give --resume with a larger"
                " --set attempts=N"
            )
        calls = [
            Call(f"pulling ropes {first}", _play, (config, first, tuple(lacking)))
            for first in range(lived, lived + _CALLS * ropes, ropes)
        ]
        lived += _CALLS * ropes
        for result in (yield calls):
            rows, reasons = without_report(result)
            for nx, each in reasons:
                selection.rejected[nx].update(each)
            for row, rope in enumerate(ropes_of(rows)):
                code = GaussCode.parse(str(rows["gauss_code"][row]))
                split = split_of(config, rope)
                even = _wanted(config, code.nx, split) / len(codes_of(UNKNOT, code.nx))
                if have[code.nx, split] >= _wanted(config, code.nx, split):
                    continue
                if _READABLE == config.source and of_code[split, code] >= max(
                    _LEAST, _UNEVEN * even
                ):
                    continue
                if selection.offer(rows, row):
                    have[code.nx, split] += 1
                    of_code[split, code] += 1
    report.update(
        existing_codes={str(nx): len(codes_of(UNKNOT, nx)) for nx in config.nx},
        attempts=lived,
        rejected=selection.reasons(config.nx),
    )
    rows = selection.rows()
    return joined([rows.take(rows["nx"] == nx) for nx in config.nx])


def _wanted(config: GenerateConfig, nx: int, split: str) -> int:
    """Return the number of states to make with nx crossings in a split."""
    train = int(np.floor(config.count * config.train_share + 0.5))
    return train if split == STATE_SPLITS[0] else config.count - train


def split_of(config: GenerateConfig, rope: int) -> str:
    """Return the split of a rope's states; ropes alternate to match `train_share`."""
    before, after = (int(np.floor(k * config.train_share + 0.5)) for k in (rope, rope + 1))
    return STATE_SPLITS[0] if after > before else STATE_SPLITS[1]


def splits_of(config: GenerateConfig, rows: Table) -> NDArray[np.str_]:
    """Return the split of each row, that of its rope."""
    return np.array([split_of(config, rope) for rope in ropes_of(rows)])


def ropes_of(rows: Table) -> list[int]:
    """Return the ropes that rows come from, by their numbers in the run."""
    return [int(seed[2]) for seed in rows["source/seed"]]


def _key_of(config: GenerateConfig, rope: int) -> tuple[int, ...]:
    """Return the key of a rope's random stream."""
    stream = source_of(config.source).stream
    assert stream is not None
    return stream.key(config.seed, rope)


def _pulls_of(config: GenerateConfig) -> PlayConfig:
    """Return the pulls of the ropes."""
    return config.play if config.source == _READABLE else config.walk


def _play(config: GenerateConfig, first: int, lacking: tuple[tuple[int, str], ...]) -> Result:
    """Take states from the ropes `first` to `first + ropes - 1`.

    Args:
        lacking: nx and split of the states that are still needed.

    Returns:
        The rows, rope by rope, and as report for each nx the reasons of rejected frames with their
        numbers.
    """
    pulls = _pulls_of(config)
    ropes = range(first, first + pulls.ropes)
    keys = [_key_of(config, rope) for rope in ropes]
    pulled = pulled_ropes(pulls, config.engine_used, keys)
    played = config.source == _READABLE
    limits = [config.limits, config.twist] if played else [config.twist]
    rejected = {nx: Counter[str]() for nx in config.nx}
    kept, rows = Counter[tuple[int, int]](), list[dict[str, Any]]()
    codes = label_many(np.array([frame.points for frame in pulled.frames])) if pulled.frames else []
    for frame, code in zip(pulled.frames, codes, strict=True):
        rope = ropes[frame.rope]
        if (code.nx, split_of(config, rope)) not in lacking:
            continue
        if kept[rope, code.nx] == pulls.per_rope:
            continue
        judgement = judge(frame.points, limits)
        rejected[code.nx].update(judgement.faults)
        if judgement.faults:
            continue
        kept[rope, code.nx] += 1
        row = row_of(
            judgement,
            frame.points,
            frame.qpos,
            start_qpos=pulled.start_qpos[frame.rope],
            steps=frame.step,
            seed=np.array(keys[frame.rope]),
            policy=config.source,
            trajectory=rope,
        )
        if played:  # those of a random walk follow from its key
            row["source/actions"] = pulled.actions[frame.rope, : frame.step]
        rows.append(row)
    rows.sort(key=lambda row: (row["source/trajectory"], row["source/steps"]))
    return with_report(stacked(rows), list(rejected.items()))
