"""Curation by play: search, make candidates, judge, choose.

It goes in cycles: rounds of the search, targeted searches for what it doesn't meet, then a wave of
candidates of the codes still wanted. All it does depends on the configuration, the shard and the
seed alone. After each cycle it can be saved, and goes on from there as if nothing had happened.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from knotgym.common.streams import Stream, derived_seed, generator, key
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.candidates import Candidate, CandidateTask, make_candidate
from knotgym.generate.states.code_frequencies import empirical_shares
from knotgym.generate.states.curation import is_near_duplicate, most_unlike
from knotgym.generate.states.curves import knot_curve
from knotgym.generate.states.generate_config import GenerateConfig, InvalidGenerateConfig
from knotgym.generate.states.search import SearchConfig, new_archive, search_round
from knotgym.generate.states.targeted_search import Target, TargetPlan, reach
from knotgym.rope.model import Array, Rope
from knotgym.runs.engine import CHECKPOINT, Batch
from knotgym.runs.run_options import NotEnough
from knotgym.runs.shards import Shard
from knotgym.topology.crossings import label
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT
from knotgym.topology.knots import codes_of, knot_type


@dataclass
class CurationRun:
    """A run under way.

    Attributes:
        config: what is wanted.
        archive: of the search.
        shard: of the run, which curates its share of the states and of the codes.
        knot: the certified type of the rope's knot.
        existing: nx -> how many codes, without chirality, there are.
        shares: nx -> code -> states wanted of it at most.
        accepted: nx -> candidates, in the order of acceptance; the set is chosen from them.
        rejected: nx -> reason -> how many.
        tried: nx -> code -> candidates made.
        targeted: code -> targeted searches for it.
        cycle: cycles done.
        actions: environment steps made by targeted searches and candidates; the archive counts the
            search's.
        growth: one row a cycle: environment steps by then, and nx -> codes known, states accepted.
    """

    config: GenerateConfig
    archive: Archive
    shard: Shard = Shard()
    knot: str = "0_1"
    existing: dict[int, int] = field(default_factory=dict)
    shares: dict[int, dict[GaussCode, int]] = field(default_factory=dict)
    accepted: dict[int, list[Candidate]] = field(default_factory=dict)
    rejected: dict[int, Counter[str]] = field(default_factory=dict)
    tried: dict[int, Counter[GaussCode]] = field(default_factory=dict)
    targeted: Counter[GaussCode] = field(default_factory=Counter)
    cycle: int = 0
    actions: int = 0
    growth: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def begin(
        cls, config: GenerateConfig, shard: Shard | None = None, archive: Archive | None = None
    ) -> CurationRun:
        """A run from the start, with an archive to go on from or a new one.

        Raises:
            InvalidGenerateConfig: there are no such states.
        """
        shard, start = shard or Shard(), start_of(config)
        knot = knot_type(label(start))
        if knot == "unknown":
            raise InvalidGenerateConfig(
                f"the knot type of {config.knot} cannot be certified: knots of up to 7 crossings"
                " can"
            )
        fresh = new_archive(search_config(config, shard), None if config.knot == "0_1" else start)
        if archive is not None and _origin(archive) != _origin(fresh):
            raise InvalidGenerateConfig(
                "the archive's action sequences begin at another curve or move another rope than"
                f" those of knot {config.knot} here"
            )
        run = cls(config, archive or fresh, shard, knot)
        run._count_codes()
        least = label(start).nx
        if knot != UNKNOT and min(config.nx) != least:
            raise InvalidGenerateConfig(
                f"the ways to states of {knot} begin at its least diagram here, with {least}"
                f" crossings, which must be among the states: give --nx {least}, or a range from"
                f" {least}"
            )
        for nx in config.nx:
            run.accepted[nx], run.rejected[nx], run.tried[nx] = [], Counter(), Counter()
        if not any(run.wanted(nx) for nx in config.nx):
            raise InvalidGenerateConfig(
                f"shard {shard} has no state to make: cut the run into fewer shards"
            )
        return run

    def _count_codes(self) -> None:
        """What follows from the configuration and the shard: the codes there are and wanted."""
        for nx in self.config.nx:
            self.existing[nx] = len(codes_of(self.knot, nx))
            self.shares[nx] = _dealt(
                self.config, self.shard, nx, _shares(self.config, self.knot, nx)
            )

    def wanted(self, nx: int) -> int:
        """States asked for with nx crossings."""
        return (
            sum(self.shares[nx].values())
            if self.config.every_code
            else len(self.shard.share(self.config.count))
        )

    def needed(self, nx: int) -> dict[GaussCode, int]:
        """How many accepted states of each code there are to be, those to choose from included."""
        shares, choice = self.shares[nx], self.config.choice
        spare = self.config.most_spare // max(1, len(shares))
        return {
            code: min(choice * share, share + spare) if share > 1 else share
            for code, share in shares.items()
        }

    def lacking(self, nx: int) -> int:
        """Accepted states that there are to be yet."""
        needed = self.needed(nx)
        beyond = sum(needed.values()) - sum(self.shares[nx].values())
        return self.wanted(nx) + beyond - self._within(nx, needed)

    def short(self, nx: int) -> int:
        """States that the set lacks yet."""
        return self.wanted(nx) - self._within(nx, self.shares[nx])

    def _within(self, nx: int, most: dict[GaussCode, int]) -> int:
        have = Counter(candidate.code.plain for candidate in self.accepted[nx])
        return sum(min(count, most[code]) for code, count in have.items())

    def chosen(self, nx: int) -> list[Candidate]:
        """The set: of what is accepted the states most unlike each other, codes as even as before,
        in the order of acceptance.
        """
        accepted = self.accepted[nx]
        rows = most_unlike(
            [one.points[-1] for one in accepted],
            [one.code for one in accepted],
            self.shares[nx],
            self.wanted(nx),
        )
        return [accepted[row] for row in rows]

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
        """Environment steps made so far, by whatever made them."""
        return self.actions + (self.archive.growth[-1]["actions"] if self.archive.growth else 0)

    def done(self) -> bool:
        """Whether everything asked for is there, or the cycles allowed are over."""
        config = self.config
        return all(self.has_enough(nx) for nx in config.nx) or 0 < config.cycles <= self.cycle

    def has_enough(self, nx: int) -> bool:
        """Whether the set is there, and what it is chosen from too, or the attempts at it spent."""
        return self.lacking(nx) <= 0 or (self.short(nx) <= 0 and self._spent(nx))

    def _spent(self, nx: int) -> bool:
        tried = sum(self.tried[nx].values())
        return max(tried, 8 * self.cycle) >= self.config.attempts * self.wanted(nx)

    def batches(self) -> Iterator[Batch]:
        """The work of one cycle after the other until all is there, absorbed into this run.

        Raises:
            NotEnough: the attempts are spent.
        """
        while not self.done():
            yield from self._cycle()
            self.cycle += 1
            self.growth.append(
                {
                    "steps": self.steps(),
                    "known": {str(nx): len(self.archive.codes(nx)) for nx in self.config.nx},
                    "accepted": {str(nx): len(self.accepted[nx]) for nx in self.config.nx},
                }
            )
            yield CHECKPOINT
            self._require_hope()
        if not any(self.accepted.values()):
            raise NotEnough(
                f"no state accepted in {self.cycle} cycles; use --resume and more --cycles"
            )

    def _cycle(self) -> Iterator[Batch]:
        search, known = search_config(self.config, self.shard), len(self.archive.niches)
        for _ in range(_rounds(self)):
            yield from search_round(self.archive, search)
        fresh: dict[GaussCode, Elite] = {}
        if len(self.archive.niches) - known < self.config.targets:

            def absorb(target: Target, found: TargetPlan) -> None:
                self.actions += found.spent
                for elite in found.elites:
                    self.archive.offer(elite, search.archive)
                    if elite.exact:
                        fresh[target.goal] = elite

            yield Batch(reach, _targets(self, search), absorb, "searching for codes not met")
        tasks = _tasks(self, fresh)
        nx_of = iter([nx for nx, _ in tasks])

        def judge(task: CandidateTask, candidate: Candidate) -> None:
            self.actions += candidate.steps
            _judge(self, next(nx_of), candidate)

        yield Batch(make_candidate, [task for _, task in tasks], judge, "choosing")

    def _require_hope(self) -> None:
        """Raise NotEnough where the attempts allowed for some nx are spent."""
        for nx in self.config.nx:
            short, tried, wanted = self.short(nx), sum(self.tried[nx].values()), self.wanted(nx)
            if short > 0 and self._spent(nx) and not self.done():
                raise NotEnough(
                    f"{wanted - short} of {wanted} states with nx = {nx} accepted in {tried}"
                    " attempts; use --resume and more --attempts"
                )


def _rounds(run: CurationRun) -> int:
    """Rounds of the search in the next cycle.

    One, and up to `more_rounds` more the more of the codes that lack states aren't known either;
    none where only the choice is to grow.
    """
    if all(run.short(nx) <= 0 for nx in run.config.nx):
        return 0
    missing = [0.0]
    for nx in run.config.nx:
        shown = {candidate.code.plain for candidate in run.accepted[nx]}
        lacking = run.wanted_codes(nx) - len(shown)
        unknown = run.wanted_codes(nx) - len(run.archive.codes(nx))
        missing.append(min(1.0, max(0, unknown) / max(1, lacking)))
    return 1 + round(run.config.more_rounds * max(missing)) if max(run.config.nx) else 0


def _targets(run: CurationRun, search: SearchConfig) -> list[Target]:
    """Codes that no sequence short enough is sure to lead to, or whose candidates are stuck.

    Those that lack states come first, then those searched for least, then the unknown.
    """
    config, start = run.config, start_of(run.config)
    ranked: list[tuple[tuple[bool, int, bool, int], Target]] = []
    for nx, shares in run.shares.items():
        have = Counter(candidate.code.plain for candidate in run.accepted[nx])
        uncertain = [code for code in shares if _is_target(run, nx, code, have[code], search)]
        sure = len(shares) - len(uncertain)
        if not nx or run.short(nx) <= 0 or sure >= run.wanted_codes(nx):
            continue
        index_of = {code: index for index, code in enumerate(shares)}
        for code in uncertain:
            index, times = index_of[code], run.targeted[code]
            seed = key(Stream.TARGETED_SEARCH, search.seed, nx, index, times)
            known = bool(run.archive.known_chiralities(code))
            target = Target(search, config.planner, start, code, seed)
            ranked.append(((have[code] >= shares[code], times, known, index), target))
    ranked.sort(key=lambda pair: pair[0])
    chosen = [target for _, target in ranked[: config.targets]]
    run.targeted.update(target.goal for target in chosen)
    return chosen


def _is_target(run: CurationRun, nx: int, code: GaussCode, have: int, search: SearchConfig) -> bool:
    """Whether a code is not surely known, or lacks states and nothing comes of its candidates."""
    stuck = run.tried[nx][code] >= run.config.stuck * (1 + run.targeted[code])
    known = run.archive.known_chiralities(code)
    sure = any(run.archive.sure(chiral, search.longest) for chiral in known)
    return not sure or (stuck and have < run.shares[nx][code])


def search_config(config: GenerateConfig, shard: Shard | None = None) -> SearchConfig:
    """The search of a run; it also keeps what shows as many crossings as the start."""
    seed = config.seed
    if shard is not None and not shard.is_whole:
        seed = derived_seed(Stream.SHARD, config.seed, shard.number)
    most = max(*config.nx, label(start_of(config)).nx)
    return SearchConfig(**vars(config.search), max_nx=most, seed=seed, rope=config.candidate.rope)


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
        raise InvalidGenerateConfig(f"no diagram of {knot} has {nx} crossings")
    if config.every_code:
        return dict.fromkeys(known, config.every_code)
    if config.balance == "empirical":
        if knot != "0_1":
            raise InvalidGenerateConfig(
                f"empirical balance is known for ropes that start as a plain loop, not as {knot}"
            )
        return empirical_shares(
            nx, config.count, config.seed, config.candidate.rope, config.frequencies
        )
    return dict.fromkeys(known, -(-config.count // len(known)))


def _dealt(
    config: GenerateConfig, shard: Shard, nx: int, shares: dict[GaussCode, int]
) -> dict[GaussCode, int]:
    """Of these shares what falls to a shard: whole codes while there are as many as shards."""
    if shard.is_whole:
        return shares
    order = generator(Stream.SHARD_CODES, config.seed, nx).permutation(len(shares))
    codes = [list(shares)[k] for k in order]
    wanted = [code for copy in range(max(shares.values())) for code in codes if shares[code] > copy]
    mine = Counter(shard.dealt(wanted))
    return {code: mine[code] for code in shares if mine[code]}


def _tasks(run: CurationRun, fresh: dict[GaussCode, Elite]) -> list[tuple[int, CandidateTask]]:
    """A wave of candidates, each with its nx: codes that lack states, those tried least first.

    Candidates of codes just found by a targeted search set out from what it found, `fresh`.
    """
    config, start = run.config, start_of(run.config)
    wave: list[tuple[int, CandidateTask]] = []
    open_nx = [nx for nx in config.nx if run.short(nx) > 0]  # the set first, then the choice
    open_nx = open_nx or [nx for nx in config.nx if not run.has_enough(nx)]
    for nx in open_nx:
        lacking = _lacking(run, nx)
        index_of = {code: index for index, code in enumerate(run.shares[nx])}
        for turn in range(-(-config.wave // len(open_nx)) if lacking else 0):
            code = lacking[turn % len(lacking)]
            known = run.archive.known_chiralities(code)
            number, index = run.tried[nx][code], index_of[code]
            if number % 3:  # the chiralities that an exact sequence leads to, two times of three
                known = [chiral for chiral in known if run.archive.sure(chiral)] or known
            run.tried[nx][code] += 1
            # not all begin with the same handedness
            first = int(generator(Stream.CHIRALITY, config.seed, nx, index).integers(2**nx))
            target = fresh[code].code if code in fresh else known[(number + first) % len(known)]
            elites = (fresh[code],) if code in fresh else tuple(run.archive.leading_to(target))
            seed = key(Stream.CANDIDATE, config.seed, nx, index, run.shard.first + number)
            wave.append((nx, CandidateTask(config.candidate, target, elites, start, seed)))
    return wave


def _lacking(run: CurationRun, nx: int) -> list[GaussCode]:
    """The known codes that lack states, those tried least first, in an order the seed decides.

    Of more codes than are wanted a quarter more are tried; the window widens with time.
    """
    codes = list(run.shares[nx])
    order = generator(Stream.CODE_ORDER, run.config.seed, nx).permutation(len(codes))
    ranked = [codes[k] for k in order]
    if not run.config.every_code:
        ranked = ranked[: run.wanted_codes(nx) + 2 * run.cycle]
    have, needed = Counter(one.code.plain for one in run.accepted[nx]), run.needed(nx)
    lacking = [
        code for code in ranked if have[code] < needed[code] and run.archive.known_chiralities(code)
    ]
    return sorted(lacking, key=lambda code: run.tried[nx][code])


def _judge(run: CurationRun, nx: int, candidate: Candidate) -> None:
    """Accept a candidate, or count why not."""
    reasons = list(candidate.faults)
    if not reasons and knot_type(candidate.code) != run.knot:
        reasons = ["knot type changed"]
    if not reasons and is_near_duplicate(
        candidate.points[-1], [one.points[-1] for one in run.accepted[nx]]
    ):
        reasons = ["near-duplicate"]
    for elite in candidate.elites:
        run.archive.offer(elite, run.config.search.archive)
    candidate = replace(candidate, elites=())
    same = sum(one.code.plain == candidate.code.plain for one in run.accepted[nx])
    most = run.config.choice * run.shares[nx].get(candidate.code.plain, 0)
    if reasons:
        run.rejected[nx].update(reasons)
    elif same < most:
        run.accepted[nx].append(candidate)
