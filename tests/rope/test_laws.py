"""The rope obeys: each law is measured beside what is exact, and the tolerance follows from theory.

    pytest -m thorough -s tests/rope/test_laws.py

prints what docs/exact.md shows. The chain engine's scheme is first order in the substep h
(`dynamics`), so a balance that holds for exact motion is off by c h; halving h must halve what is
missing.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from knotgym.rope.chain import layout
from knotgym.rope.chain.chain_simulation import ChainSimulation
from knotgym.rope.chain.solver import advance
from knotgym.rope.interface import Simulation
from knotgym.rope.model import Rope
from knotgym.rope.mujoco_simulation import MujocoSimulation

from ..conftest import curled

Array = NDArray[np.float64]
pytestmark = pytest.mark.thorough
ACTION = 0.192  # seconds
PULL = np.array([0.12, -0.1, 0.05])  # newtons
BEAD = 30


def report(law: str, measured: object, exact: object) -> None:
    print(f"{law:46} measured {measured}, exact {exact}")


def moved(chain: ChainSimulation, force: Array, seconds: float, substeps: int) -> None:
    """Pull BEAD of every rope for some time, in equal substeps."""
    n = chain.count
    counts = np.zeros((n, len(layout.COUNTS)), dtype=np.int64)
    advance(
        chain._states,
        chain.points,
        np.arange(n),
        np.full(n, BEAD),
        np.broadcast_to(force, (n, 3)).copy(),
        chain._physics,
        seconds,
        np.ones(substeps, dtype=np.int64),
        counts,
        np.zeros(1, dtype=np.int64),
    )
    assert not counts[:, [layout.REJECTED, layout.LOST, layout.BLOWN_UP]].any()


def laid(rope: Rope, nx: int = 1) -> ChainSimulation:
    chain = ChainSimulation(1, rope)
    chain.set_qpos(rope.qpos(rope.from_curve(curled(nx)))[None])
    return chain


class Motion:
    """The velocities of one rope, and the forces that they cause.

    Attributes:
        centre, turning: float64 (n, 3), of the beads: m/s and rad/s, turning across and about.
        drag: (n, 3), newtons, on the beads.
        lost: watts, of all that dissipates.
    """

    def __init__(self, chain: ChainSimulation) -> None:
        p, state = chain._physics, chain._states[0]
        x, v = state[:, layout.X : layout.V], state[:, layout.V : layout.SIDE]
        edge, swing = np.roll(x, -1, axis=0) - x, np.roll(v, -1, axis=0) - v
        along = edge / np.linalg.norm(edge, axis=1, keepdims=True)
        side = state[:, layout.SIDE : layout.SPUN]
        self.centre = v + 0.5 * swing
        across = np.cross(along, swing) / p.length
        spin = state[:, layout.SPUN]
        self.turning = across + spin[:, None] * along
        axes = np.stack([side, np.cross(along, side), along], axis=1)
        resisting = np.array([p.drag_across, p.drag_across, p.drag_along])
        on = np.einsum("nij,nj->ni", axes, self.centre)
        self.drag = -np.einsum("nij,ni->nj", axes, resisting * np.abs(on) * on)
        whirl = np.linalg.norm(across, axis=1)
        bent = self.turning - np.roll(self.turning, 1, axis=0)
        self.lost = float(
            (resisting * np.abs(on) ** 3).sum()
            + p.drag_turn * (whirl**3).sum()
            + p.drag_roll * (np.abs(spin) ** 3).sum()
            + (p.damping * (bent**2).sum(axis=1)).sum()
        )
        self.momentum = p.mass * self.centre.sum(axis=0)
        self.kinetic = float(
            0.5 * p.mass * (self.centre**2).sum()
            + 0.5 * p.transverse * (across**2).sum()
            + 0.5 * p.round * (spin**2).sum()
        )


def missing(rope: Rope, substeps: int) -> tuple[float, float]:
    """Return what an action's balances of momentum and energy lack, as shares of what came in."""
    chain = laid(rope)
    h = ACTION / substeps
    before = Motion(chain)
    momentum, energy, work = before.momentum.copy(), before.kinetic, 0.0
    for _ in range(substeps):
        moved(chain, PULL, h, 1)
        now = Motion(chain)
        momentum += h * (PULL + now.drag.sum(axis=0))
        work += h * float(PULL @ now.centre[BEAD])
        energy -= h * now.lost
    off = np.linalg.norm(now.momentum - momentum) / (ACTION * np.linalg.norm(PULL))
    return float(off), abs(now.kinetic - energy - work) / work


def test_momentum_and_power_balance_as_the_substep_goes_to_zero(rope: Rope) -> None:
    found = np.array([missing(rope, substeps) for substeps in (192, 384, 768)])
    for law, (coarse, middle, fine) in zip(("momentum", "power"), found.T, strict=True):
        report(
            f"{law} missing at h = 1, 1/2, 1/4 ms",
            f"{coarse:.1e}, {middle:.1e}, {fine:.1e}",
            "-> 0",
        )
        # first order: the error halves with h. The force jumps when the action begins, and what
        # settles within 20 ms is resolved the better the smaller h: ratios come to 2 from below.
        assert 1.5 < coarse / middle < 2.2 and 1.5 < middle / fine < 2.2
        # what is left at h = 0 by Richardson's extrapolation, against the last correction
        assert abs(2 * fine - middle) < 0.5 * fine


def test_a_rope_towed_by_its_end_reaches_its_terminal_velocity(rope: Rope) -> None:
    chain, force = laid(rope, 0), np.array([0.2, 0.0, 0.0])
    for _ in range(60):  # it trails behind as two parallel strands
        moved(chain, force, ACTION, 24)
    p, now = chain._physics, Motion(chain)
    exact = float(np.sqrt(0.2 / (rope.config.beads * p.drag_along)))
    speed = float(now.centre[:, 0].mean())
    report("terminal velocity, end load 0.2 N", f"{speed:.4f} m/s", f"{exact:.4f} m/s (straight)")
    # the pull balances the drag of the shape that it has, whatever that is
    assert np.abs(now.drag.sum(axis=0) + force).max() < 0.01 * 0.2
    # two bends and the eye between the strands lie across the motion, and only slow it down
    edge = np.roll(chain.points[0], -1, axis=0) - chain.points[0]
    slope = np.abs(edge[:, 0]) / p.length
    # F = u^2 sum of k_t c^3 + k_n s^3 for beads at an angle, c and s its cosine and sine
    shape = p.drag_along * slope**3 + p.drag_across * np.sqrt(1 - np.minimum(slope, 1) ** 2) ** 3
    assert speed < exact * 1.001
    assert speed == pytest.approx(float(np.sqrt(0.2 / shape.sum())), rel=0.1)


def test_a_rope_without_force_comes_to_rest_and_keeps_its_place(rope: Rope) -> None:
    chain = laid(rope)
    moved(chain, PULL, ACTION, 24)
    before = Motion(chain)
    kinetic = [before.kinetic]
    for _ in range(10):
        moved(chain, np.zeros(3), ACTION, 24)
        kinetic.append(Motion(chain).kinetic)
    report("kinetic energy without force", f"{kinetic[-1] / kinetic[0]:.1e} of it after 1.9 s", "0")
    assert all(after < one for one, after in zip(kinetic, kinetic[1:], strict=False))


def test_edges_keep_their_length_through_many_actions(rope: Rope) -> None:
    count, actions = 32, 400
    chain, rng = ChainSimulation(count, rope), np.random.default_rng(0)
    off = []
    for _ in range(actions):
        chain.act(rng.uniform(-1, 1, (count, 6)).astype(np.float32))
        edges = np.roll(chain.points, -1, axis=1) - chain.points
        off.append(float(np.abs(np.linalg.norm(edges, axis=2) / rope.config.bead_length - 1).max()))
    early, late = max(off[:100]), max(off[-100:])
    report(f"edges off after 100 and {actions} actions", f"{early:.1e}, {late:.1e}", "0, no drift")
    # each substep solves for the lengths anew, so nothing adds up; Newton's second round leaves the
    # square of the first one's error, which is below 1e-3
    assert late < 10 * early and max(off) < 1e-6


def test_positions_converge_to_first_order_in_the_substep(rope: Rope) -> None:
    ends = {}
    for substeps in (24, 48, 96, 768):
        chain = laid(rope)
        moved(chain, PULL, ACTION, substeps)
        ends[substeps] = chain.points[0].copy()
    errors = [float(np.abs(ends[k] - ends[768]).max()) for k in (24, 48, 96)]
    report(
        "error of positions, 24, 48, 96 substeps", [f"{1000 * e:.3f} mm" for e in errors], "-> 0"
    )
    # against 768 substeps the errors of order h are (1 / k - 1 / 768): ratios 2.07 and 2.14
    assert 1.6 < errors[0] / errors[1] < 2.6 and 1.6 < errors[1] / errors[2] < 2.6


def turned(qpos: Array, rope: Rope, turn: Array) -> Array:
    """Rotate qpos by a unit quaternion: positions and orientations of the free beads."""
    own = qpos.copy()
    w, r = turn[0], turn[1:]
    _, parents, qpos_at, _ = rope._trees
    for at in qpos_at[parents < 0]:
        place, spin = qpos[at : at + 3], qpos[at + 3 : at + 7]
        own[at : at + 3] = place + 2 * np.cross(r, np.cross(r, place) + w * place)
        own[at + 3] = w * spin[0] - r @ spin[1:]
        own[at + 4 : at + 7] = w * spin[1:] + spin[0] * r + np.cross(r, spin[1:])
    return own


@pytest.mark.parametrize(("kind", "most"), [(ChainSimulation, 1e-9), (MujocoSimulation, 1e-4)])
def test_rotated_ropes_stay_rotated_copies(rope: Rope, kind: type[Simulation], most: float) -> None:
    # most: rounding of 1e-16 that grows by the engines' conditioning; MuJoCo's solver (PGS) takes
    # a fixed number of sweeps over its closures and stops short of them
    turn = np.array([0.5, 0.5, -0.1, 0.7])
    turn /= np.linalg.norm(turn)
    qpos = rope.qpos(rope.from_curve(curled(2)))
    ends = []
    for own, spin in ((qpos, np.array([1.0, 0, 0, 0])), (turned(qpos, rope, turn), turn)):
        simulation = kind(1, rope)
        simulation.set_qpos(own[None])
        for force in (PULL, -PULL[::-1], PULL[[1, 2, 0]]):
            f = force + 2 * np.cross(spin[1:], np.cross(spin[1:], force) + spin[0] * force)
            simulation.step([BEAD], f[None])
        ends.append(simulation.points[0].copy())
    first, r = ends[0], turn[1:]
    rotated = first + 2 * np.cross(r, np.cross(r, first) + turn[0] * first)
    off = float(np.abs(rotated - ends[1]).max())
    report(f"rotated copy after 3 actions, {kind.engine}", f"off by {off:.1e} m", "0")
    assert off < most
