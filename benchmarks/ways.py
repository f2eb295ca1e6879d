"""What an archive knows: codes by number of crossings, and the shortest action sequence to each
from the plain loop, replayed.

    python benchmarks/ways.py knotgym-data/nx4-every1/archive.h5

A sequence counts when the rope, led from the plain loop at rest (mirrored or turned over where the
code is such an image, numbered from another sub-chain or the other way where the archive knows the
sequence so), shows the code; actions count until it first does. Writes JSON, with the growth of the
archive by rounds, to --out.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from knotgym.control.action_sequence import step_ropes
from knotgym.generate.states.archive import Archive, Elite
from knotgym.rope.mujoco_simulation import MujocoSimulation
from knotgym.rope.simulation import Simulation
from knotgym.topology.crossings import label
from knotgym.topology.diagrams import chiralities
from knotgym.topology.gauss import GaussCode
from knotgym.topology.knots import codes_of
from knotgym.topology.symmetry import mirror_images, mirrorings


def leads(simulation: Simulation, elite: Elite, code: GaussCode) -> int | None:
    """After how many actions of the elite's sequence, carried over, the rope shows `code`; None if
    it never does.
    """
    rope = simulation.rope
    for shown, symmetry in mirrorings(elite.code):
        if shown.plain != code:
            continue
        symmetry = replace(
            symmetry,
            reverse=elite.reverse,
            base_shift=-elite.base_shift if elite.reverse else elite.base_shift,
        )
        simulation.lay(rope.qpos(symmetry.configuration(rope.loop()))[None])
        beads = symmetry.beads(elite.sequence.beads, rope.config.beads)
        forces = symmetry.vectors(elite.sequence.forces.astype(np.float64))
        for taken, (bead, force) in enumerate(zip(beads, forces, strict=True)):
            if label(simulation.points[0]).plain == code:
                return taken
            step_ropes(simulation, np.array([bead]), force[None].astype(np.float32))
        if label(simulation.points[0]).plain == code:
            return len(beads)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("--most-nx", type=int, default=4)
    parser.add_argument("--out", type=Path, default=Path("ways.json"))
    args = parser.parse_args()
    archive, simulation = Archive.load(args.archive), MujocoSimulation()
    table = Table(
        "nx",
        "codes there are",
        "known",
        "led to",
        "fewest",
        "median",
        "most",
        title=f"action sequences from the plain loop, {args.archive}",
    )
    figures = {}
    for nx in range(args.most_nx + 1):
        lengths: dict[str, int] = {}
        for code in codes_of("0_1", nx):
            chiral = [GaussCode(code.visits, letters) for letters in chiralities(code)]
            elites = [elite for one in chiral for elite in archive.leading_to(one)]
            for elite in sorted(elites, key=lambda one: len(one.sequence)):
                if (taken := leads(simulation, elite, code)) is not None:
                    lengths[str(code)] = taken
                    break
        niches = [niche for niche in archive.niches if niche.nx == nx]
        known = {image.plain for niche in niches for image in mirror_images(niche)}
        counts = [len(codes_of("0_1", nx)), len(known), len(lengths)]
        spread = (
            [int(value) for value in np.quantile(list(lengths.values()), [0, 0.5, 1])]
            if lengths
            else ["-"] * 3
        )
        table.add_row(*map(str, [nx, *counts, *spread]))
        figures[nx] = {
            "there_are": counts[0],
            "known": counts[1],
            "led_to": counts[2],
            "actions": lengths,
        }
    Console().print(table)
    args.out.write_text(json.dumps({"nx": figures, "growth": archive.growth}, indent=1) + "\n")


if __name__ == "__main__":
    main()
