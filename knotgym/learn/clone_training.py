"""Train the clone: supervised on decisions, then on its own play; resumable and reproducible.

Weights are averaged over steps, and of the averages the one with the lowest held-out loss is kept:
a few thousand decisions are learned by heart in minutes. In a round of improvement the clone plays
the tasks of its data in the chain engine, and goes on training on all decisions that are on a way
to a goal (`clone_play`): what a network did, a network can learn.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import knotgym
from knotgym.common.atomic_files import remove
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.datasets.episode_reader import EpisodeReader
from knotgym.envs.tasks import TaskConfig
from knotgym.learn.checkpoint import read_card
from knotgym.learn.clone_config import CloneConfig
from knotgym.learn.clone_data import (
    Decisions,
    Examples,
    examples,
    join,
    load_decisions,
    read_decisions,
    save_decisions,
)
from knotgym.learn.clone_demonstrations import demonstrated_tasks, demonstrations
from knotgym.learn.clone_network import WORKING, CloneNetwork, inputs
from knotgym.learn.clone_play import play
from knotgym.learn.clone_policy import ClonePolicy, load_clone, save_clone
from knotgym.learn.imagination import BEADS
from knotgym.learn.training import begin_training, draw_curve, keep_training, run_training
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.macro_actions import WaypointController, pass_straight
from knotgym.runs.progress import Progress, Status
from knotgym.runs.run_options import REFUSE_EXISTING, Existing
from knotgym.states.state_file import ships
from knotgym.topology.gauss import GaussCode

_WARM_UP = 50  # steps over which the learning rate rises
_LEAST_RATE = 0.02  # of the peak, at the last step
_JUDGING_STEPS = 500  # of the clone that tells how predictable a demonstrator is
_JUDGED = 2048  # held-out decisions on which weights are judged, at most


class CloneTraining:
    """A clone in training.

    Attributes:
        network: as trained so far.
        step: steps done.
        curve: step, mean training loss since the last row, and held-out loss of the averaged
            weights.
    """

    def __init__(self, config: CloneConfig) -> None:
        """Begin a training.

        Raises:
            InvalidInput: the clone to go on from has another network.
            InvalidFile: it is missing, changed or truncated.
        """
        # more threads would sum in another order and round otherwise
        torch.set_num_threads(1)
        torch.manual_seed(config.seed)
        self._config = config
        self.network = CloneNetwork(config.width, config.layers)
        if config.start:
            earlier = load_clone(Path(config.start)).network.state_dict()
            own = self.network.state_dict()
            if {k: v.shape for k, v in own.items()} != {k: v.shape for k, v in earlier.items()}:
                raise InvalidInput(
                    f"the clone to go on from, {config.start}, has another width or layers than"
                    f" {config.width} and {config.layers}"
                )
            self.network.load_state_dict(earlier)
        self._optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=config.rate, weight_decay=config.decay, fused=True
        )
        self._start = {name: own.clone() for name, own in self.network.state_dict().items()}
        self._average = {name: own.clone() for name, own in self._start.items()}
        self._best, self._least = self._average, math.inf
        self.step, self.curve = 0, list[tuple[int, float, float]]()

    def advance(
        self, data: Examples, held: Examples, start: int, stop: int, played: int = 0
    ) -> None:
        """Train on `data` for up to `judge_every` steps of those from `start` to `stop`.

        The learning rate falls by a cosine over them; then the weights are judged on `held`. The
        last `played` rows of the data are from play, and have their share of each batch.
        """
        config, losses = self._config, list[float]()
        self.network.train()
        for _ in range(min(config.judge_every, stop - self.step)):
            done = (self.step - start) / (stop - start)
            falling = _LEAST_RATE + (1 - _LEAST_RATE) * (0.5 + 0.5 * math.cos(math.pi * done))
            for group in self._optimizer.param_groups:
                group["lr"] = config.rate * min(1.0, (self.step + 1) / _WARM_UP) * falling
            rng = generator(Stream.LEARN_CLONE, config.seed, self.step)
            rows = self._drawn(len(data.intended) - played, played, rng)
            loss = self._loss(self.network, data.rows(rows))
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
            self._optimizer.step()
            self.step += 1
            losses.append(loss.item())
            # the average forgets the first steps faster
            share = min(config.average, self.step / (self.step + 20))
            with torch.no_grad():
                for name, own in self.network.state_dict().items():
                    self._average[name].mul_(share).add_(own, alpha=1 - share)
        averaged = self._made(self._average)
        with torch.no_grad():
            judged = self._loss(averaged, held).item() if len(held.intended) else losses[-1]
        if judged < self._least:
            self._least, self._best = judged, {k: v.clone() for k, v in self._average.items()}
        self.curve.append((self.step, float(np.mean(losses)), judged))

    def ended(self) -> CloneNetwork:
        """Return the network with the weights that training ends with.

        They are the averaged ones of least held-out loss, or after rounds of improvement the last.
        """
        ended, blend = self._average if self._config.improve else self._best, self._config.blend
        return self._made({k: own.lerp(self._start[k], blend) for k, own in ended.items()})

    def averaged(self) -> CloneNetwork:
        """Return the network with the averaged weights."""
        return self._made(self._average)

    def state(self) -> dict[str, Tensor]:
        """Return the tensors that `restore` needs to resume."""
        tensors = {f"network.{name}": own for name, own in self.network.state_dict().items()}
        tensors |= {f"average.{name}": own for name, own in self._average.items()}
        tensors |= {f"best.{name}": own for name, own in self._best.items()}
        for number, moments in self._optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{number}.{name}": own for name, own in moments.items()}
        tensors["curve"] = torch.tensor(self.curve, dtype=torch.float64).reshape(-1, 3)
        tensors["least"] = torch.tensor([self._least], dtype=torch.float64)
        return {name: own.clone() for name, own in tensors.items()}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Resume from what `state` returned."""
        parts: dict[str, dict[str, Tensor]] = {"network": {}, "average": {}, "best": {}}
        moments: dict[int, dict[str, Tensor]] = {}
        for name, own in tensors.items():
            part, _, rest = name.partition(".")
            if part == "optimizer":
                number, _, moment = rest.partition(".")
                moments.setdefault(int(number), {})[moment] = own
            elif part in parts:
                parts[part][rest] = own
        self.network.load_state_dict(parts["network"])
        self._average, self._best = parts["average"], parts["best"]
        self._optimizer.load_state_dict({**self._optimizer.state_dict(), "state": moments})
        self.curve = [(int(row[0]), row[1], row[2]) for row in tensors["curve"].tolist()]
        self._least = tensors["least"].item()
        self.step = self.curve[-1][0] if self.curve else 0

    def _made(self, weights: dict[str, Tensor]) -> CloneNetwork:
        network = CloneNetwork(self._config.width, self._config.layers)
        network.load_state_dict(weights)
        return network.eval()

    def _drawn(self, given: int, played: int, rng: np.random.Generator) -> NDArray[np.int64]:
        batch = self._config.batch
        own = round(self._config.play.share * batch) if played else 0
        if not own:
            return rng.integers(given, size=batch)
        rows = rng.integers(given, size=batch - own), given + rng.integers(played, size=own)
        return np.concatenate(rows)

    def _loss(self, network: CloneNetwork, data: Examples) -> Tensor:
        states = inputs(data.seen)
        macros = torch.from_numpy(data.macros)
        if self._config.action == "macro":
            losses = network.macro_loss(states, macros)
        else:
            losses = network.pull_loss(states, macros[:, 0, 0], torch.from_numpy(data.forces))
        return losses.sum(1).mean()


def train_clone(
    datasets: Sequence[Any],
    out: Path,
    config: CloneConfig,
    *,
    existing: Existing = REFUSE_EXISTING,
    workers: int = 1,
    quiet: bool = False,
    progress: Progress | None = None,
) -> ClonePolicy:
    """Train a clone on datasets and write its checkpoint folder.

    Args:
        datasets: ids or folders of train-split episodes; for `action` "macro" of a policy that
            chooses macro-actions.
        out: folder to create.
        config: settings.
        existing: what to do with an earlier training in `out`.
        workers: processes that make demonstrations, 0 for one per core; doesn't change the result.
        quiet: show no progress; ignored if `progress` is given.
        progress: where to show it.

    Raises:
        As `training.train`.
    """
    if progress is None:
        with Progress(quiet) as progress:
            return train_clone(
                datasets, out, config, existing=existing, workers=workers, progress=progress
            )
    shown = progress

    def read() -> tuple[Decisions, str]:
        if not datasets and not config.demonstrations.episodes:
            raise InvalidInput(
                "nothing to learn from: name datasets, as in --data FOLDER, or let demonstrations"
                " be made, as in --demonstrations 1000"
            )
        CloneTraining(config)  # refuses an unsuitable `start` before demonstrations take minutes
        decisions = read_decisions(datasets, config)
        return decisions, decisions.digest

    def make(decisions: Decisions, request: dict[str, Any], folder: Path) -> None:
        kept, began = begin_training(folder, request)
        before = int(decisions.episodes.max(initial=-1)) + 1
        own, source = demonstrations(config, before, folder, workers, shown)
        decisions = join([decisions, own])
        tasks = tasks_of(datasets, demonstrated_tasks(config.demonstrations))
        if config.start:
            source["start_sha256"] = read_card(Path(config.start))["weights_sha256"]
        network, curve, facts = fit_clone(decisions, config, tasks, shown, folder, kept, began)
        remove(folder / "made")
        made = {
            "knotgym": knotgym.__version__,
            **request,
            "data": ["/".join(Path(str(one)).parts[-3:]) for one in datasets],
            **facts,
            **source,
            "seconds": round(time.perf_counter() - began),
        }
        save_clone(folder / "made", network, made)
        draw_curve(folder / "made", ("training", "held_out"), curve)

    run_training(datasets, out, config, existing, progress, read, make)
    return load_clone(out)


def fit_clone(
    decisions: Decisions,
    config: CloneConfig,
    tasks: Sequence[TaskConfig] = (),
    progress: Progress | None = None,
    folder: Path | None = None,
    kept: dict[str, Tensor] | None = None,
    began: float = 0.0,
) -> tuple[CloneNetwork, list[tuple[int, float, float]], dict[str, Any]]:
    """Train a clone on decisions, then by play.

    Args:
        decisions: of demonstrators.
        config: settings.
        tasks: what to play in rounds of improvement.
        progress: where to show progress.
        folder: staging folder to save to; None to keep nothing.
        kept: what a training that is resumed had saved there.
        began: when it began, see `begin_training`.

    Returns:
        The network, the curve (see `CloneTraining`), and facts for its card.
    """
    progress = progress or Progress(quiet=True)
    training = CloneTraining(config)
    if kept:
        training.restore(kept)

    held = _held_out(decisions.episodes, config)
    rows, judged = np.flatnonzero(~held), np.flatnonzero(held)
    fitted = examples(decisions.rows(rows))
    aside = examples(decisions.rows(judged[:: len(judged) // _JUDGED + 1]))

    def train(start: int, stop: int) -> None:
        while training.step < stop:
            training.advance(fitted, aside, start, stop, len(fitted.intended) - len(rows))
            progress.show(status)
            if folder is not None:
                keep_training(folder, training.state(), began)

    def status() -> Status:
        facts = {"held-out loss": f"{training.curve[-1][2]:.3f}"} if training.curve else {}
        last = config.steps + config.improve * config.round_steps
        return Status(training.step, last, "steps of the clone", facts, even=True)

    progress.stage("training the clone")
    train(0, config.steps)
    rates = list[dict[str, float]]()
    known = sorted(set(decisions.goals.tolist()))
    for number in range(config.improve):
        stop = config.steps + (number + 1) * config.round_steps
        path = folder / f"round-{number}.safetensors" if folder is not None else None
        if path is not None and path.exists():
            own, rate = load_decisions(path)
        else:
            progress.stage(f"playing, round {number + 1} of {config.improve}")
            own, rate = _play(training.averaged(), tasks, config, number, known)
            if path is not None:
                save_decisions(path, own, rate)
        fitted = fitted.plus(examples(own))
        rates.append(dict(sorted(rate.items())))
        progress.say(f"round {number + 1}: " + ", ".join(f"{k} {v:.0%}" for k, v in rate.items()))
        train(stop - config.round_steps, stop)
    progress.show(status, last=True)
    network = training.ended()
    facts = {
        "episodes": len(np.unique(decisions.episodes)),
        "decisions": int(decisions.intended.sum()),
        "decisions_in_hindsight_and_of_copies": int((~decisions.intended).sum()),
        "held_out": _first_guesses(network, decisions, config),
        "play": rates,
    }
    return network, training.curve, facts


class Predictability(NamedTuple):
    """How well a clone predicts the macro-actions of held-out episodes.

    Attributes:
        bead_top1: share of the decisions whose bead is the network's first guess.
        r2: of the six numbers of the pull that begins the macro-action (x, y, z of the bead and of
            the force, canonical frame), the share of the variance that the guess explains.
        decisions: number of decisions.
    """

    bead_top1: float
    r2: tuple[float, ...]
    decisions: int


def predictability(datasets: Sequence[Any], config: CloneConfig | None = None) -> Predictability:
    """Train a clone on a demonstrator's datasets and judge it on held-out episodes."""
    config = config or CloneConfig(steps=_JUDGING_STEPS, held_out=0.2, hindsight=0, copies=0)
    decisions = read_decisions(datasets, config)
    network, _, _ = fit_clone(decisions, config)
    held = np.flatnonzero(_held_out(decisions.episodes, config) & decisions.intended)
    aside = examples(decisions.rows(held))
    count = len(held)
    with torch.no_grad():
        states = inputs(aside.seen)
        looked = network(states)
        first, likely = looked.logits.argmax(1).numpy(), network.likely(looked)
        chances, works = network.rate(looked, likely)
        chosen = likely[torch.arange(count), (chances + WORKING * works).argmax(1)]
    taken = aside.macros[:, 0]
    guess, wanted = (_first_pulls(aside.seen.points, one) for one in (chosen.numpy(), taken))
    left = ((guess - wanted) ** 2).mean(0) / wanted.var(0)
    share = float((first == taken[:, 0]).mean())
    return Predictability(share, tuple((1 - left).tolist()), count)


def _first_pulls(points: NDArray[Any], macros: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where macro-actions (n, 3) first pull, and the force, float64 (n, 6)."""
    ropes, config = points.astype(np.float64), MacroActionConfig()
    controller = WaypointController(len(ropes), config)
    for row, (bead, target, over) in enumerate(macros.tolist()):
        macro_action = pass_straight(ropes[row], bead, target, 2 * over - 1, config)
        controller.begin(row, macro_action, ropes[row])
    pulled = ropes[np.arange(len(ropes)), macros[:, 0]]
    return np.concatenate([pulled, controller.forces(ropes)], axis=1)


def _first_guesses(
    network: CloneNetwork, decisions: Decisions, config: CloneConfig
) -> dict[str, dict[str, float]]:
    """Tell how often the likeliest bead is the one chosen, in held-out decisions, by nx."""
    aside = decisions.intended & _held_out(decisions.episodes, config)
    found = dict[str, dict[str, float]]()
    crossings = np.array([goal.count("+") for goal in decisions.goals.tolist()])
    for nx in np.unique(crossings[aside]).tolist():
        own = examples(decisions.rows(np.flatnonzero(aside & (crossings == nx))[:_JUDGED]))
        with torch.no_grad():
            guesses = network(inputs(own.seen)).logits.argmax(1).numpy()
        apart = np.abs(guesses - own.macros[:, 0, 0])
        found[f"nx {nx}"] = {
            "decisions": len(guesses),
            "bead_first_guess": float(np.mean(apart == 0)),
            "bead_within_two": float(np.mean(np.minimum(apart, BEADS - apart) <= 2)),
        }
    return found


def tasks_of(datasets: Sequence[Any], more: Sequence[TaskConfig] = ()) -> list[TaskConfig]:
    """Return tasks, one of each kind and nx: those of datasets, with the path of their states."""
    tasks = {(task.task, task.nx): task for task in more}
    for dataset in datasets:
        reader = EpisodeReader(dataset)
        states = reader.task.states if ships(reader.task.states) else str(reader.states_path())
        tasks[reader.task.task, reader.task.nx] = replace(reader.task, states=states)
        reader.close()
    return list(tasks.values())


def _play(
    network: CloneNetwork,
    tasks: Sequence[TaskConfig],
    config: CloneConfig,
    number: int,
    known: Sequence[str],
) -> tuple[Decisions, dict[str, float]]:
    """Play one round of all tasks; return the decisions and the success rates by task."""
    codes = [GaussCode.parse(text) for text in known]
    parts, rates = list[Decisions](), dict[str, float]()
    for place, task in enumerate(tasks):
        goals = [code for code in codes if code.nx == task.goal_nx]
        order = number * len(tasks) + place
        played = play(network, task, config, order, goals)
        parts.append(played.decisions)
        rates[f"{task.task} {task.nx}"] = played.success_rate
    return join(parts), rates


def _held_out(episodes: NDArray[np.int64], config: CloneConfig) -> NDArray[np.bool_]:
    """Draw which decisions are held out, by whole episodes of the datasets."""
    numbers = np.unique(episodes[episodes >= 0])
    rng = generator(Stream.LEARN_HELD_OUT, config.seed)
    drawn = rng.permutation(numbers)[: round(config.held_out * len(numbers))]
    return np.isin(episodes, drawn)
