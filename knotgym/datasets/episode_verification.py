"""Verify episodes: play them again from their starts and pulls, and compare every column.

Codes are compared with a second, independent labeller, goals with the states that they name, and
Minari's form with what follows from the columns. Nothing stored is believed.

A goal must be the state that its row names, bit for bit. Reset noise moves a start, so it must be
near the state that its row names, or at least near none of another split.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Counts, InvalidFile, KnotgymError, MissingFile, Stream, one_line
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes
from knotgym.datasets.episodes import Episodes, gauss_codes
from knotgym.datasets.minari_form import minari_faults
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import ENGINES
from knotgym.states import NEAR, Spectra, pairs_within, repeated
from knotgym.topology import GaussCode, knot_type, label_many, pyknotid_code

Replay = Callable[[Episodes, TaskConfig], Episodes]  # `control.replay`
_BLOCK = 1024  # episodes played again at a time
# metres, root mean square over the beads, after the best translation and rotation about z. Reset
# noise at its default scale stays below 6 mm, and no two states of a curated set are that close.
_MATCH = NEAR / 2
_ROUNDING = 1e-9  # m and 1: other processors round the noise of a reset differently
_MOST_EPISODES = 10_000_000  # of a run, whose seeds are drawn again
_HUGE = 1e3  # metres; coordinates beyond this are corrupted, a rope is 1.3 m long


class ReplayFault(str):
    """A fault found by playing again: a machine that rounds differently finds it, too."""


def expanded(dataset: EpisodeDataset, replay: Replay) -> EpisodeDataset:
    """Return a dataset with all columns, made by playing its episodes again.

    What nothing can make again, such as labels, is the dataset's own.

    Raises:
        InvalidFile: a recording's pulls aren't those that were written, or lead to other states.
    """
    parts, order = list[Episodes](), list[NDArray[np.int64]]()
    is_whole = dataset.rows is None and not dataset.parts
    for fault in dataset.digest_faults():
        raise InvalidFile(fault)
    for of_task, part in dataset.setups():
        order.append(of_task)
        for first in range(0, len(of_task), _BLOCK):
            Counts.tell("episodes played again", Counts.from_now(len(parts) * _BLOCK), len(dataset))
            some = part.episodes.select(np.arange(first, min(first + _BLOCK, len(of_task))))
            parts.append(replay(some, part.found_task).with_claims(some))
    made = Episodes.merged(parts) if parts else dataset.episodes
    if len(order) > 1:
        made = made.select(np.argsort(np.concatenate(order)))
    whole = replace(dataset, episodes=made)
    if is_whole and dataset.episodes.is_recording and parts:
        digest = whole.digests["expansion"]
        if dataset.attributes.get("expansion", digest) != digest:
            raise InvalidFile(
                f"{dataset.path} can't be expanded to the bit: played again, its pulls lead to"
                " other states here than where it was recorded"
            )
    return whole


def episode_faults(source: Any, replay: Replay, *, sample: int = 0) -> Iterator[str]:
    """Verify a file of episodes or a Minari dataset; without other faults, its run's seeds, too.

    Args:
        source: what `open_episodes` takes.
        replay: plays the episodes again, to be compared.
        sample: how many drawn episodes to play again; 0 for all.

    Yields:
        Faults; each names the file, the episode and, where possible, the step.

    Raises:
        MissingFile: there is no such file.
    """
    clean = True
    for fault in _faults(source, replay, sample):
        clean = False
        yield fault
    if clean:
        yield from _start_faults(open_episodes(source).drawn(sample))


def _faults(source: Any, replay: Replay, sample: int) -> Iterator[str]:
    try:
        dataset = open_episodes(source)
    except MissingFile:
        raise
    except KnotgymError as error:
        yield one_line(error)
        return
    if faults := [*_file_faults(dataset)]:
        yield from faults
        return
    yield from _protocol_faults(dataset)
    for _, part in dataset.setups():
        yield from _split_faults(part)
        yield from _duplicate_faults(part)
    dataset = dataset.drawn(sample)
    try:
        columns = expanded(dataset, replay)
        is_recording, made = dataset.episodes.is_recording, columns.episodes
        made = made.recording() if is_recording else made
        for fault in made.differences(dataset.episodes, dataset.numbers):
            yield ReplayFault(f"{dataset.path}, {fault}, played again")
    except KnotgymError as error:
        yield ReplayFault(f"{dataset.path}: can't be played again: {one_line(error)}")
        return
    for fault in _code_faults(columns):
        yield f"{dataset.path}, {fault}"
    if not dataset.episodes.is_recording and dataset.rows is None:
        yield from minari_faults(dataset)


def _file_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield the faults for which nothing else can be checked."""
    rows, steps = dataset.episodes
    said, task = dataset.attributes, dataset.task
    unlike = task.rope_config.unlike(said.get("rope"))
    if unlike := unlike or ENGINES[task.engine].unlike(said.get("engine")):
        yield f"{dataset.path}: made with {unlike}"
    for c, values in [(c, table[c.name]) for table in (rows, steps) for c in table.schema.columns]:
        if (
            values.dtype.kind == "f"
            and not (np.isfinite(values) | (c.optional & np.isnan(values))).all()
        ):
            yield f"{dataset.path}: {c.name} contains a number that isn't finite"
    advised = np.nanmax(np.abs(steps.get("expert_action", np.zeros(0))), initial=0)
    far = np.abs(steps["force"]).max(initial=0) > 1
    absent = steps["bead"].max(initial=0) >= dataset.task.beads
    led = "macro_side" not in steps or _fit_macros(dataset)
    wrong = {
        "a pull is of a bead or with a force that doesn't exist": far or absent,
        "an expert's action lies outside [-1, 1]": advised > 1,
        "a pull isn't one of the macro-action that it belongs to": not led,
    }
    yield from (f"{dataset.path}: {fault}" for fault, is_wrong in wrong.items() if is_wrong)
    missing = (rows["goal"] < 0) | (rows["start"] < 0)
    if missing.any():
        yield f"{dataset.path}, episode {missing.argmax()}: it names no start, or no goal"
    yield from dataset.digest_faults()


def _fit_macros(dataset: EpisodeDataset) -> bool:
    """Whether each pull is of the bead that its macro-action leads, or of no macro-action."""
    steps, beads = dataset.episodes.steps, dataset.task.beads
    side, bead, target = (steps[f"macro_{name}"] for name in ("side", "bead", "target"))
    led = (bead == steps["bead"]) & (target < beads) & (abs(side) == 1)
    alone = ~steps["macro_start"] & (bead == 0) & (target == 0)
    return bool(np.where(side == 0, alone, led).all())


def _code_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield where codes aren't those of the vertices, or goals not those that their codes say."""
    (rows, steps), points = dataset.episodes, dataset.episodes.steps["observation"]
    chiral, wanted = gauss_codes(steps["visits"], steps["signs"]), gauss_codes(rows["goal_visits"])
    shown = label_many(rows["goal_points"].astype(np.float64))
    begins = gauss_codes(steps["visits"][dataset.episodes.offsets[:-1]])
    told = Counts.over(dataset.episodes.last().tolist(), "codes read again", rows.rows)
    for row, last in enumerate(told):
        where, goal = f"episode {dataset.numbers[row]}", str(wanted[row])
        if str(shown[row]) != goal:
            yield f"{where}: its goal shows {str(shown[row])!r}, not {goal!r}"
        second, step = pyknotid_code(points[last].astype(np.float64)).chiral, rows["length"][row]
        if second != (first := str(chiral[last])):
            yield f"{where}, step {step}: pyknotid reads {second!r}, the file says {first!r}"
        here, there = (knot_type(GaussCode.parse(code)) for code in (str(begins[row]), goal))
        if here != there:
            why = "no pull changes the knot type"
            yield f"{where}: starts as {here}, and its goal is {there}: {why}"
        elif begins[row] == goal and goal:
            yield f"{where}: starts in its goal's code"


def _split_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes whose start or goal isn't of the task's split.

    They are compared with the states that the task resets from. A single episode file whose states
    aren't found is skipped; a dataset without its states is a fault.
    """
    try:
        batch = EpisodeBatch(dataset.found_task)
    except KnotgymError as error:
        skipped = isinstance(error, MissingFile) and dataset.metadata is None
        return [] if skipped else [f"{dataset.path}: its split can't be checked: {error}"]
    rows, task = dataset.episodes.episodes, dataset.task
    faults: list[str] = []
    for name, states in (("start", batch.starts), ("goal", batch.goals)):
        allowed = set(batch.rows[name].tolist())
        for row, named in enumerate(rows[name].tolist()):
            if not 0 <= named < len(states):
                fault = f"its {name} is row {named}, of {len(states)} states"
            elif named not in allowed:
                fault = f"its {name} is row {named}, none of those of the {task.split} split"
            elif name == "start":
                fault = _start_fault(batch, rows["start_qpos"][row], rows["seed"][row], named)
            elif "goal_points" in rows and not np.array_equal(
                rows["goal_points"][row], states.points[named].astype(np.float32)
            ):
                fault = f"its goal isn't row {named} of the states, as the column goal says"
            else:
                continue
            faults += [f"{dataset.path}, episode {row}: {fault}"] if fault else []
    return faults


def shared_faults(
    points: Array, split: NDArray[np.str_], ropes: Sequence[Hashable], numbers: Sequence[int]
) -> Iterator[str]:
    """Yield what splits share: near-duplicates, and frames of one rope.

    Args:
        points: float64 (n, beads, 3), metres; rows that aren't finite or are huge are passed over.
        split: (n,).
        ropes: of each row, the rope that it is a frame of.
        numbers: of the rows.
    """

    def _both(row: int, other: int) -> str:
        return f"rows {numbers[row]} ({split[row]}) and {numbers[other]} ({split[other]})"

    sound = (np.abs(points) < _HUGE).all(axis=(1, 2))
    for split_name, other in combinations(sorted(set(split.tolist()), reverse=True), 2):
        rows, others = (np.flatnonzero(sound & (split == name)) for name in (split_name, other))
        for i, k, apart in pairs_within(points[others], points[rows]):
            yield (
                f"{_both(rows[k], others[i])} are near-duplicates: {1000 * apart:.1f} mm apart at"
                " the best symmetry"
            )
    for other, row in repeated(ropes):
        if split[other] != split[row]:
            yield f"{_both(other, row)} come from one rope"


def _duplicate_faults(dataset: EpisodeDataset) -> list[str]:
    """List the episodes with the same start, goal and pulls, bit for bit, as an earlier one.

    Without reset noise two seeds may give the same episode; then only a repeated seed is a fault.
    """
    digests, seeds = dataset.episodes.digests(), dataset.episodes.episodes["seed"].tolist()
    free = bool(dataset.task.reset_noise)
    keys = [(digest, None if free else seed) for digest, seed in zip(digests, seeds, strict=True)]
    return [
        f"{dataset.path}, episode {row}: the same as episode {earlier}, start, goal and pulls"
        for earlier, row in repeated(keys)
    ]


def _start_fault(batch: EpisodeBatch, qpos: Array, seed: int, named: int) -> str:
    """Say why a start isn't that of the row `named`, "" if it may be.

    Only strong noise leads far from that row. Then the start is near no state of another split, and
    it is the one that the episode's seed draws, unless the seed isn't known or drew a task first.
    """
    points, states, split = batch.simulation.rope.points(qpos), batch.starts, batch.task.split
    lies = Spectra.of(points[None])
    if lies.turned_distances(Spectra.of(states.points[[named]])) < _MATCH:
        return ""
    mine = np.concatenate([states.rows(nx, split) for nx in set(states.nx.tolist())])
    apart = lies.turned_distances(Spectra.of(states.points))[0]
    apart[mine] = np.inf
    row = int(apart.argmin())
    if apart[row] < _MATCH:
        return f"its start is row {row}, which isn't of the {split} split"
    if seed < 0 or len(batch.task.singles) > 1:
        return ""
    drawn = batch.drawn([int(seed)])
    same = drawn["start"][0] == named and np.abs(drawn["start_qpos"][0] - qpos).max() < _ROUNDING
    return "" if same else f"its start isn't row {named} of the states, as the column start says"


def _protocol_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield the setups of an entry whose episodes aren't all those of its protocol, in order."""
    protocol = dataset.attributes.get("protocol")
    config = protocol.get("config") if isinstance(protocol, dict) else None
    if not isinstance(config, dict):
        return
    seed, count, rows = config.get("seed"), config.get("episodes"), len(dataset)
    if type(seed) is not int or type(count) is not int or not 0 <= count <= rows:
        yield f"{dataset.path}: its protocol has seed {seed!r} and {count!r} episodes of {rows}"
        return
    wanted = [Stream.EVALUATION_EPISODE.derived_seed(seed, number) for number in range(count)]
    for number, (_, part) in enumerate(dataset.setups(), 1):
        if part.episodes.episodes["seed"].tolist() != wanted:
            yield f"{dataset.path}, setup {number}: its episodes aren't those of its protocol"


def _start_faults(dataset: EpisodeDataset) -> Iterator[str]:
    """Yield episodes of a collection that don't begin as the seeds of its run say."""
    run, rows = dataset.attributes.get("run"), dataset.episodes.episodes
    if not isinstance(run, dict) or not isinstance(config := run.get("config"), dict):
        return
    seed, count, summary = config.get("seed"), config.get("episodes"), run.get("summary")
    if config.get("steps"):  # takes the place of `episodes`; as many were played as it took
        count = summary.get("played") if isinstance(summary, dict) else None
    if type(seed) is not int or type(count) is not int or not 0 <= count <= _MOST_EPISODES:
        yield f"{dataset.path}: its run had seed {seed!r} and {count!r} episodes, not two numbers"
        return
    # a collection may keep successes alone: then its seeds are some of these
    of_run = [Stream.EPISODE.derived_seed(seed, number) for number in range(count)]
    batch = EpisodeBatch(dataset.found_task)
    for first in range(0, rows.rows, _BLOCK):
        some = np.arange(first, min(first + _BLOCK, rows.rows))
        block = rows.take(some)
        # begun again as the run began them, which draws start, goal and noise from the seed
        drawn = batch.drawn(block["seed"].clip(0).tolist())
        off = np.abs(drawn["start_qpos"] - block["start_qpos"]).max(axis=1)
        wrong = {
            "its seed is none of the run's": ~np.isin(block["seed"], of_run),
            "its seed draws another start": drawn["start"] != block["start"],
            "its seed draws another goal": drawn["goal"] != block["goal"],
            "its seed draws another noise of the start": off > _ROUNDING,
        }
        for row, faulty in zip(some.tolist(), zip(*wrong.values(), strict=True), strict=True):
            if any(faulty):
                number = dataset.numbers[row]
                yield f"{dataset.path}, episode {number}: {[*wrong][faulty.index(True)]}"
