"""The recipe of `knotgym generate`: play finds action sequences, drawing makes states.

A run is a series of waves. Each wave does the first of these that has work left:

1. Rounds of play (`search`), as long as they add enough of the requested codes to the archive.
2. Planner searches for the codes that play has not reached (`planned_sequences`).
3. Replays of the sequence for each requested state (`demonstrations`). If the replay ends in a
   state within all limits, that becomes the state.
4. Drawings of the other states from their codes (`drawn_states`).

A code with no sequence found or no drawing accepted is skipped in favour of the next code. Until
the run is finished, `made_states` keeps what it has in the staging folder.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import knotgym
from knotgym.common.atomic_files import sha256
from knotgym.common.configuration import as_json
from knotgym.common.errors import Failed, InvalidInput, MissingFile
from knotgym.common.streams import Stream, derived_seed, key
from knotgym.datasets.finished_folders import finish_states
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.code_order import CodeOrder
from knotgym.generate.states.curves import Start, start_of
from knotgym.generate.states.demonstrations import (
    Demonstrated,
    Demonstration,
    DemonstrationTask,
    acted_out,
    carried_over,
    demonstrate,
)
from knotgym.generate.states.drawn_states import DrawnOnes, DrawnUnit, draw_states
from knotgym.generate.states.generate_config import GenerateConfig, is_tabled, require_possible
from knotgym.generate.states.made_states import MadeStates, Slot
from knotgym.generate.states.planned_sequences import Found, Target, reach
from knotgym.generate.states.search import SearchConfig, new_archive, replays, search_round
from knotgym.generate.states.state_folder import states_of, write_demonstrations
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Rope
from knotgym.runs.engine import CHECKPOINT, Batch, Recipe, run
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.runs.shards import Shard
from knotgym.states.schema import DRAWING
from knotgym.states.state_file import write_states
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knot_table import UNKNOT, diagram_of, type_of
from knotgym.topology.symmetry import mirror_images

FIRST_ROUNDS = 3  # minimum rounds of play: early rounds find the states that later ones start from
CORE_SECONDS = (0.3, 3.0)  # per state without and with a demonstration, up to nx 4
SEQUENCE_WORTH = 6  # cost of finding and replaying one action sequence, in drawn states

# The first drawings of a code must differ from all other states under every symmetry. Codes that a
# symmetry maps to each other have similar drawings, so later ones need only differ as they lie;
# `splits.kept_together` then puts such states into one split.
_UNLIKE_DRAWINGS = 3


def generate(
    config: GenerateConfig,
    out: Path,
    options: RunOptions,
    *,
    archive: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Make states and return the new folder, which for a shard is not `out` but the shard's own.

    Args:
        archive: archive of another run, whose action sequences this one starts with.

    Raises:
        Occupied, InvalidInput: as in `runs.engine.run`.
        InvalidInput: such states can't be made.
        Failed: `config.attempts` or `config.searches` were used up.
    """
    recipe = StateRecipe(config, options.shard, archive)
    if progress is not None:
        seconds = CORE_SECONDS[config.demonstrations] * recipe.wanted
        tell_if_long(progress, seconds, options.workers)
    return run(recipe, options.shard.folder(out), options, progress)


class StateRecipe(MadeStates, Recipe):
    """Recipe for states with demonstrations, see `runs.engine.Recipe`."""

    flexible = "attempts", "cycles", "searches"
    draws = True

    def __init__(
        self, config: GenerateConfig, shard: Shard | None = None, archive: Path | None = None
    ) -> None:
        if archive is not None and not archive.is_file():
            raise MissingFile(f"no archive at {archive}")
        super().__init__(config.nx)
        self.config, self.shard, self.given = config, shard or Shard(), archive
        self.engine = config.engine
        self._start: Start | None = None
        self.knot = config.knot if is_tabled(config.knot) else self.start.knot
        if type_of(self.knot) == UNKNOT:
            self.knot = UNKNOT
        self.least = diagram_of(self.knot).nx
        require_possible(config, self.knot)
        self.codes = {nx: CodeOrder(config, self.knot, self.shard, nx) for nx in config.nx}
        self.wanted = sum(codes.wanted for codes in self.codes.values())
        if not self.wanted:
            raise InvalidInput(
                f"shard {self.shard} has no state to make: split the run into fewer shards"
            )

    @property
    def start(self) -> Start:
        """The state from which action sequences start."""
        if self._start is None:
            self._start = start_of(self.config.knot)
        return self._start

    @property
    def search(self) -> SearchConfig:
        """The settings of play."""
        seed = self.config.seed
        if not self.shard.is_whole:
            seed = derived_seed(Stream.SHARD, seed, self.shard.number)
        most = max(*self.config.nx, self.start.code.nx)
        return SearchConfig(
            **vars(self.config.search), max_nx=most, seed=seed, engine=self.config.engine
        )

    def request(self) -> dict[str, Any]:
        curve = Path(self.config.knot)
        source = {
            "archive": sha256(self.given) if self.given else None,
            "knot": sha256(curve) if curve.is_file() else None,
        }
        return {"config": as_json(self.config), "source": source}

    def begin(self) -> None:
        given = Archive.load(self.given) if self.given else None  # refused even where unused
        if not any(map(self.has_ways, self.config.nx)):
            return
        is_loop = np.array_equal(self.start.points, Rope().loop())
        fresh = new_archive(self.search, None if is_loop else self.start.points)
        self.archive = fresh if given is None else given
        if self.archive.origin != fresh.origin:
            raise InvalidInput(
                f"the action sequences of {self.given} start from another curve, move another rope"
                f" or were made with another engine than those of knot {self.config.knot} with"
                f" engine {self.config.engine} here"
            )

    def has_ways(self, nx: int) -> bool:
        """Whether states with nx crossings need action sequences from the start.

        States with the knot's minimal crossing number don't; they are starts themselves.
        """
        return self.config.demonstrations and nx > self.least

    def batches(self, folder: Path) -> Iterator[Batch]:
        while not self.config.cycles or self.cycle < self.config.cycles:
            wave = self._wave()
            if wave is None:
                break
            yield from wave
            self.cycle += 1
            self._note_growth()
            yield CHECKPOINT
        lacking = {nx: self.codes[nx].wanted - len(self.made(nx)) for nx in self.config.nx}
        if any(lacking.values()) and not self.config.cycles:
            missing = ", ".join(f"{count} with nx = {nx}" for nx, count in lacking.items() if count)
            unreached = any(count >= self.config.searches for count in self.searches.values())
            more = (
                f'{{"searches": {self.config.searches + 2}}} in --settings'
                if unreached
                else "more --attempts"
            )
            raise Failed(
                f"missing states: {missing}; give --resume with {more}, or with --cycles"
                f" {self.cycle} to keep the states made"
            )
        if not self.states:
            raise Failed(f"no state accepted in {self.cycle} cycles; give more --cycles")

    def _wave(self) -> Iterator[Batch] | None:
        """Return the next wave of work; None if nothing is left to do."""
        known = self._known() if any(map(self.has_ways, self.config.nx)) else {}
        lacking, unknown = list[Slot](), list[Slot]()
        for nx in self.config.nx:
            ready, rest = self._window(nx, known)
            if len(ready) < self.codes[nx].wanted:
                unknown += rest
            lacking += [slot for slot in ready if slot not in self.states]
        if unknown:
            codes = list(dict.fromkeys(slot[:2] for slot in unknown))
            return self._plan(codes) if self.play_over else self._play(codes)
        pending = [
            slot for slot in lacking if self.has_ways(slot[0]) and slot not in self.demonstrations
        ]
        if pending:
            return self._demonstrate(pending[: self.config.wave], known)
        return self._draw(lacking) if lacking else None

    def _window(
        self, nx: int, known: Mapping[GaussCode, list[Elite]]
    ) -> tuple[list[Slot], list[Slot]]:
        """Return the slots with nx crossings to work on, without those of skipped codes.

        First those that have a state or need only a replay or a drawing, at most as many as states
        are requested; then those to whose codes no sequence is known. If there are more codes than
        requested states, sequences are searched for 25 % more codes than needed: the hardest few of
        a fixed choice would take as long as all others.
        """
        codes, ways = self.codes[nx], self.has_ways(nx)
        most = int((1.25 if ways else 1) * codes.wanted)
        made, ready, unknown = list[Slot](), list[Slot](), list[Slot]()
        for index, copy in codes.slots():
            slot = nx, index, copy
            if len(made) + len(ready) + len(unknown) == most:
                break
            if slot in self.states:
                made.append(slot)
            elif self._is_passed_over(nx, index):
                continue
            elif not ways or slot in self.demonstrations or self._ways(slot, known):
                ready.append(slot)
            else:
                unknown.append(slot)
        return (made + ready)[: codes.wanted], unknown

    def _is_passed_over(self, nx: int, index: int) -> bool:
        """Whether a code has used up its drawings or planner searches."""
        config, code = self.config, (nx, index)
        drawn_out = self.drawings[code] >= config.attempts * self.codes[nx].share(index)
        return drawn_out or self.searches[code] >= config.searches

    def _known(self) -> dict[GaussCode, list[Elite]]:
        """Map codes without chirality to elites whose sequence, mirrored or not, reaches them."""
        longest, known = self.config.search.longest, dict[GaussCode, list[Elite]]()
        for niche, elites in self.archive.niches.items():
            exact = [one for one in elites if one.exact and len(one.sequence) <= longest]
            for code in {image.plain for image in mirror_images(niche)} if exact else ():
                known.setdefault(code, []).extend(exact)
        if self.knot != UNKNOT:  # a mirrored sequence may tie the mirror image of the knot
            for code, elites in known.items():
                known[code] = [one for one in elites if carried_over(one, code, self.knot)]
        return known

    def _ways(self, slot: Slot, known: Mapping[GaussCode, list[Elite]]) -> list[Elite]:
        """Return the elites whose sequences lead to the code of a slot."""
        nx, index, _ = slot
        if (nx, index) in self.missed:
            return []
        return known.get(self.codes[nx][index].plain, [])

    def _play(self, unknown: list[tuple[int, int]]) -> Iterator[Batch]:
        """Play one round, and end play if it reached fewer than `config.stalled` new codes.

        The planner then finds more codes in the same time.
        """
        wanted = {self.codes[nx][index].plain for nx, index in unknown}
        yield from search_round(self.archive, self.search, wanted=wanted)
        known = self._known()
        gained = sum(bool(self._ways((*code, 0), known)) for code in unknown)
        self.play_over = len(self.archive.growth) >= FIRST_ROUNDS and gained < self.config.stalled

    def _plan(self, unknown: list[tuple[int, int]]) -> Iterator[Batch]:
        """Plan for the codes with the fewest failed searches; a code covers its mirror image."""
        wanted = frozenset(self.codes[nx][index].plain for nx, index in unknown)
        repeated = replays(
            self.archive, self.search, len(self.archive.growth), 1 + self.cycle, wanted=wanted
        )
        yield repeated
        self.actions += sum(len(one) for unit in repeated.units for one in unit.sequences)
        known = self._known()
        unknown = [code for code in unknown if not self._ways((*code, 0), known)]
        unknown.sort(key=lambda code: self.searches[code])
        shortest = [
            next((one for one in elites if one.exact), None)
            for elites in self.archive.niches.values()
        ]
        elites = tuple(
            one for one in shortest if one and len(one.sequence) < self.config.search.longest
        )
        targets: dict[tuple[int, int], Target] = {}
        goals: set[GaussCode] = set()
        for nx, index in unknown:
            goal, number = self.codes[nx][index].plain, self.searches[nx, index]
            if len(targets) == self.config.planned or goal in goals:
                continue
            seed = key(Stream.TARGETED_SEARCH, self.search.seed, nx, index, number)
            mirrored = self.knot == UNKNOT and (nx, index) not in self.missed
            goals |= {goal, goal.mirrored()} if mirrored else {goal}
            targets[nx, index] = Target(
                self.search, self.config.planner, elites, goal, mirrored, wanted, number, seed
            )
        codes = iter(targets)

        def absorb(target: Target, found: Found) -> None:
            code, failed = next(codes), True
            self.actions += found.spent
            goals = (target.goal, target.goal.mirrored())[: 1 + target.mirrored]
            for elite in found.elites:
                self.archive.offer(elite, self.config.search.archive)
                failed &= not elite.exact or elite.code.plain not in goals
            self.searches[code] += failed
            if not failed:
                self.missed.discard(code)

        yield Batch(reach, list(targets.values()), absorb, "planning for codes that play missed")

    def _demonstrate(
        self, pending: list[Slot], known: Mapping[GaussCode, list[Elite]]
    ) -> Iterator[Batch]:
        """Replay the sequences to the codes of some slots."""
        tasks = []
        for slot in pending:
            nx, index, copy = slot
            seed = key(Stream.CANDIDATE, self.config.seed, nx, index, self.shard.first + copy)
            ways = tuple(self._ways(slot, known))
            code, start = self.codes[nx][index].plain, self.start.points
            tasks.append(DemonstrationTask(self.config, self.knot, code, index, start, ways, seed))
        slots = iter(pending)

        def absorb(task: DemonstrationTask, made: Demonstrated) -> None:
            slot = next(slots)
            self.actions += made.spent
            if made.demonstration is None:
                self.missed.add(slot[:2])
                self.searches[slot[:2]] += 1
                return
            self.demonstrations[slot] = made.demonstration
            if made.state is not None and not self.is_near(made.state):
                self.states[slot] = made.state

        yield Batch(demonstrate, tasks, absorb, "replaying action sequences")

    def _draw(self, lacking: list[Slot]) -> Iterator[Batch]:
        """Draw the first codes whose states are missing."""
        config = self.config
        units = []
        for (nx, index), wanted in Counter(slot[:2] for slot in lacking).items():
            drawn = self.drawings[nx, index]
            most = min(config.batch, config.attempts * self.codes[nx].share(index) - drawn)
            code, first = self.codes[nx][index], self.shard.first + drawn
            units.append(DrawnUnit(config, self.knot, code, index, first, most, wanted))

        def absorb(unit: DrawnUnit, made: DrawnOnes) -> None:
            nx, index = unit.code.nx, unit.which
            early = self.drawings[nx, index] < _UNLIKE_DRAWINGS
            self.drawings[nx, index] += made.drawings
            self.rejected[nx].update(made.rejected)
            open_slots = (slot for slot in lacking if slot[:2] == (nx, index))
            for one in made.states:
                if self.is_near(one, early):
                    self.rejected[nx]["near-duplicate"] += 1
                else:
                    self.states[next(open_slots)] = one

        yield Batch(draw_states, units[: config.wave], absorb, "drawing")

    def demonstration(self, slot: Slot) -> Demonstration | None:
        """Return the demonstration of a slot with a state; for a plain loop, its own actions."""
        if slot[0] == 0 and self.config.demonstrations:
            state = self.states[slot]
            simulation = simulation_of(1, self.config.rope, self.config.engine)
            return acted_out(simulation, state.start_qpos, state.actions)
        return self.demonstrations.get(slot)

    def _note_growth(self) -> None:
        if not self.config.demonstrations:
            return
        known = self._known()
        self.growth.append(
            {
                "steps": self.steps(),
                "known": {str(nx): sum(c.nx == nx for c in known) for nx in self.config.nx},
                "accepted": {str(nx): len(self.made(nx)) for nx in self.config.nx},
            }
        )

    def status(self) -> Status:
        rejected: Counter[str] = sum(self.rejected.values(), Counter())
        common = ", ".join(f"{reason} {count}" for reason, count in rejected.most_common(4))
        tied = sum(codes.wanted for nx, codes in self.codes.items() if self.has_ways(nx))
        known = self._known() if tied else {}
        ways = sum(len(self._window(nx, known)[0]) for nx in self.config.nx if self.has_ways(nx))
        facts = {"action sequences": f"{ways} of {tied}"} if tied else {}
        facts["simulated actions"] = f"{self.steps()}"
        facts["drawings"] = f"{self.drawings.total()}, rejected: {common or 'none'}"
        work = SEQUENCE_WORTH * tied + self.wanted
        share = (SEQUENCE_WORTH * ways + len(self.states)) / work
        return Status(len(self.states), self.wanted, "states", facts, share=share)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        """Write states.h5, the archive, demonstrations, and the manifest last."""
        slots = [slot for nx in self.config.nx for slot in self.made(nx)]
        demonstrations = [self.demonstration(slot) for slot in slots]
        made, knot = [self.states[slot] for slot in slots], type_of(self.knot)
        states = states_of(self.config, knot, made, demonstrations)
        folder.mkdir(parents=True)
        write_states(folder / "states.h5", states)
        if self.archive.niches:
            self.archive.save(folder / "archive.h5")
        if any(states.source["dataset"]):
            write_demonstrations(
                states, demonstrations, self.config, knot, folder / "minari", folder / "states.h5"
            )
        finish_states(folder, states, self.report(), request)
        return folder

    def summary(self) -> str:
        codes = {one.code.plain for one in self.states.values()}
        ways = sum(slot in self.demonstrations for slot in self.states)
        tied = f", {ways} demonstrations" if ways else ""
        return f"{len(self.states)} states of {len(codes)} codes{tied}"

    def report(self) -> dict[str, Any]:
        """Return the run's counts as JSON; the same configuration gives the same report."""
        return {
            "version": knotgym.__version__,
            "mujoco": mujoco.__version__,
            "source": DRAWING,
            "knot": type_of(self.knot),
            "existing_codes": {str(nx): codes.existing for nx, codes in self.codes.items()},
            "attempts": self.drawings.total(),
            "actions": self.steps(),
            "rejected": {str(nx): dict(sorted(each.items())) for nx, each in self.rejected.items()},
            "passed_over": {
                str(nx): [
                    str(codes[index])
                    for index in sorted(i for n, i in {*self.drawings, *self.searches} if n == nx)
                    if self._is_passed_over(nx, index)
                ]
                for nx, codes in self.codes.items()
            },
            "growth": self.growth,
        }
