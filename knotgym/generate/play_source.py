"""States met by play: frames of ropes that random and scripted policies pull.

Ropes are pulled side by side in phases, and frames that pass the filter are kept: readable, not
over-twisted, new. All frames of a rope are in one split. Source random-walk is the same with the
published pulls, uniform random actions, and without limits on readability.

    settle | random | opening | scripted | spreading | scripted | spreading | ...
           ^ the rope is laid at rest, and its record begins; every few pulls a frame is seen

Opening and spreading pull random beads out of a tangle, so that ropes become loose and readable,
which random actions alone never leave them.

After a change run `python benchmarks/golden.py --compare tests/data/golden.json`: nothing may
differ.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from knotgym.common import Array, Failed, Ids, Stream, Table
from knotgym.control import Player, Policy, PolicyConfig, Pulls, make_policy, rollouts
from knotgym.datasets import Episodes
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.generate.generate_config import GenerateConfig, PlayConfig
from knotgym.generate.state_rows import Selection, judge, report_of, row_of, with_report
from knotgym.rope import Rope, drawn_actions, quantized
from knotgym.runs import Call, Recipe, Result
from knotgym.states import SOURCES, STATE_SPLITS
from knotgym.topology import UNKNOT, GaussCode, codes_of, label_many

# A spreading pull flees from strands nearer than _REACH in the picture, metres, and at least _APART
# beads away along the rope. Of _DRAWN beads, it pulls the one that is pushed away most.
_REACH, _APART, _DRAWN = 0.06, 6, 8
_SLOPE = 0.1  # most upward or downward part of a pull, in units of the largest force

BeadsAndForces = tuple[Ids, NDArray[np.floating]]

_CALLS = 4  # between two looks at what is still missing
# A code may have this many times its even share of the states of an nx and split, and at least
# _LEAST: common codes would crowd out the others.
_UNEVEN, _LEAST = 1.6, 2
_READABLE = "play"  # the source whose states are readable, and of many codes


class _Frame(NamedTuple):
    """A rope as it lies after some pulls; its velocity isn't kept.

    Attributes:
        rope: its number in the call.
        step: pulls of the record before it.
        qpos: float64 (nq,).
        points: float64 (beads, 3), metres.
    """

    rope: int
    step: int
    qpos: Array
    points: Array


class PhasedPulls(Policy):
    """A policy that pulls ropes in phases, and the frames of them that it saw.

    Attributes:
        name: of the policy.
        config: the phases.
        keys: of the ropes' random streams.
        start_qpos: float64 (ropes, nq), where the records begin, at rest.
        actions: float32 (ropes, pulls, 6), each at the position of the bead that it pulls.
        frames: of all ropes, in order of steps.
    """

    name = "phases"

    def __init__(
        self, config: PlayConfig, keys: Sequence[tuple[int, ...]], start_qpos: Array
    ) -> None:
        self.config, self.keys, self.start_qpos = config, keys, start_qpos
        self.frames: list[_Frame] = []
        self.actions = np.zeros((len(keys), config.pulls, 6), dtype=np.float32)

    @staticmethod
    def coil(rope: Rope) -> Array:
        """Return a coil of two turns, one crossing, radius of gyration 0.11 m, as (beads, 3)."""
        at = np.linspace(0, 2 * np.pi, 400, endpoint=False)
        # a torus curve (2, 1): twice round the hole, once through it
        radius = 1 + 0.25 * np.cos(at)
        curve = [radius * np.cos(2 * at), radius * np.sin(2 * at), 0.25 * np.sin(at)]
        return rope.from_curve(np.stack(curve, axis=1))

    def compatible_task(self, task: TaskConfig) -> TaskConfig:
        return task

    def player(self, batch: EpisodeBatch) -> "_PhasePlayer":
        return _PhasePlayer(self, batch)

    def play(self, engine: str) -> "PhasedPulls":
        """Play the rollouts once, side by side."""
        starts = Episodes.to_begin(self.start_qpos, np.arange(len(self.keys)))
        # which goal an endless task has makes no difference; one pull more shows the last frame
        horizon = self.config.pulls + 1
        task = TaskConfig(task="unknot", nx=1, engine=engine, endless=True, horizon=horizon)
        rollouts(self, task, starts, lanes=len(self.keys), keep=None)
        return self


def _pulled_ropes(config: PlayConfig, engine: str, keys: Sequence[tuple[int, ...]]) -> PhasedPulls:
    """Pull ropes in phases, side by side; each rollout depends on its own key alone.

    Args:
        config: the phases.
        engine: that moves the ropes.
        keys: of the ropes' random streams. If the record consists of random actions, these are
            `drawn_actions(key, config.random)`.
    """
    rope = Rope()
    start = np.repeat(rope.qpos(PhasedPulls.coil(rope))[None], len(keys), axis=0)
    if config.settle:
        usual = {"settle": 0, "opening": 0, "rounds": 0, "every": 1}
        walk = PlayConfig(random=config.settle, first=config.settle, **usual)
        for frame in PhasedPulls(walk, keys, start.copy()).play(engine).frames:
            start[frame.rope] = frame.qpos  # a rope that was lost on the way stays a coil
    return PhasedPulls(config, keys, start).play(engine)


class _PhasePlayer(Player):
    """Plays the phases in each lane, one after the other."""

    def __init__(self, policy: PhasedPulls, batch: EpisodeBatch) -> None:
        self.planned = np.zeros(batch.count, dtype=np.int64)
        self._policy, self._batch = policy, batch
        self._simulation, self._rngs = batch.simulation, dict[int, np.random.Generator]()
        self._drawn = np.zeros((batch.count, policy.config.random, 6), dtype=np.float32)
        self._scripted = make_policy(PolicyConfig(policy="scripted")).player(batch)
        config, phases = policy.config, list[tuple[int, Callable[[Ids], BeadsAndForces]]]()
        phases += [(config.random, self._random), (config.opening, self._open)]
        for _ in range(config.rounds):
            # of the scripted policy's pulls, without the lanes
            phases += [(config.scripted, lambda ids: self._scripted.act(ids)[1:3])]
            phases += [(config.spreading, self._spread)]
        # step after which each phase ends; `searchsorted` finds the phase of a step
        self._ends = np.cumsum([length for length, _ in phases])
        self._phases = [phase for _, phase in phases]

    def begin(self, ids: Ids, rngs: Sequence[np.random.Generator]) -> None:
        for index in ids.tolist():
            key = self._policy.keys[self._batch.number[index]]
            self._drawn[index] = drawn_actions(key, self._policy.config.random)
            actions_key = (*key[:-1], key[-1] + 1)  # actions have their own
            self._rngs[index] = Stream.generator_of(actions_key)
        self._scripted.begin(ids, [self._rngs[index] for index in ids.tolist()])

    def act(self, ids: Ids) -> Pulls:
        steps = self._batch.steps[ids]
        self._see(ids, steps)
        beads = np.zeros(len(ids), dtype=np.int64)
        forces = np.zeros((len(ids), 3), dtype=np.float32)
        # lanes are in different steps, so in different phases: each phase pulls its own
        now = np.searchsorted(self._ends, steps, side="right")
        for phase in np.unique(now[now < len(self._phases)]):  # after the last one ropes rest
            pulled = now == phase
            beads[pulled], forces[pulled] = self._phases[phase](ids[pulled])
        recorded = np.flatnonzero(steps < self._ends[-1])
        some = ids[recorded]
        made = self._simulation.actions(beads[recorded], forces[recorded], some)
        self._policy.actions[self._batch.number[some], steps[recorded]] = made
        return Pulls(ids, beads, forces)

    def _see(self, ids: Ids, steps: Ids) -> None:
        since = steps - self._policy.config.first
        seen = ids[(since >= 0) & (since % self._policy.config.every == 0)]
        if not len(seen):
            return
        columns = self._batch.number[seen].tolist(), self._batch.steps[seen].tolist()
        # where a reset lays the rope; the chain engine's own vertices differ by rounding
        qpos = self._simulation.qpos(seen)
        self._policy.frames += map(_Frame, *columns, qpos, self._simulation.rope.points(qpos))

    def _random(self, ids: Ids) -> BeadsAndForces:
        return self._simulation.read_actions(self._drawn[ids, self._batch.steps[ids]], ids)

    def _open(self, ids: Ids) -> BeadsAndForces:
        """Pull a random bead of each rope away from the rope's middle."""
        points = self._simulation.points[ids]
        beads = np.array([self._rngs[index].integers(points.shape[1]) for index in ids.tolist()])
        away = points[np.arange(len(ids)), beads] - points.mean(axis=1)
        return beads, self._level(away[:, :2], ids)

    def _spread(self, ids: Ids) -> BeadsAndForces:
        """Of a few beads, pull the one that is most crowded in the picture, out of the crowd."""
        points = self._simulation.points[ids]
        count = points.shape[1]
        drawn = np.stack([self._rngs[index].integers(count, size=_DRAWN) for index in ids.tolist()])
        # only the drawn beads against all others: _DRAWN times as many pairs as beads
        at = np.take_along_axis(points, drawn[..., None], axis=1)
        away = at[:, :, None, :2] - points[:, None, :, :2]
        distance = np.sqrt((away**2).sum(axis=-1))
        # distance along the closed rope is the shorter way round
        along = np.abs(np.arange(count) - drawn[..., None])
        near = (np.minimum(along, count - along) >= _APART) & (distance < _REACH)
        # each near bead pushes along `away`; the nearer, the more
        push = np.where(near, (1 - distance / _REACH) ** 2 / np.maximum(distance, 1e-4), 0.0)
        total = (away * push[..., None]).sum(axis=2)
        # of the drawn beads that with the largest push
        rows, most = np.arange(len(ids)), (total**2).sum(axis=-1).argmax(axis=1)
        return drawn[rows, most], self._level(total[rows, most], ids)

    def _level(self, away: Array, ids: Ids) -> NDArray[np.float32]:
        """Return full forces in the directions (n, 2), seen from above, with some slope."""
        # a bead that nothing pushes has no direction: then the force is the slope alone
        size = np.maximum(np.sqrt((away**2).sum(axis=1, keepdims=True)), 1e-9)
        slopes = [self._rngs[index].uniform(-_SLOPE, _SLOPE) for index in ids.tolist()]
        return quantized(np.column_stack([away / size, slopes])).astype(np.float32)


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
    ropes, selection, pulled = _pulls_of(config).ropes, Selection(apart_from), 0
    have, of_code = Counter[tuple[int, str]](), Counter[tuple[str, GaussCode]]()
    train = int(np.floor(config.count * config.train_share + 0.5))
    # states of each number of crossings
    wanted = dict(zip(STATE_SPLITS, (train, config.count - train), strict=True))
    while lacking := [
        (nx, split) for nx in config.nx for split in STATE_SPLITS if have[nx, split] < wanted[split]
    ]:
        if pulled >= config.attempts * config.count:
            named = ", ".join(f"nx {nx} {split}" for nx, split in lacking)
            raise Failed(
                f"states are missing for {named} after {pulled} ropes; give --resume with a larger"
                " --set attempts=N"
            )
        calls = [
            Call(f"pulling ropes {first}", _play, (config, first, tuple(lacking)))
            for first in range(pulled, pulled + _CALLS * ropes, ropes)
        ]
        pulled += _CALLS * ropes
        for result in (yield calls):
            rows, reasons = report_of(result)
            for nx, each in reasons:
                selection.rejected[nx].update(each)
            for row, rope in enumerate(rows["source/trajectory"].tolist()):
                code = GaussCode.parse(str(rows["gauss_code"][row]))
                split = _split_of(config, rope)
                even = wanted[split] / len(codes_of(UNKNOT, code.nx))
                most = max(_LEAST, _UNEVEN * even) if config.source == _READABLE else np.inf
                if have[code.nx, split] >= wanted[split] or of_code[split, code] >= most:
                    continue
                if selection.offer(rows, row):
                    have[code.nx, split] += 1
                    of_code[split, code] += 1
    report.update(
        existing_codes={str(nx): len(codes_of(UNKNOT, nx)) for nx in config.nx},
        attempts=pulled,
        rejected=selection.reasons(config.nx),
    )
    return selection.rows()


def _split_of(config: GenerateConfig, rope: int) -> str:
    """Return the split of a rope's states; ropes alternate to match `train_share`."""
    before, after = (int(np.floor(k * config.train_share + 0.5)) for k in (rope, rope + 1))
    return STATE_SPLITS[0] if after > before else STATE_SPLITS[1]


def splits_of(config: GenerateConfig, rows: Table) -> NDArray[np.str_]:
    """Return the split of each row, that of its rope."""
    return np.array([_split_of(config, rope) for rope in rows["source/trajectory"].tolist()])


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
    stream = SOURCES[config.source].stream
    assert stream is not None
    keys = [stream.key(config.seed, rope) for rope in ropes]
    pulled = _pulled_ropes(pulls, config.engine_used, keys)
    played = config.source == _READABLE
    limits = [config.limits, config.twist] if played else [config.twist]
    rejected = {nx: Counter[str]() for nx in config.nx}
    states_of, rows = Counter[tuple[int, int]](), list[dict[str, Any]]()
    codes = label_many(np.array([frame.points for frame in pulled.frames])) if pulled.frames else []
    for frame, code in zip(pulled.frames, codes, strict=True):
        rope = ropes[frame.rope]
        wanted = (code.nx, _split_of(config, rope)) in lacking
        if not wanted or states_of[rope, code.nx] == pulls.per_rope:
            continue
        judgement = judge(frame.points, limits)
        rejected[code.nx].update(judgement.faults)
        if judgement.faults:
            continue
        states_of[rope, code.nx] += 1
        start, seed = pulled.start_qpos[frame.rope], np.array(keys[frame.rope])
        made = {"start_qpos": start, "steps": frame.step, "seed": seed}
        made |= {"policy": config.source, "trajectory": rope}
        if played:  # those of a random walk follow from its key
            made["actions"] = pulled.actions[frame.rope, : frame.step]
        rows.append(row_of(judgement, frame.points, frame.qpos, **made))
    rows.sort(key=lambda row: (row["source/trajectory"], row["source/steps"]))
    return with_report(rows, list(rejected.items()))
