"""Behaviour cloning on the expert's state observations, and what it reaches beside random and
expert.

    knotgym collect --task tie --nx 2 --policy expert --episodes 300 --observation state \\
        --out bc-data
    python examples/behaviour_cloning.py bc-data/knotgym/tie-nx2/expert-v0 --out bc

A small network in NumPy learns two things: which of the beads the expert moves (cross-entropy) and
with which force (squared error). Turns about z, mirrors and the exchange of over and under are
exact symmetries of the rope, so every rope is first brought into one frame: turned so that the loop
begins at the right, reflected so that it runs counter-clockwise, and switched so that the goal's
code begins with an over. The goal is told by its code, read off the goal that is observed.
Hindsight adds the codes that an episode passed. Writes `policy.npz`, `curve.csv`, `curve.png`,
`success.json` and `success_expert.json`.
"""

from __future__ import annotations

import argparse
import csv
import functools
import os
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.control.planner import PlannerConfig
from knotgym.control.policies import PolicyConfig
from knotgym.generate.episodes.evaluate import EvaluateConfig, run
from knotgym.loaders import arrays
from knotgym.rope import RopeConfig
from knotgym.topology.crossings import find_crossings
from knotgym.topology.gauss import GaussCode

Array = NDArray[np.float32]
ROPE = RopeConfig()
SCALE = 5.0  # metres to numbers of about 1
VISITS = 8  # of a code, that the network sees
WEIGHTS = "KNOTGYM_BC_WEIGHTS"  # environment variable with the path of the weights, for `act`


class Frame(NamedTuple):
    """How a rope is brought into the network's frame.

    Attributes:
        reflect, switch: x -> -x, z -> -z.
        turn: then about z, radians.
    """

    reflect: bool
    switch: bool
    turn: float

    def into(self, vectors: NDArray[Any]) -> NDArray[Any]:
        """Positions about the middle, or forces, (..., 3)."""
        mirrored = vectors * (-1.0 if self.reflect else 1.0, 1.0, -1.0 if self.switch else 1.0)
        return _turned(mirrored, self.turn)

    def back(self, vectors: NDArray[Any]) -> NDArray[Any]:
        """The inverse of `into`."""
        return _turned(vectors, -self.turn) * (
            -1.0 if self.reflect else 1.0,
            1.0,
            -1.0 if self.switch else 1.0,
        )


def frame_of(rope: NDArray[Any], goal: GaussCode) -> Frame:
    """The frame of a rope (beads, 3): by the larger of the two waves that run once round the
    rope.
    """
    flat = (rope[:, 0] - rope[:, 0].mean()) + 1j * (rope[:, 1] - rope[:, 1].mean())
    wave = np.exp(2j * np.pi * np.arange(len(rope)) / len(rope))
    forwards, backwards = (flat * wave.conj()).sum(), (flat * wave).sum()
    reflect = abs(backwards) > abs(forwards)
    return Frame(
        bool(reflect),
        bool(goal.visits) and goal.visits[0] < 0,
        -float(np.angle(-backwards.conj() if reflect else forwards)),
    )


def seen(rope: NDArray[Any], goal: GaussCode, frame: Frame) -> Array:
    """What the network sees of a rope (beads, 3), float32 (inputs,): every second vertex, its code
    and where it crosses, the goal's code.
    """
    moved = frame.into(rope - rope.mean(axis=0))
    crossings = find_crossings(np.ascontiguousarray(moved, dtype=np.float64))
    places = np.zeros(VISITS)
    visits = np.sort(np.concatenate([crossings.over_place, crossings.under_place]))[:VISITS]
    places[: len(visits)] = visits / ROPE.beads
    wanted = goal.mirrored() if frame.switch else goal
    return np.concatenate(
        [SCALE * moved[::2].ravel(), _hot(crossings.code), places, _hot(wanted)]
    ).astype(np.float32)


class Network:
    """Two hidden layers of ReLU, trained with Adam; a bead's logits and a force for each
    bead.
    """

    def __init__(self, sizes: tuple[int, ...], rng: np.random.Generator) -> None:
        pairs = zip(sizes[:-1], sizes[1:], strict=True)
        self.weights: list[Array] = []
        for inputs, outputs in pairs:
            self.weights += [
                rng.normal(0, np.sqrt(2 / inputs), (inputs, outputs)).astype(np.float32),
                np.zeros(outputs, np.float32),
            ]
        self._first = [np.zeros_like(w) for w in self.weights]
        self._second = [np.zeros_like(w) for w in self.weights]
        self._steps = 0

    def layers(self, x: Array) -> list[Array]:
        """Inputs and outputs of every layer."""
        values = [x]
        for k in range(0, len(self.weights), 2):
            x = values[-1] @ self.weights[k] + self.weights[k + 1]
            values.append(np.maximum(x, 0) if k < len(self.weights) - 2 else x)
        return values

    def learn(self, layers: list[Array], slope: Array, rate: float) -> None:
        """One step of Adam down the slope of the loss by the outputs, with weights that decay."""
        self._steps += 1
        for k in range(len(self.weights) - 2, -1, -2):
            slopes = layers[k // 2].T @ slope, slope.sum(axis=0)
            slope = (slope @ self.weights[k].T) * (layers[k // 2] > 0)
            for at, gradient in zip((k, k + 1), slopes, strict=True):
                self._first[at] += 0.1 * (gradient - self._first[at])
                self._second[at] += 0.001 * (gradient**2 - self._second[at])
                mean, square = (
                    self._first[at] / (1 - 0.9**self._steps),
                    self._second[at] / (1 - 0.999**self._steps),
                )
                self.weights[at] -= rate * (
                    mean / (np.sqrt(square) + 1e-8) + 0.02 * self.weights[at] * (at == k)
                )


class Examples(NamedTuple):
    """What the expert did, n times, in the network's frame.

    Attributes:
        inputs: float32 (n, inputs).
        beads: int64 (n,), those that were moved.
        forces: float32 (n, 3), in units of the largest.
        held: bool (n,), of an episode kept for the curve.
    """

    inputs: Array
    beads: NDArray[np.int64]
    forces: Array
    held: NDArray[np.bool_]


def examples(dataset: str, nx: int) -> Examples:
    """The transitions that led to codes of nx crossings; every tenth such sequence is held out."""
    data: dict[str, Any] = arrays(dataset, observation="state", relabel="all")
    ropes = np.asarray(data["observations"], dtype=np.float64).reshape(-1, 2, ROPE.beads, 3)
    actions = np.asarray(data["actions"], dtype=np.float32)
    sequence = np.concatenate([[0], np.cumsum(data["terminals"])[:-1]])
    inputs, beads, forces, sequences = [], [], [], []
    goal, last = GaussCode(()), -1
    for row, ((rope, wanted), action) in enumerate(zip(ropes, actions, strict=True)):
        if sequence[row] != last:
            goal, last = find_crossings(wanted).code.plain, int(sequence[row])
        if goal.nx == nx:
            frame = frame_of(rope, goal)
            inputs.append(seen(rope, goal, frame))
            beads.append(int(((rope - ROPE.reach * action[:3]) ** 2).sum(axis=1).argmin()))
            forces.append(frame.into(action[3:]))
            sequences.append(last)
    number = np.unique(sequences, return_inverse=True)[1]
    return Examples(
        np.array(inputs), np.array(beads), np.array(forces, dtype=np.float32), number % 10 == 9
    )


def losses(
    network: Network, x: Array, beads: NDArray[np.int64], forces: Array
) -> tuple[float, float, Array, list[Array]]:
    """Cross-entropy of the bead, squared error of the force, their slope by the outputs, and the
    layers.
    """
    layers, rows = network.layers(x), np.arange(len(x))
    logits, applied = (
        layers[-1][:, : ROPE.beads],
        layers[-1][:, ROPE.beads :].reshape(len(x), ROPE.beads, 3),
    )
    chance = np.exp(logits - logits.max(axis=1, keepdims=True))
    chance /= chance.sum(axis=1, keepdims=True)
    near = np.minimum(
        np.abs(np.arange(ROPE.beads) - beads[:, None]),
        ROPE.beads - np.abs(np.arange(ROPE.beads) - beads[:, None]),
    )
    wanted = np.exp(-0.5 * (near / 2) ** 2)
    wanted /= wanted.sum(axis=1, keepdims=True)  # a neighbour is nearly as good
    off = applied[rows, beads] - forces
    slope = np.zeros_like(layers[-1])
    slope[:, : ROPE.beads] = (chance - wanted) / len(x)
    slope[:, ROPE.beads :].reshape(len(x), ROPE.beads, 3)[rows, beads] = 2 * off / len(x)
    return (
        float(-(wanted * np.log(chance + 1e-9)).sum(axis=1).mean()),
        float((off**2).sum(axis=1).mean()),
        slope,
        layers,
    )


def train(
    data: Examples, epochs: int, seed: int, console: Console
) -> tuple[Network, list[dict[str, float]]]:
    """Clone the expert; the network kept is the one with the least loss on what is held out."""
    rng = np.random.default_rng(seed)
    network = Network((data.inputs.shape[1], 256, 256, 4 * ROPE.beads), rng)
    rows, curve, best = np.flatnonzero(~data.held), [], np.inf
    kept = network.weights
    for epoch in range(epochs):
        rate = 1e-3 * 0.5 * (1 + np.cos(np.pi * epoch / epochs))
        sums = np.zeros(2)
        batches = np.array_split(rng.permutation(rows), max(1, len(rows) // 128))
        for batch in batches:
            noised = data.inputs[batch] + rng.normal(
                0, 0.02, (len(batch), data.inputs.shape[1])
            ).astype(np.float32)
            bead, force, slope, layers = losses(
                network, noised, data.beads[batch], data.forces[batch]
            )
            network.learn(layers, slope, rate)
            sums += bead, force
        held = losses(
            network, data.inputs[data.held], data.beads[data.held], data.forces[data.held]
        )[:2]
        row = {
            "epoch": epoch + 1,
            "train_bead": sums[0] / len(batches),
            "train_force": sums[1] / len(batches),
        }
        curve.append(
            {
                name: float(value)
                for name, value in (row | {"held_bead": held[0], "held_force": held[1]}).items()
            }
        )
        if sum(held) < best:
            best, kept = sum(held), [w.copy() for w in network.weights]
        if epoch % 10 == 9:
            console.print(
                "  ".join(f"{name} {value:.3f}" for name, value in curve[-1].items()),
                highlight=False,
            )
    network.weights = kept
    return network, curve


@functools.cache
def _trained(path: str) -> Network:
    with np.load(path) as file:
        weights = [file[f"arr_{k}"] for k in range(len(file.files))]
    network = Network((1, 1), np.random.default_rng(0))
    network.weights = weights
    return network


def act(observation: Array, info: dict[str, Any], rng: np.random.Generator) -> Array:
    """The cloned policy, for `knotgym evaluate --policy behaviour_cloning:act` (weights named by
    KNOTGYM_BC_WEIGHTS).
    """
    rope, wanted = np.asarray(observation, dtype=np.float64).reshape(2, ROPE.beads, 3)
    goal = find_crossings(wanted).code.plain
    frame = frame_of(rope, goal)
    scores = _trained(os.environ[WEIGHTS]).layers(seen(rope, goal, frame)[None])[-1][0]
    chance = np.exp(scores[: ROPE.beads] - scores[: ROPE.beads].max()) ** 2
    bead = int(rng.choice(ROPE.beads, p=chance / chance.sum()))
    force = frame.back(scores[ROPE.beads :].reshape(-1, 3)[bead])
    return np.clip(np.concatenate([rope[bead] / ROPE.reach, force]), -1, 1).astype(np.float32)


def draw(curve: list[dict[str, float]], path: Path) -> None:
    """The training curve: both losses, trained on (blue) and held out (orange)."""
    width, height, edge = 640, 240, 24
    picture = np.full((2 * height, width, 3), 255, np.uint8)
    for panel, loss in enumerate(("bead", "force")):
        lines = {name: [row[name] for row in curve] for name in (f"train_{loss}", f"held_{loss}")}
        top = max(max(values) for values in lines.values())
        for (name, values), colour in zip(
            lines.items(), ((160, 60, 20), (90, 170, 240)), strict=True
        ):
            x = edge + np.arange(len(values)) * (width - 2 * edge) / max(1, len(curve) - 1)
            y = panel * height + height - edge - np.array(values) / top * (height - 2 * edge)
            cv2.polylines(
                picture, [np.stack([x, y], axis=1).astype(np.int32)], False, colour, 2, cv2.LINE_AA
            )
            place = (edge + 300 * name.startswith("held"), panel * height + 16)
            cv2.putText(
                picture,
                f"{name} {values[-1]:.3f}",
                place,
                cv2.FONT_HERSHEY_SIMPLEX,
                0.45,
                colour,
                1,
                cv2.LINE_AA,
            )
    cv2.imwrite(str(path), picture)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", help="Minari id or folder of expert episodes with states")
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument(
        "--episodes",
        type=int,
        default=128,
        help="of random and clone each, in both splits; 0 for none",
    )
    parser.add_argument(
        "--expert-episodes",
        type=int,
        default=32,
        help="of the expert, which plans for seconds an episode; 0 for none",
    )
    parser.add_argument("--nx", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("bc"))
    args = parser.parse_args()
    console = Console(width=150)
    data = examples(args.dataset, args.nx)
    if not data.held.any():
        parser.error(
            f"{args.dataset} leads to codes of {args.nx} crossings fewer than 10 times: too little"
            " to learn from"
        )
    args.out.mkdir(parents=True, exist_ok=True)
    console.print(
        f"{len(data.beads)} examples, {data.held.sum()} of them held out", highlight=False
    )
    network, curve = train(data, args.epochs, args.seed, console)
    np.savez(args.out / "policy.npz", *network.weights)
    with open(args.out / "curve.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(curve[0]))
        writer.writeheader()
        writer.writerows(curve)
    draw(curve, args.out / "curve.png")
    os.environ[WEIGHTS] = str((args.out / "policy.npz").resolve())
    cheap = (PolicyConfig(policy="random"), PolicyConfig(policy="behaviour_cloning:act"))
    expert = (PolicyConfig(policy="expert", planner=PlannerConfig()),)
    for name, policies, splits, episodes in (
        ("success", cheap, ("train", "test"), args.episodes),
        ("success_expert", expert, ("test",), args.expert_episodes),
    ):
        if episodes:
            config = EvaluateConfig(
                policies=policies, nx=(args.nx,), splits=splits, episodes=episodes, seed=args.seed
            )
            run(
                config,
                workers=args.workers,
                out=args.out / f"{name}.json",
                video=None,
                quiet=False,
                console=console,
            )


def _hot(code: GaussCode) -> Array:
    """The first visits of a code: of each its label up to 4, over or under, one of eight; float32
    (VISITS * 8,).
    """
    hot = np.zeros((VISITS, 8), np.float32)
    for k, visit in enumerate(code.visits[:VISITS]):
        if abs(visit) <= 4:
            hot[k, 2 * abs(visit) - 2 + (visit < 0)] = 1
    return hot.ravel()


def _turned(vectors: NDArray[Any], angle: float) -> NDArray[Any]:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(vectors @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))


if __name__ == "__main__":
    main()
