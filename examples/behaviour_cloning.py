"""Behaviour cloning on the expert's state observations, and what it reaches beside random and expert.

    knotgym collect --task tie --nx 2 --policy expert --episodes 200 --observation state --out bc-data
    python examples/behaviour_cloning.py bc-data/knotgym/tie-nx2/expert-v0 --out bc

A small network in NumPy sees the rope and its goal as vertices, turned into a frame of the rope's own, and learns two things:
which of the beads the expert pulls (cross-entropy) and with which force (squared error). Turns about z and mirrors, which are
exact symmetries of the rope, make many episodes of one. Writes `policy.npz`, `curve.csv`, `curve.png` and `success.json`.
"""

from __future__ import annotations

import argparse
import csv
import functools
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.generate.evaluate import EvaluateConfig, run
from knotgym.generate.planner import PlannerConfig
from knotgym.generate.policies import PolicyConfig
from knotgym.loaders import arrays
from knotgym.rope import RopeConfig

Array = NDArray[np.float32]
ROPE = RopeConfig()
SCALE = 5.0  # metres to numbers of about 1
WEIGHTS = "KNOTGYM_BC_WEIGHTS"  # environment variable with the path of the weights, for `act`


class Network:
    """Two hidden layers of ReLU, trained with Adam; a bead's logits and a force for each bead's pull."""

    def __init__(self, sizes: tuple[int, ...], rng: np.random.Generator) -> None:
        pairs = zip(sizes[:-1], sizes[1:], strict=True)
        self.weights: list[Array] = []
        for inputs, outputs in pairs:
            self.weights += [rng.normal(0, np.sqrt(2 / inputs), (inputs, outputs)).astype(np.float32), np.zeros(outputs, np.float32)]
        self._first = [np.zeros_like(w) for w in self.weights]
        self._second = [np.zeros_like(w) for w in self.weights]
        self._steps = 0

    def layers(self, x: Array) -> list[Array]:
        """Inputs and outputs of every layer."""
        out = [x]
        for k in range(0, len(self.weights), 2):
            x = out[-1] @ self.weights[k] + self.weights[k + 1]
            out.append(np.maximum(x, 0) if k < len(self.weights) - 2 else x)
        return out

    def learn(self, layers: list[Array], slope: Array, rate: float) -> None:
        """One step of Adam down the slope of the loss by the outputs."""
        self._steps += 1
        for k in range(len(self.weights) - 2, -1, -2):
            slopes = layers[k // 2].T @ slope, slope.sum(axis=0)
            slope = (slope @ self.weights[k].T) * (layers[k // 2] > 0)
            for at, one in zip((k, k + 1), slopes, strict=True):
                self._first[at] += 0.1 * (one - self._first[at])
                self._second[at] += 0.001 * (one**2 - self._second[at])
                mean, square = self._first[at] / (1 - 0.9**self._steps), self._second[at] / (1 - 0.999**self._steps)
                self.weights[at] -= rate * mean / (np.sqrt(square) + 1e-8)


def seen(ropes: Array) -> Array:
    """Rope and goal (n, 2, beads, 3), metres, as the network sees them: about their centres, every second vertex; float32 (n, inputs)."""
    centred = ropes - ropes.mean(axis=2, keepdims=True)
    return (SCALE * centred[:, :, ::2]).reshape(len(ropes), -1).astype(np.float32)


def turned(ropes: Array, forces: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """The same turned about z by any angle, rope and goal by one each (a goal's code does not turn with it)."""
    out, angles = ropes.copy(), rng.uniform(-np.pi, np.pi, (2, len(ropes)))
    for side, angle in enumerate(angles):
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        x, y = ropes[:, side, :, 0], ropes[:, side, :, 1]
        out[:, side, :, 0], out[:, side, :, 1] = c * x - s * y, s * x + c * y
    c, s = np.cos(angles[0]), np.sin(angles[0])
    pulled = np.stack([c * forces[:, 0] - s * forces[:, 1], s * forces[:, 0] + c * forces[:, 1], forces[:, 2]], axis=1)
    return out.astype(np.float32), pulled.astype(np.float32)


def losses(network: Network, x: Array, beads: NDArray[np.int64], forces: Array) -> tuple[float, float, Array, list[Array]]:
    """Cross-entropy of the bead, squared error of the force, their slope by the outputs, and the layers."""
    layers, rows = network.layers(x), np.arange(len(x))
    logits, pulled = layers[-1][:, : ROPE.beads], layers[-1][:, ROPE.beads :].reshape(len(x), ROPE.beads, 3)
    chance = np.exp(logits - logits.max(axis=1, keepdims=True))
    chance /= chance.sum(axis=1, keepdims=True)
    near = np.minimum(np.abs(np.arange(ROPE.beads) - beads[:, None]), ROPE.beads - np.abs(np.arange(ROPE.beads) - beads[:, None]))
    wanted = np.exp(-0.5 * (near / 2) ** 2)
    wanted /= wanted.sum(axis=1, keepdims=True)  # a neighbour is nearly as good
    off = pulled[rows, beads] - forces
    slope = np.zeros_like(layers[-1])
    slope[:, : ROPE.beads] = (chance - wanted) / len(x)
    slope[:, ROPE.beads :].reshape(len(x), ROPE.beads, 3)[rows, beads] = 2 * off / len(x)
    return float(-(wanted * np.log(chance + 1e-9)).sum(axis=1).mean()), float((off**2).sum(axis=1).mean()), slope, layers


def train(dataset: str, epochs: int, seed: int, console: Console) -> tuple[Network, list[dict[str, float]]]:
    """Clone the expert; every tenth episode is held out for the curve."""
    data: dict[str, Any] = arrays(dataset, observation="state")
    ropes = np.asarray(data["observations"], dtype=np.float32).reshape(-1, 2, ROPE.beads, 3)
    actions = np.asarray(data["actions"], dtype=np.float32)
    beads = ((ropes[:, 0] - ROPE.reach * actions[:, None, :3]) ** 2).sum(axis=2).argmin(axis=1)
    forces, ends = actions[:, 3:], np.asarray(data["terminals"], dtype=bool) | np.asarray(data["timeouts"], dtype=bool)
    episode = np.concatenate([[0], np.cumsum(ends)[:-1]])
    held = episode % 10 == 9
    rng = np.random.default_rng(seed)
    network = Network((seen(ropes[:1]).shape[1], 512, 256, 4 * ROPE.beads), rng)
    curve = []
    rows = np.flatnonzero(~held)
    for epoch in range(epochs):
        rate = 1e-3 * 0.5 * (1 + np.cos(np.pi * epoch / epochs))
        sums = np.zeros(2)
        batches = np.array_split(rng.permutation(rows), max(1, len(rows) // 128))
        for batch in batches:
            moved, pulled = turned(ropes[batch], forces[batch], rng)
            bead, force, slope, layers = losses(network, seen(moved), beads[batch], pulled)
            network.learn(layers, slope, rate)
            sums += bead, force
        row = {"epoch": epoch + 1, "train_bead": sums[0] / len(batches), "train_force": sums[1] / len(batches)}
        if held.any():
            row["held_bead"], row["held_force"] = losses(network, seen(ropes[held]), beads[held], forces[held])[:2]
        curve.append({name: float(value) for name, value in row.items()})
        if epoch % 10 == 9:
            console.print("  ".join(f"{name} {value:.3f}" for name, value in curve[-1].items()), highlight=False)
    return network, curve


@functools.cache
def _trained(path: str) -> Network:
    with np.load(path) as file:
        weights = [file[f"arr_{k}"] for k in range(len(file.files))]
    network = Network((1, 1), np.random.default_rng(0))
    network.weights = weights
    return network


def act(observation: Array, info: dict[str, Any], rng: np.random.Generator) -> Array:
    """The cloned policy, for `knotgym evaluate --policy behaviour_cloning:act` (weights named by KNOTGYM_BC_WEIGHTS)."""
    ropes = np.asarray(observation, dtype=np.float32).reshape(1, 2, ROPE.beads, 3)
    out = _trained(os.environ[WEIGHTS]).layers(seen(ropes))[-1][0]
    chance = np.exp(out[: ROPE.beads] - out[: ROPE.beads].max()) ** 2
    bead = int(rng.choice(ROPE.beads, p=chance / chance.sum()))
    return np.clip(np.concatenate([ropes[0, 0, bead] / ROPE.reach, out[ROPE.beads :].reshape(-1, 3)[bead]]), -1, 1).astype(np.float32)


def draw(curve: list[dict[str, float]], path: Path) -> None:
    """The training curve: both losses, trained on (full) and held out (pale)."""
    width, height, edge = 640, 240, 24
    picture = np.full((2 * height, width, 3), 255, np.uint8)
    for panel, loss in enumerate(("bead", "force")):
        lines = {name: [row[name] for row in curve if name in row] for name in (f"train_{loss}", f"held_{loss}")}
        top = max(max(values) for values in lines.values() if values)
        for (name, values), colour in zip(lines.items(), ((160, 60, 20), (90, 170, 240)), strict=True):
            x = edge + np.arange(len(values)) * (width - 2 * edge) / max(1, len(curve) - 1)
            y = panel * height + height - edge - np.array(values) / top * (height - 2 * edge)
            cv2.polylines(picture, [np.stack([x, y], axis=1).astype(np.int32)], False, colour, 2, cv2.LINE_AA)
            place = (edge + 300 * name.startswith("held"), panel * height + 16)
            cv2.putText(picture, f"{name} {values[-1] if values else 0:.3f}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    cv2.imwrite(str(path), picture)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", help="Minari id or folder of expert episodes with states")
    parser.add_argument("--epochs", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=128, help="of each policy in the evaluation")
    parser.add_argument("--expert-episodes", type=int, default=32, help="of the expert, which plans for seconds an episode")
    parser.add_argument("--nx", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("bc"))
    args = parser.parse_args()
    console = Console(width=150)
    args.out.mkdir(parents=True, exist_ok=True)
    network, curve = train(args.dataset, args.epochs, args.seed, console)
    np.savez(args.out / "policy.npz", *network.weights)
    with open(args.out / "curve.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(curve[0]))
        writer.writeheader()
        writer.writerows(curve)
    draw(curve, args.out / "curve.png")
    os.environ[WEIGHTS] = str((args.out / "policy.npz").resolve())
    here = str(Path(__file__).resolve().parent)
    os.environ["PYTHONPATH"] = os.pathsep.join([here, *filter(None, [os.environ.get("PYTHONPATH")])])  # where workers find `act`
    cheap = EvaluateConfig(
        policies=(PolicyConfig(policy="random"), PolicyConfig(policy="behaviour_cloning:act")),
        nx=(args.nx,),
        splits=("train", "test"),
        episodes=args.episodes,
        seed=args.seed,
    )
    dear = replace(cheap, policies=(PolicyConfig(policy="expert", planner=PlannerConfig()),), splits=("test",), episodes=args.expert_episodes)
    for name, config in (("success", cheap), ("success_expert", dear)):
        run(config, workers=args.workers, out=args.out / f"{name}.json", video=None, quiet=False, console=console)


if __name__ == "__main__":
    main()
