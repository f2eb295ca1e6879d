"""Make the set of states that ships as "bench" from two generated sets.

    P="knotgym generate --engine chain --no-demonstrations --seed 2026 --count 512"
    $P --source play --nx 0-3 --out play
    $P --source drawing --nx 4,5 --out drawn
    python benchmarks/bench_states.py play drawn --out knotgym/states/curated/bench.h5

A state is its vertices in float32. It is judged again as it is laid from them: its code must stay,
the limits of readable states hold, and it must differ from all others under every symmetry. Of each
number of crossings and split --count are kept, codes as evenly as there are states; printed is what
train and test share.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import run
from numpy.typing import NDArray

from knotgym.common import Array, Stream, Table
from knotgym.generate import GenerateConfig, PhasedPulls, judge
from knotgym.quality import Limits
from knotgym.rope import CHAIN, Rope
from knotgym.states import STATE_SPLITS, Spectra, States, pairs_within, read_states, resolve_states
from knotgym.topology import GaussCode, label

LIVES = 8  # of each drawn rope, each with other pulls
_PHASES = {"settle": 0, "random": 2, "opening": 0, "rounds": 1, "scripted": 0, "spreading": 8}
PULLS = replace(GenerateConfig().play, **_PHASES, first=4, every=2)


def laid(states: States) -> tuple[Array, list[int]]:
    """Return states as they are laid from float32 vertices, and the rows that pass again."""
    rope, kept = Rope(), []
    points = states.points.astype(np.float32).astype(np.float64)
    for row, one in enumerate(points):
        points[row] = rope.points(rope.qpos(one)[None])[0]
        code = GaussCode.parse(str(states.gauss_code_chiral[row]))
        if not judge(points[row], [Limits()], code=code).faults:
            kept.append(row)
    return points, kept


def pulled(states: States) -> States:
    """Pull drawn states about in the chain engine, and return what they show on the way.

    Drawings of a diagram and of its mirror image are alike; after random pulls, and pulls that
    spread the rope out again, their ropes lie differently. Longer lives make illegible ones.
    """
    drawn = np.flatnonzero(states.source["policy"] == "drawing")
    if not len(drawn):
        return states
    drawn = np.tile(drawn, LIVES)
    keys = [(int(Stream.PLAYED_ROPE), 0, life, 0, 0) for life in range(len(drawn))]
    lives = PhasedPulls(PULLS, keys, states.qpos[drawn]).play(CHAIN)
    rows, found = [], []
    for frame in lives.frames:
        code = label(frame.points)
        if code.nx in (4, 5):
            rows.append(int(drawn[frame.rope]))
            found.append((frame.points, code.chiral))
    columns = dict(states.take(rows).table)
    columns["points"] = np.array([points for points, _ in found])
    columns["gauss_code_chiral"] = np.array([code for _, code in found])
    columns["source/trajectory"] = np.array(rows)
    return States(Table(states.table.schema, columns), states.attributes)


def distinct(points: Array, rows: list[int], others: list[Array]) -> list[int]:
    """Drop rows that are near an earlier one, or one of other sources, under any symmetry."""
    near = {rows[second] for _, second, _ in pairs_within(points[rows])}
    for other in others:
        near |= {rows[row] for row, *_ in pairs_within(points[rows], other)}
    return [row for row in rows if row not in near]


def chosen(codes: NDArray[np.str_], splits: NDArray[np.str_], count: int) -> list[int]:
    """Choose rows of each nx and split, code by code, as evenly as there are states."""
    of_code: Counter[tuple[str, str]] = Counter()
    turns = []
    for row, (text, split) in enumerate(zip(codes.tolist(), splits.tolist(), strict=True)):
        code = GaussCode.parse(text)
        kind = str(code), split
        turns.append((code.nx, split, of_code[kind], kind[0], row))
        of_code[kind] += 1
    found, have = [], Counter[tuple[int, str]]()
    for nx, split, _, _, row in sorted(turns):
        have[nx, split] += 1
        if have[nx, split] <= count:
            found.append(row)
    return found


def told(table: Mapping[str, NDArray[Any]], points: Array) -> None:
    """Print what train and test share."""
    codes = [GaussCode.parse(text) for text in table["gauss_code_chiral"].tolist()]
    nx, plain = np.array([code.nx for code in codes]), np.array([str(code) for code in codes])
    for one in sorted({*nx.tolist()}):
        own = [np.flatnonzero((nx == one) & (table["split"] == split)) for split in STATE_SPLITS]
        shown = [{*plain[rows].tolist()} for rows in own]
        apart = 1000 * Spectra.of(points[own[1]]).nearest(Spectra.of(points[own[0]]))[0]
        print(
            f"nx {one}: {len(own[0])} train, {len(own[1])} test; codes {len(shown[0])} and"
            f" {len(shown[1])}, of test not in train {len(shown[1] - shown[0])}; nearest"
            f" {apart.min():.0f} mm, median {np.median(apart):.0f}"
        )


def main(*sources: Path, count: int = 256, out: Path = Path("bench.h5")) -> None:
    """Choose states of generated sets, and write their vertices.

    Args:
        sources: folders or files of the sets.
        count: states of each number of crossings and split.
        out: file to write.
    """
    parts, points = list[dict[str, NDArray[Any]]](), list[Array]()
    for source in sources:
        states = pulled(read_states(resolve_states(source), images=False))
        as_laid, kept = laid(states)
        rows = distinct(as_laid, kept, points)
        print(f"{source}: {len(rows)} of {len(states)} pass again and differ")
        drawn = states.source["policy"][rows] == "drawing"
        columns = {
            name: states.table[name][rows] for name in ("gauss_code_chiral", "knot", "split")
        }
        columns["points"] = states.points[rows].astype(np.float32)
        columns["source/policy"] = np.where(drawn, "bench-drawing", "bench-play")
        own = states.source["trajectory"][rows]  # ropes of two sources have different numbers
        columns["source/trajectory"] = np.where(own < 0, rows, own) + 1_000_000 * len(parts)
        parts.append(columns)
        points.append(as_laid[rows])
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    rows = chosen(whole["gauss_code_chiral"], whole["split"], count)
    table = {name: column[rows] for name, column in whole.items()}
    told(table, np.concatenate(points)[rows])
    States.write_vertices(out, table)
    print(f"{out}: {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    run(main)
