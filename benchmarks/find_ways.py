"""Ways from the plain loop to every code of an unknot: found by the planner, counted, kept.

    python benchmarks/find_ways.py --nx 5 --out ways
    python benchmarks/find_ways.py --nx 5 --out ways   # goes on where it was

A code's way is planned from the state nearest to it of those reached so far, fewer crossings first,
and what leads there goes before; it is at most --longest actions, and is acted out from the plain
loop. Codes without a way that the planner meets on its search get theirs by the way. A way to a
code leads to its mirror images too. Of codes seen only with the walk begun at
another sub-chain, or the other way round, the way so renumbered is tried first.

Writes --out/archive.h5, which `knotgym generate --archive` takes and `benchmarks/ways.py` acts out,
and --out/ways.json: for every nx the codes with a way and its length, and those without.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from knotgym.common.atomic_files import atomic_write
from knotgym.common.streams import Stream, key
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.transition_graph import shipped_transition_graph
from knotgym.generate.states.archive import Archive, Elite
from knotgym.generate.states.search import Replay, SearchConfig, confirm, new_archive, renumbered
from knotgym.generate.states.targeted_search import Target, reach
from knotgym.rope.model import Rope
from knotgym.runs.engine import Batch
from knotgym.runs.executors import executor
from knotgym.runs.pools import Pool
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of
from knotgym.topology.symmetry import mirror_images

WAVE = 4  # codes planned for at once
PAUSE = 60.0  # seconds between two savings
FIRST_BUDGET = 400  # simulated actions; twice as many at every further attempt
PACE = 7  # actions that a change of code may take; PACE more at every further attempt


class Ways:
    """An archive that grows until it has a way to every code, and what that took."""

    def __init__(self, folder: Path, config: SearchConfig, settings: dict[str, Any]) -> None:
        self.folder, self.config = folder, config
        self.archive, self.kept = new_archive(config), {"settings": settings, "attempts": {}}
        if (folder / "ways.json").exists():
            self.kept = json.loads((folder / "ways.json").read_text(encoding="utf-8"))
            if self.kept["settings"] != settings:
                raise SystemExit(f"{folder} was made with {self.kept['settings']}; got {settings}")
            self.archive = Archive.load(folder / "archive.h5")
        self.codes = [code for nx in range(1, config.max_nx + 1) for code in codes_of("0_1", nx)]
        self.saved = time.monotonic()
        self.loop = Rope(config.rope).loop()

    def lengths(self) -> dict[GaussCode, int]:
        """Of the shortest way to every code that has one; chirality left open."""
        lengths: dict[GaussCode, int] = {}
        for niche, elites in self.archive.niches.items():
            found = [len(elite.sequence) for elite in elites if elite.exact]
            if min(found, default=self.config.longest + 1) <= self.config.longest:
                for image in mirror_images(niche):
                    length = lengths.get(image.plain, self.config.longest)
                    lengths[image.plain] = min(length, *found)
        return lengths

    def find(self, nx: int, attempts: int, pool: Pool) -> None:
        """Look for ways to the codes with nx crossings that have none."""
        for number in range(attempts):
            pairs = list(enumerate(code for code in codes_of("0_1", nx) if self._stands(code)))
            for first in range(0, len(pairs), WAVE):
                wave = [
                    (index, code)
                    for index, code in pairs[first : first + WAVE]
                    if self.kept["attempts"].get(str(code), 0) <= number
                ]
                known = self.lengths()
                self._replay([code for _, code in wave if code not in known], pool)
                known = self.lengths()
                open_ = [(index, code) for index, code in wave if code not in known]
                wanted = frozenset(code for code in self.codes if code not in known)
                targets = [self._target(code, nx, index, number, wanted) for index, code in open_]
                for _ in Batch(reach, targets, lambda _, found: self._offer(found.elites)).follow(
                    pool
                ):
                    pass
                for _, code in open_:
                    self.kept["attempts"][str(code)] = number + 1
                if time.monotonic() > self.saved + PAUSE:
                    self.save(nx)

    def _stands(self, code: GaussCode) -> bool:
        """Whether a code stands for itself and its mirror image."""
        return code.visits >= code.mirrored().visits

    def _offer(self, elites: tuple[Elite, ...]) -> None:
        for elite in elites:
            self.archive.offer(elite, self.config.archive)

    def _replay(self, codes: list[GaussCode], pool: Pool) -> None:
        """Try the ways to codes seen with the rope numbered otherwise, so renumbered."""
        sequences = tuple(
            renumbered(elite, self.config.rope.beads)
            for code in codes
            for chiral in self.archive.known_chiralities(code)
            for elite in self.archive.leading_to(chiral)[:1]
        )
        if sequences:
            (found,) = pool.map(confirm, [Replay(self.config, sequences)])
            for one in found:
                elite = one.reading.elite(sequences[one.batch_index], one.state)
                self.archive.offer(elite, self.config.archive)

    def _target(
        self, code: GaussCode, nx: int, index: int, number: int, wanted: frozenset[GaussCode]
    ) -> Target:
        """The code, or its mirror image, from the number-th nearest state."""
        graph = shipped_transition_graph(PlannerConfig().graph)
        distances = graph.distances(code)
        near = [
            (elite, shown, goal)
            for elite in self._elites()
            for shown, goal in ((elite.code, code), (elite.code.mirrored(), code.mirrored()))
        ]
        near.sort(key=lambda one: distances(one[1]) + len(one[0].sequence))
        elite, shown, goal = near[min(number, len(near) - 1)]
        hops = distances.hops.get(shown, PlannerConfig().unknown_hops)
        longest = min(self.config.longest, len(elite.sequence) + PACE * (hops + number))
        planner = PlannerConfig(budget=FIRST_BUDGET * 2**number)
        seed = key(Stream.TARGETED_SEARCH, self.config.seed, nx, index, number)
        search = replace(self.config, longest=longest)
        return Target(search, planner, self.loop, goal, seed, elite, wanted)

    def _elites(self) -> Iterator[Elite]:
        """The shortest exact one of every class that has one; it stands first in its niche."""
        for elites in self.archive.niches.values():
            if elites[0].exact and len(elites[0].sequence) < self.config.longest:
                yield elites[0]

    def row(self, nx: int) -> dict[str, Any]:
        """What is known of the ways to codes with nx crossings."""
        codes, known = codes_of("0_1", nx), self.lengths()
        found = [known[code] for code in codes if code in known]
        return {
            "codes": len(codes),
            "found": len(found),
            "median": float(np.median(found)) if found else None,
            "longest": max(found, default=None),
            "without": [str(code) for code in codes if code not in known],
        }

    def save(self, most: int) -> None:
        """Write both files."""
        self.kept["rows"] = {str(nx): self.row(nx) for nx in range(1, most + 1)}
        self.archive.save(self.folder / "archive.h5")
        with atomic_write(self.folder / "ways.json") as temporary:
            temporary.write_text(json.dumps(self.kept, indent=1) + "\n", encoding="utf-8")
        self.saved = time.monotonic()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nx", type=int, choices=range(1, 7), default=5, help="crossings at most")
    parser.add_argument("--longest", type=int, default=50, help="actions of a way, at most")
    parser.add_argument("--attempts", type=int, default=5, help="for each code, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes, 0 for one a core")
    parser.add_argument("--out", type=Path, default=Path("ways"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    config = SearchConfig(max_nx=asked.nx, longest=asked.longest, seed=asked.seed)
    settings = {"nx": asked.nx, "longest": asked.longest, "seed": asked.seed}
    ways, begun = Ways(asked.out, config, settings), time.perf_counter()
    with executor(asked.workers) as pool:
        for nx in range(1, asked.nx + 1):
            ways.find(nx, asked.attempts, pool)
    ways.save(asked.nx)
    table = Table(title=f"ways of at most {asked.longest} actions")
    for name in ("nx", "codes", "with a way", "median actions", "longest"):
        table.add_column(name)
    for name, row in ways.kept["rows"].items():
        cells = (row[column] for column in ("codes", "found", "median", "longest"))
        table.add_row(name, *map(str, cells))
    Console().print(table)
    print(f"{time.perf_counter() - begun:.0f} s in this call")


if __name__ == "__main__":
    main()
