"""States met by play: frames of ropes that random and scripted policies pull.

Ropes live side by side (`rope_lives`), and frames that pass the filter are kept: readable, not
over-twisted, new. All frames of a rope are in one split. Source random-walk is the same with the
published pulls, uniform random actions, and without limits on readability.
"""

from collections import Counter
from typing import Any

import numpy as np

from knotgym.common import Failed, Stream, key
from knotgym.generate.states.generate_config import GenerateConfig
from knotgym.generate.states.rope_lives import live
from knotgym.generate.states.selection import Selection
from knotgym.generate.states.state_filter import judge
from knotgym.generate.states.state_rows import (
    Rows,
    joined,
    row_of,
    stacked,
    taken,
    with_report,
    without_report,
)
from knotgym.runs import Call, Recipe
from knotgym.states import PLAY, STATE_SPLITS
from knotgym.topology import UNKNOT, GaussCode, codes_of, label_many

_CALLS = 4  # between two looks at what is still missing
# A code may have this many times its even share of the states of an nx and split, and at least
# _LEAST: common codes would crowd out the others.
_UNEVEN, _LEAST = 1.6, 2


def rows_of_ropes(config: GenerateConfig, report: dict[str, Any]) -> Recipe[Rows]:
    """Take the states that a configuration asks for from the lives of ropes.

    Args:
        config: of source play or random-walk.
        report: gets the run's counts.

    Raises:
        Failed: states are missing, although `config.attempts` are used up.
    """
    ropes, selection = config.lives.ropes, Selection()
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
                if config.source == PLAY and of_code[split, code] >= max(_LEAST, _UNEVEN * even):
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
    return joined([taken(rows, rows["nx"] == nx) for nx in config.nx])


def _wanted(config: GenerateConfig, nx: int, split: str) -> int:
    """Return the number of states to make with nx crossings in a split."""
    train = int(np.floor(config.count * config.train_share + 0.5))
    return train if split == STATE_SPLITS[0] else config.count - train


def split_of(config: GenerateConfig, rope: int) -> str:
    """Return the split of a rope's states; ropes alternate to match `train_share`."""
    before, after = (int(np.floor(k * config.train_share + 0.5)) for k in (rope, rope + 1))
    return STATE_SPLITS[0] if after > before else STATE_SPLITS[1]


def ropes_of(rows: Rows) -> list[int]:
    """Return the ropes that rows come from, by their numbers in the run."""
    return [int(seed[2]) for seed in rows.get("source/seed", ())]


def _key_of(config: GenerateConfig, rope: int) -> tuple[int, ...]:
    """Return the key of a rope's random stream."""
    stream = Stream.PLAYED_ROPE if config.source == PLAY else Stream.RANDOM_WALK
    return key(stream, config.seed, rope)


def _play(config: GenerateConfig, first: int, lacking: tuple[tuple[int, str], ...]) -> Rows:
    """Take states from the lives of ropes `first` to `first + config.lives.ropes - 1`.

    Args:
        lacking: nx and split of the states that are still needed.

    Returns:
        The rows, rope by rope, and as report for each nx the reasons of rejected frames with their
        numbers.
    """
    ropes = range(first, first + config.lives.ropes)
    keys = [_key_of(config, rope) for rope in ropes]
    lives = live(config.lives, config.engine_used, keys)
    played = config.source == PLAY
    limits = [config.limits, config.twist] if played else [config.twist]
    rejected = {nx: Counter[str]() for nx in config.nx}
    kept, rows = Counter[tuple[int, int]](), list[dict[str, Any]]()
    codes = label_many(np.array([frame.points for frame in lives.frames])) if lives.frames else []
    for frame, code in zip(lives.frames, codes, strict=True):
        rope = ropes[frame.rope]
        if (code.nx, split_of(config, rope)) not in lacking:
            continue
        if kept[rope, code.nx] == config.lives.per_rope:
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
            start_qpos=lives.start_qpos[frame.rope],
            steps=frame.step,
            seed=np.array(keys[frame.rope]),
            policy=config.source,
            trajectory=rope,
        )
        if played:  # those of a random walk follow from its key
            row["source/actions"] = lives.actions[frame.rope, : frame.step]
        rows.append(row)
    rows.sort(key=lambda row: (row["source/trajectory"], row["source/steps"]))
    return with_report(stacked(rows), list(rejected.items()))
