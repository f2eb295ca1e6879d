"""What a run has made so far, and its checkpoint in the staging folder.

run.json            counters, and the names of the files below; written last
archive-{cycle}.h5  the archive of play
wave-{cycle}.npz    the states and demonstrations made since the previous wave
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.atomic_files import sha256
from knotgym.generate.packed_records import (
    read_records,
    reading_checkpoint,
    require_digest,
    write_records,
)
from knotgym.generate.states.archive import Archive
from knotgym.generate.states.demonstrations import Demonstration
from knotgym.generate.states.drawn_states import MadeState
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.states.near_duplicates import NEAR, distances, pairs_within

_RUN = "run.json"

Slot = tuple[int, int, int]  # nx, index of the code, copy


class MadeStates:
    """States, action sequences and counters of a run.

    A slot (nx, index, copy) stands for one requested state: copy `copy` of code `index`.
    """

    def __init__(self, nx_wanted: tuple[int, ...]) -> None:
        self.archive = Archive()  # states and sequences found by play and by the planner
        self.states: dict[Slot, MadeState] = {}  # accepted
        self.demonstrations: dict[Slot, Demonstration] = {}  # each ends in the code of its slot
        self.drawings = Counter[tuple[int, int]]()  # (nx, index) -> drawings made
        self.searches = Counter[tuple[int, int]]()  # (nx, index) -> failed planner searches
        self.missed = set[tuple[int, int]]()  # codes that no sequence reaches when replayed
        self.rejected = {nx: Counter[str]() for nx in nx_wanted}  # reason -> drawings
        self.actions = 0  # of the planner and of demonstrations; the archive counts those of play
        self.cycle = 0  # finished waves
        self.play_over = False  # play has added too few codes
        self.growth: list[dict[str, Any]] = []
        self._waves: dict[str, Any] = {}  # file -> its SHA-256 and slots
        self._saved: set[Slot] = set()  # slots whose state is saved
        self._tied: set[Slot] = set()  # slots whose demonstration is saved

    def is_near(self, state: MadeState, early: bool = False) -> bool:
        """Return whether a state is a near-duplicate of an accepted one.

        Under all symmetries it is compared with states of its code and, if it is early, with all
        of as many crossings; with the others only as they lie.
        """
        made = self.made(state.code.nx).values()
        like = [one.points for one in made if early or one.code.matches(state.code)]
        others = [one.points for one in made]
        if like and pairs_within(state.points[None], np.stack(like)):
            return True
        return bool(others) and bool((distances(state.points, np.stack(others)) < NEAR).any())

    def made(self, nx: int) -> dict[Slot, MadeState]:
        """Return the accepted states with nx crossings, in the order of their slots."""
        return {slot: self.states[slot] for slot in sorted(self.states) if slot[0] == nx}

    def steps(self) -> int:
        """Return the number of actions simulated so far to find and replay action sequences."""
        return self.actions + (self.archive.growth[-1]["actions"] if self.archive.growth else 0)

    def save(self, folder: Path) -> None:
        fresh = {slot: one for slot, one in self.states.items() if slot not in self._saved}
        ways = {slot: one for slot, one in self.demonstrations.items() if slot not in self._tied}
        if fresh or ways:
            name = f"wave-{self.cycle:06d}.npz"
            made: dict[str, list[Any]] = {"states": [*fresh.values()]}
            made["demonstrations"] = [*ways.values()]
            slots = {"states": list(fresh), "demonstrations": list(ways)}
            self._waves[name] = {"sha256": write_records(folder / name, made), **slots}
            self._saved |= fresh.keys()
            self._tied |= ways.keys()
        archive = folder / f"archive-{self.cycle:06d}.h5"
        kept = {}
        if self.archive.niches:
            self.archive.save(archive, compress=False)
            kept = {archive.name: sha256(archive)}
        counters = {
            "cycle": self.cycle,
            "actions": self.actions,
            "play_over": self.play_over,
            "growth": self.growth,
            "drawings": [[*code, count] for code, count in self.drawings.items()],
            "searches": [[*code, count] for code, count in self.searches.items()],
            "missed": sorted(self.missed),
            "rejected": {str(nx): dict(reasons) for nx, reasons in self.rejected.items()},
            "archive": kept,
            "waves": self._waves,
        }
        write_sealed(folder / _RUN, counters)
        for old in folder.glob("archive-*.h5"):
            if old != archive:
                old.unlink()

    def load(self, folder: Path) -> bool:
        if not (folder / _RUN).is_file():
            return False
        with reading_checkpoint(folder):
            stored = read_sealed(folder / _RUN)
            for name, digest in stored["archive"].items():
                require_digest(folder / name, digest)
                self.archive = Archive.load(folder / name)
            for name, wave in stored["waves"].items():
                require_digest(folder / name, wave["sha256"])
                states = read_records(folder / name, "states", MadeState)
                self.states.update(zip(map(_slot, wave["states"]), states, strict=True))
                ways = read_records(folder / name, "demonstrations", Demonstration)
                slots = map(_slot, wave["demonstrations"])
                self.demonstrations.update(zip(slots, ways, strict=True))
            self._waves = stored["waves"]
            self._saved, self._tied = set(self.states), set(self.demonstrations)
            self.cycle, self.actions = int(stored["cycle"]), int(stored["actions"])
            self.play_over, self.growth = bool(stored["play_over"]), stored["growth"]
            for counts, name in ((self.drawings, "drawings"), (self.searches, "searches")):
                counts.update({(nx, index): count for nx, index, count in stored[name]})
            self.missed = {(nx, index) for nx, index in stored["missed"]}
            self.rejected = {nx: Counter(stored["rejected"][str(nx)]) for nx in self.rejected}
        return True


def _slot(numbers: list[int]) -> Slot:
    nx, index, copy = numbers
    return nx, index, copy
