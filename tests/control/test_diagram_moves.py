"""Templates of single moves, acted out in the simulator."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from knotgym.control.action_sequence import step_ropes
from knotgym.control.diagram_moves import leading_down, leading_to
from knotgym.control.macro_actions import MacroActionConfig, WaypointController, pass_strand
from knotgym.control.transition_counts import MacroTemplate, Places
from knotgym.datasets.states import read_states, shipped
from knotgym.simulation import Simulation
from knotgym.topology.crossings import find_crossings, label_many
from knotgym.topology.gauss import GaussCode

CONFIG = MacroActionConfig()
SIDE_BY_SIDE = 8
STEPS = 8  # of a macro-action


def moves(code: GaussCode) -> Iterator[tuple[str, GaussCode, list[MacroTemplate]]]:
    """What can be done with a rope that shows `code`: kind, what it shows then, templates."""
    for down in leading_down(code):
        yield ("kink" if down.code.nx == code.nx - 1 else "bigon"), down.code, down.templates
    for beside in leading_to(code):
        if beside.code.nx == code.nx:
            for move in leading_to(beside.code):
                if move.code == code and move.templates:
                    slid = beside.code in (code.rebased(1), code.rebased(-1))
                    yield ("base" if slid else "third"), beside.code, move.templates


def test_templates_make_their_moves_far_oftener_than_chance() -> None:
    states = read_states(shipped(), images=False)
    rng, simulation = np.random.default_rng(0), Simulation(SIDE_BY_SIDE)
    tried, made = Counter[str](), Counter[str]()
    for row in states.rows(4, "train"):
        code = GaussCode.parse(str(states.gauss_code_chiral[row]))
        for kind, after, templates in moves(code):
            if tried[kind] >= 3 * SIDE_BY_SIDE:
                continue
            points = states.points[row]
            places = Places(find_crossings(points), len(points))
            simulation.lay(np.repeat(states.qpos[[row]], SIDE_BY_SIDE, axis=0))
            controller = WaypointController(SIDE_BY_SIDE, CONFIG)
            for rope, number in enumerate(rng.integers(len(templates), size=SIDE_BY_SIDE)):
                name, side, bead, target = templates[number]
                led = places.bead(bead), places.bead(target)
                controller.begin(rope, pass_strand(points, name, *led, side, rng, CONFIG))
            shown = np.zeros(SIDE_BY_SIDE, dtype=bool)
            for _ in range(STEPS):
                controller.advance(simulation.points)
                forces = controller.forces(simulation.points)
                step_ropes(simulation, controller.beads, forces, np.arange(SIDE_BY_SIDE))
                shown |= np.array([one == after for one in label_many(simulation.points)])
            tried[kind] += SIDE_BY_SIDE
            made[kind] += int(shown.sum())
    # of random macro-actions two to five in a hundred
    least = {"kink": 0.15, "bigon": 0.4, "third": 0.2, "base": 0.25}
    seen = {kind: made[kind] / tried[kind] for kind in least if tried[kind]}
    assert seen.keys() == least.keys() and all(seen[kind] >= least[kind] for kind in least), seen
