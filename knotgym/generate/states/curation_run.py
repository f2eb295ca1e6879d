"""The main job: search, make, judge, choose, write.

It goes in cycles: a round of the search, aims at what it doesn't meet, then a wave of candidates of
the codes still wanted. Everything it does depends on the configuration and the seed alone. After
each cycle its state can be saved, and a job resumed from there goes on as if nothing had happened.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from knotgym.control.planner import PlannerConfig
from knotgym.errors import KnotgymError
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.candidates import (
    Candidate,
    CandidateConfig,
    CandidateTask,
    make_candidate,
)
from knotgym.generate.states.code_frequencies import FrequencyConfig, empirical_shares
from knotgym.generate.states.curation import codes_of, is_near_duplicate
from knotgym.generate.states.curves import knot_curve
from knotgym.generate.states.search import SearchConfig, SearchSettings, advance, new_archive
from knotgym.generate.states.targeted_search import Target, reach
from knotgym.rope import Array, Rope
from knotgym.runs.executors import Pool
from knotgym.runs.shards import Shard
from knotgym.streams import Stream, derived_seed, generator, key
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import knot_type

MOST_NX = 6
MORE_ROUNDS = 4  # of search in a cycle while none of what lacks is known
AIMS = 8  # codes aimed at in a cycle whose search found fewer new classes than that
# candidates of a code, none of them accepted, after which it is aimed at again, to set out from
# elsewhere
STUCK = 48


class InvalidJob(KnotgymError, ValueError):
    """A job that cannot be done as asked."""


class NotEnough(KnotgymError, RuntimeError):
    """The attempts allowed were spent before everything asked for was there."""


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """What states are wanted.

    Attributes:
        nx: crossing numbers, each curated on its own.
        count: states for each of them, as many distinct codes among them as there are.
        every_code: instead of count, so many states of every code; 0 for count.
        balance: "even" over codes and chirality, or "empirical": codes as often as a random policy
            meets them.
        split_by: "state", or "code" for splits that share no code.
        train_share: of the states (or codes) that are for training.
        knot: type of the rope's knot; "0_1" starts from the plain loop, any other name or file as
            `curves.knot_curve`.
        seed: of everything.
        attempts: candidates tried, for each state wanted, before giving up.
        cycles: of search and a wave of candidates, after which what there is is enough; 0 to go on
            until all wanted is there.
        wave: candidates made in a cycle.
        candidate: how they are made and judged.
        planner: what is spent on a code aimed at.
        search: how codes are searched for.
        frequencies: how codes are counted for the empirical balance.
        part: of the run, which curates its share of the states and of the codes.
    """

    nx: tuple[int, ...] = (3,)
    count: int = 40
    every_code: int = 0
    balance: str = "even"
    split_by: str = "state"
    train_share: float = 0.5
    knot: str = "0_1"
    seed: int = 0
    attempts: int = 100
    cycles: int = 0
    wave: int = 48
    candidate: CandidateConfig = CandidateConfig()
    planner: PlannerConfig = PlannerConfig(budget=3000)
    search: SearchSettings = SearchSettings()
    frequencies: FrequencyConfig = FrequencyConfig()
    shard: Shard = Shard()

    def __post_init__(self) -> None:
        if (
            not self.nx
            or any(not 0 <= nx <= MOST_NX for nx in self.nx)
            or len(set(self.nx)) != len(self.nx)
        ):
            raise InvalidJob(
                f"nx takes different numbers of crossings from 0 to {MOST_NX}, got"
                f" {', '.join(map(str, self.nx)) or 'none'}"
            )
        for name in ("count", "attempts", "wave"):
            if getattr(self, name) < 1:
                raise InvalidJob(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("every_code", "cycles"):
            if getattr(self, name) < 0:
                raise InvalidJob(f"{name} must be at least 0, got {getattr(self, name)}")
        if self.balance not in ("even", "empirical"):
            raise InvalidJob(f'balance must be "even" or "empirical", got {self.balance!r}')
        if self.split_by not in ("state", "code"):
            raise InvalidJob(f'split_by must be "state" or "code", got {self.split_by!r}')
        if not 0 <= self.train_share <= 1:
            raise InvalidJob(f"train_share must be in [0, 1], got {self.train_share}")
        if self.seed < 0:
            raise InvalidJob(f"seed must be at least 0, got {self.seed}")


@dataclass
class Job:
    """A job under way.

    Attributes:
        config: what is wanted.
        archive: of the search.
        knot: the certified type of the rope's knot.
        existing: nx -> how many codes, without chirality, there are.
        shares: nx -> code -> states wanted of it at most.
        accepted: nx -> candidates, in the order of acceptance.
        rejected: nx -> reason -> how many.
        tried: nx -> code -> orders given.
        aimed: code -> how often the planner was sent there.
        cycle: cycles done.
        actions: environment steps made for aims and candidates (the search's are in the archive).
        growth: one row a cycle: steps of search, aims and candidates together by then, and nx ->
            codes known, states accepted.
        seconds: spent so far, over all sittings.
    """

    config: GenerateConfig
    archive: Archive
    knot: str = "0_1"
    existing: dict[int, int] = field(default_factory=dict)
    shares: dict[int, dict[GaussCode, int]] = field(default_factory=dict)
    accepted: dict[int, list[Candidate]] = field(default_factory=dict)
    rejected: dict[int, Counter[str]] = field(default_factory=dict)
    tried: dict[int, Counter[GaussCode]] = field(default_factory=dict)
    aimed: Counter[GaussCode] = field(default_factory=Counter)
    cycle: int = 0
    actions: int = 0
    growth: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0

    @classmethod
    def begin(cls, config: GenerateConfig, archive: Archive | None = None) -> Job:
        """A job from the start, with an archive to go on from or a new one.

        Raises:
            InvalidJob: there are no such states.
        """
        start = start_of(config)
        knot = knot_type(label(start))
        if knot == "unknown":
            raise InvalidJob(
                f"the knot type of {config.knot} cannot be certified: knots of up to 7"
                " crossings can"
            )
        fresh = new_archive(search_config(config), None if config.knot == "0_1" else start)
        if archive is not None and _origin(archive) != _origin(fresh):
            raise InvalidJob(
                "the archive's ways begin at another curve or move another rope than those of knot"
                f" {config.knot} here"
            )
        job = cls(config, archive or fresh, knot)
        for nx in config.nx:
            job.existing[nx] = len(codes_of(knot, nx))
            job.shares[nx] = _dealt(config, nx, _shares(config, knot, nx))
            job.accepted[nx], job.rejected[nx], job.tried[nx] = [], Counter(), Counter()
        if not any(job.wanted(nx) for nx in config.nx):
            raise InvalidJob(
                f"shard {config.shard} has no state to make: cut the run into fewer shards"
            )
        return job

    def wanted(self, nx: int) -> int:
        """States asked for with nx crossings."""
        return (
            sum(self.shares[nx].values())
            if self.config.every_code
            else len(self.config.shard.share(self.config.count))
        )

    def wanted_codes(self, nx: int) -> int:
        """Codes with nx crossings to have a choice among: all for `every_code`, else a quarter more
        than states.
        """
        return (
            len(self.shares[nx])
            if self.config.every_code
            else min(len(self.shares[nx]), max(1, int(1.25 * self.wanted(nx))))
        )

    def steps(self) -> int:
        """Environment steps made so far, by the search, for aims and for candidates."""
        return self.actions + (self.archive.growth[-1]["actions"] if self.archive.growth else 0)

    def done(self) -> bool:
        """Whether everything asked for is there, or the cycles allowed are over."""
        config = self.config
        return (
            all(len(self.accepted[nx]) >= self.wanted(nx) for nx in config.nx)
            or 0 < config.cycles <= self.cycle
        )


def run(job: Job, pool: Pool, each_cycle: Callable[[Job], None]) -> None:
    """Go on with a job until it is done, calling back after every cycle.

    Raises:
        NotEnough: the attempts are spent.
    """
    config = job.config
    search = search_config(config)
    while not job.done():
        began = time.perf_counter()
        fresh: dict[GaussCode, Elite] = {}
        if sum(advance(job.archive, search, pool) for _ in range(_rounds(job))) < AIMS:
            targets = _targets(job, search)
            for target, shot in zip(targets, pool.map(reach, targets), strict=True):
                job.actions += shot.spent
                for elite in shot.elites:
                    job.archive.offer(elite, search.archive)
                    if elite.exact:
                        fresh[target.goal] = elite
        tasks = _tasks(job, fresh)
        for (nx, _), candidate in zip(
            tasks, pool.map(make_candidate, [order for _, order in tasks]), strict=True
        ):
            job.actions += candidate.steps
            _judge(job, nx, candidate)
        job.cycle += 1
        known = {str(nx): len(job.archive.codes(nx)) for nx in config.nx}
        job.growth.append(
            {
                "steps": job.steps(),
                "known": known,
                "accepted": {str(nx): len(job.accepted[nx]) for nx in config.nx},
            }
        )
        job.seconds += time.perf_counter() - began
        each_cycle(job)
        for nx in config.nx:
            have, tried = len(job.accepted[nx]), sum(job.tried[nx].values())
            if (
                have < job.wanted(nx)
                and not job.done()
                and max(tried, 8 * job.cycle) >= config.attempts * job.wanted(nx)
            ):
                raise NotEnough(
                    f"{have} of {job.wanted(nx)} states with nx = {nx} accepted in {tried}"
                    " attempts; use --resume and more --attempts"
                )
    if not any(job.accepted.values()):
        raise NotEnough(f"no state accepted in {job.cycle} cycles; use --resume and more --cycles")


def _rounds(job: Job) -> int:
    """Rounds of the search in the next cycle: one, and up to MORE_ROUNDS more the more of the codes
    still lacking aren't known either.
    """
    missing = [0.0]
    for nx in job.config.nx:
        lacking = job.wanted_codes(nx) - len({one.code.plain for one in job.accepted[nx]})
        unknown = job.wanted_codes(nx) - len(job.archive.codes(nx))
        missing.append(min(1.0, max(0, unknown) / max(1, lacking)))
    return 1 + round(MORE_ROUNDS * max(missing)) if max(job.config.nx) else 0


def _targets(job: Job, search: SearchConfig) -> list[Target]:
    """Codes that no way short enough to go on with is sure to lead to, or whose candidates are
    stuck.

    Those that lack states come first, then those aimed at least, then the unknown.
    """
    config, start, lacking = job.config, start_of(job.config), []
    for nx, shares in job.shares.items():
        have = Counter(candidate.code.plain for candidate in job.accepted[nx])
        stuck = {
            code
            for code in shares
            if have[code] < shares[code] and job.tried[nx][code] >= STUCK * (1 + job.aimed[code])
        }
        sure = {
            code
            for code in shares
            if any(
                job.archive.sure(one, search.longest) for one in job.archive.known_chiralities(code)
            )
        } - stuck
        if not nx or len(job.accepted[nx]) >= job.wanted(nx) or len(sure) >= job.wanted_codes(nx):
            continue
        for index, code in enumerate(shares):
            if code not in sure:
                aimed = job.aimed[code]
                target = Target(
                    search,
                    config.planner,
                    start,
                    code,
                    key(Stream.TARGETED_SEARCH, search.seed, nx, index, aimed),
                )
                lacking.append(
                    (
                        (
                            have[code] >= shares[code],
                            aimed,
                            bool(job.archive.known_chiralities(code)),
                            index,
                        ),
                        target,
                    )
                )
    chosen = [target for _, target in sorted(lacking, key=lambda one: one[0])[:AIMS]]
    job.aimed.update(target.goal for target in chosen)
    return chosen


def search_config(config: GenerateConfig) -> SearchConfig:
    """The search that a job runs; it also keeps what shows as many crossings as the start."""
    seed = (
        config.seed
        if config.shard.is_whole
        else derived_seed(Stream.SHARD, config.seed, config.shard.number)
    )
    return SearchConfig(
        **vars(config.search),
        max_nx=max(*config.nx, label(start_of(config)).nx),
        seed=seed,
        rope=config.candidate.rope,
    )


def start_of(config: GenerateConfig) -> Array:
    """The configuration (beads, 3) that all ways begin at: the plain loop, or a curve of the
    knot.
    """
    rope = Rope(config.candidate.rope)
    return rope.loop() if config.knot == "0_1" else rope.from_curve(knot_curve(config.knot))


def _origin(archive: Archive) -> str:
    """Where the ways of an archive begin and what they move, as text: a file has lists where a
    search has tuples.
    """
    return json.dumps([archive.settings.get("start"), archive.settings.get("rope")], sort_keys=True)


def _shares(config: GenerateConfig, knot: str, nx: int) -> dict[GaussCode, int]:
    """How many states of each code are wanted at most; of an even share, rounded up, the first
    accepted fill the count.
    """
    known = codes_of(knot, nx)
    if not known:
        raise InvalidJob(f"no diagram of {knot} has {nx} crossings")
    if config.every_code:
        return dict.fromkeys(known, config.every_code)
    if config.balance == "empirical":
        if knot != "0_1":
            raise InvalidJob(
                f"empirical balance is known for ropes that start as a plain loop, not as {knot}"
            )
        return empirical_shares(
            nx, config.count, config.seed, config.candidate.rope, config.frequencies
        )
    return dict.fromkeys(known, -(-config.count // len(known)))


def _dealt(config: GenerateConfig, nx: int, shares: dict[GaussCode, int]) -> dict[GaussCode, int]:
    """Of these shares what falls to this part of the run: whole codes while there are as many as
    parts.
    """
    if config.shard.is_whole:
        return shares
    order = generator(Stream.SHARD_CODES, config.seed, nx).permutation(len(shares))
    codes = [list(shares)[k] for k in order]
    wanted = [code for copy in range(max(shares.values())) for code in codes if shares[code] > copy]
    mine = Counter(config.shard.dealt(wanted))
    return {code: mine[code] for code in shares if mine[code]}


def _tasks(job: Job, fresh: dict[GaussCode, Elite]) -> list[tuple[int, CandidateTask]]:
    """A wave: codes that lack states, those tried least first, in an order that the seed decides;
    those just aimed at set out from there.
    """
    config = job.config
    start = start_of(config)
    out: list[tuple[int, CandidateTask]] = []
    open_nx = [nx for nx in config.nx if len(job.accepted[nx]) < job.wanted(nx)]
    for nx in open_nx:
        have = Counter(candidate.code.plain for candidate in job.accepted[nx])
        share = list(job.shares[nx])
        ranked = [
            share[k] for k in generator(Stream.CODE_ORDER, config.seed, nx).permutation(len(share))
        ]
        if (
            not config.every_code
        ):  # of more codes than are wanted, a quarter more are tried; the window widens with time
            ranked = ranked[: job.wanted_codes(nx) + 2 * job.cycle]
        lacking = [
            (code, known)
            for code in ranked
            if have[code] < job.shares[nx][code] and (known := job.archive.known_chiralities(code))
        ]
        lacking.sort(key=lambda one: job.tried[nx][one[0]])
        for k in range(-(-config.wave // len(open_nx)) if lacking else 0):
            code, known = lacking[k % len(lacking)]
            number, index = job.tried[nx][code], share.index(code)
            if number % 3:  # the chiralities that an exact way leads to, two times of three
                known = [one for one in known if job.archive.sure(one)] or known
            job.tried[nx][code] += 1
            # not all begin with the same handedness
            first = int(generator(Stream.CHIRALITY, config.seed, nx, index).integers(2**nx))
            target = fresh[code].code if code in fresh else known[(number + first) % len(known)]
            elites = (fresh[code],) if code in fresh else tuple(job.archive.leading_to(target))
            seed = key(Stream.CANDIDATE, config.seed, nx, index, config.shard.first + number)
            out.append((nx, CandidateTask(config.candidate, target, elites, start, seed)))
    return out


def _judge(job: Job, nx: int, candidate: Candidate) -> None:
    """Accept a candidate, or count why not."""
    reasons = list(candidate.faults)
    if not reasons and knot_type(candidate.code) != job.knot:
        reasons = ["knot type changed"]
    if not reasons and is_near_duplicate(
        candidate.points[-1], [one.points[-1] for one in job.accepted[nx]]
    ):
        reasons = ["near-duplicate"]
    for elite in candidate.elites:
        job.archive.offer(elite, job.config.search.archive)
    candidate = replace(candidate, elites=())
    same = sum(one.code.plain == candidate.code.plain for one in job.accepted[nx])
    if reasons:
        job.rejected[nx].update(reasons)
    elif same < job.shares[nx][candidate.code.plain] and len(job.accepted[nx]) < job.wanted(nx):
        job.accepted[nx].append(candidate)
