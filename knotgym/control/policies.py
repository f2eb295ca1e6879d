"""Policies: who pulls. One interface for a batch of ropes, every draw from a generator handed in.

random          uniform in [-1, 1]^6
scripted        one macro-action after the other, without a goal
expert          plans in the simulator from the state the rope is in, see `expert`
noisy-expert    an expert; each pull is a random one instead with probability `noise`, and the
                expert plans anew
mixed           each episode is one of the four
module:function a function (observation, info, generator) -> action (6,), of the user's own; its
                module may lie in the current folder
FILE            a model that takes observations: .zip (Stable-Baselines3; FILE.zip:SAC for another
                algorithm than PPO),
                .onnx, or .pt (TorchScript)
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from knotgym.control.macro_actions import WaypointController, propose
from knotgym.control.planner import PlannerConfig
from knotgym.episode_batch import EpisodeBatch
from knotgym.errors import KnotgymError

NAMED = ("random", "scripted", "expert", "noisy-expert", "mixed")
MIXED = ("random", "scripted", "noisy-expert", "expert")


class InvalidPolicy(KnotgymError, ValueError):
    """There is no such policy, or it doesn't do what a policy does."""


class Choice(NamedTuple):
    """What a policy does in n episodes.

    Attributes:
        actions: float32 (n, 6), in [-1, 1].
        moves: why, a word or two each, "" where the policy gives no reasons.
    """

    actions: NDArray[np.float32]
    moves: list[str]


class Effort(NamedTuple):
    """What planning an episode took: simulated actions, and seconds of wall time."""

    actions: int = 0
    seconds: float = 0.0


class Policy(Protocol):
    """Acts in any of the episodes of one `EpisodeBatch`, each from its own generator."""

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        """Episode `index` has begun; every draw for it comes from `rng`."""

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        """Decide for the episodes `ids`, in rising order."""

    def name(self, index: int) -> str:
        """Who acts in episode `index`."""

    def effort(self, index: int) -> Effort:
        """What planning took in episode `index` so far."""


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Which policy.

    Attributes:
        policy: a name or a place, as in the module's first lines.
        noise: chance that a noisy expert's pull is a random one.
        shares: of random, scripted, noisy-expert and expert in a mixed policy.
        planner: of the experts.
    """

    policy: str = "random"
    noise: float = 0.1
    shares: tuple[float, ...] = (0.25, 0.25, 0.25, 0.25)
    planner: PlannerConfig = field(default_factory=PlannerConfig)

    def __post_init__(self) -> None:
        if not 0 <= self.noise <= 1:
            raise InvalidPolicy(f"noise must be in [0, 1], got {self.noise}")
        if len(self.shares) != len(MIXED) or min(self.shares) < 0 or sum(self.shares) <= 0:
            raise InvalidPolicy(
                f"shares must be {len(MIXED)} numbers of at least 0, not all 0, for"
                f" {', '.join(MIXED)}; got {self.shares}"
            )
        if (
            self.policy not in NAMED
            and ":" not in self.policy
            and Path(self.policy).suffix not in (".zip", ".onnx", ".pt")
        ):
            raise InvalidPolicy(
                f"no policy {self.policy!r}; there is {', '.join(NAMED)}, module:function, or a"
                " .zip, .onnx or .pt file"
            )

    @property
    def short(self) -> str:
        """A name for datasets, letters, digits and dashes."""
        stem = (
            self.policy
            if self.policy in NAMED
            else Path(self.policy.partition(":")[0]).stem.split(".")[-1]
        )
        return "".join(letter if letter.isalnum() else "-" for letter in stem)


def make_policy(config: PolicyConfig) -> Policy:
    """The policy of a configuration.

    Raises:
        InvalidPolicy: the function or file isn't there, or its library isn't installed.
    """
    from knotgym.control.expert import Expert

    if config.policy == "random":
        return Random()
    if config.policy == "scripted":
        return Scripted()
    if config.policy == "expert":
        return Expert(config.planner)
    if config.policy == "noisy-expert":
        return Noisy(Expert(config.planner), config.noise)
    if config.policy == "mixed":
        expert = Expert(config.planner)
        return Mixed([Random(), Scripted(), Noisy(expert, config.noise), expert], config.shares)
    from knotgym.control.learned_policies import load_model

    path, _, word = config.policy.partition(":")
    if Path(path).suffix in (".zip", ".onnx", ".pt"):
        return Learned(load_model(Path(path), word), config.short)
    return Own(_function(path, word), config.policy)


class _Plain:
    """What most policies share: a generator an episode, no planning."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._rngs: dict[int, np.random.Generator] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._rngs[index] = rng

    def name(self, index: int) -> str:
        return self._name

    def effort(self, index: int) -> Effort:
        return Effort()


class Random(_Plain):
    """Uniform actions."""

    def __init__(self) -> None:
        super().__init__("random")

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        return Choice(np.stack([uniform(self._rngs[int(i)]) for i in ids]), [""] * len(ids))


class Scripted(_Plain):
    """MacroAction after macro-action, any that may change something."""

    def __init__(self) -> None:
        super().__init__("scripted")
        self._controller = WaypointController(0)
        self._kinds: dict[int, str] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        super().begin(episodes, index, rng)
        if len(self._controller.beads) != episodes.count:
            self._controller = WaypointController(episodes.count)
        self._controller.release(index)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        simulation = episodes.simulation
        self._controller.advance(simulation.points)
        idle = self._controller.idle
        for i in ids:
            if idle[i]:
                macro_action = propose(simulation.points[i], self._rngs[int(i)])
                self._kinds[int(i)] = macro_action.kind
                self._controller.begin(int(i), macro_action)
        self._controller.advance(simulation.points)
        forces = self._controller.forces(simulation.points)[ids] * simulation.rope.config.max_force
        return Choice(
            simulation.actions(self._controller.beads[ids], forces, ids),
            [self._kinds[int(i)] for i in ids],
        )


class Forgetful(Policy, Protocol):
    """A policy that can be told that its plan no longer holds."""

    def forget(self, index: int) -> None:
        """Plan anew before the next action."""


class Noisy(_Plain):
    """Another policy, now and then replaced by a uniform action."""

    def __init__(self, inner: Forgetful, noise: float) -> None:
        super().__init__("noisy-expert")
        self._inner, self._noise = inner, noise

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        noise, inner = rng.spawn(2)
        super().begin(episodes, index, noise)
        self._inner.begin(episodes, index, inner)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        noisy = np.array([self._rngs[int(i)].random() < self._noise for i in ids])
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), ["noise"] * len(ids)
        sober = np.flatnonzero(~noisy)
        if len(sober):
            actions[sober], reasons = self._inner.act(episodes, ids[sober])
            for k, why in zip(sober, reasons, strict=True):
                moves[k] = why
        for k in np.flatnonzero(noisy):
            self._inner.forget(int(ids[k]))
            actions[k] = uniform(self._rngs[int(ids[k])])
        return Choice(actions, moves)

    def effort(self, index: int) -> Effort:
        return self._inner.effort(index)


class Mixed:
    """One of several policies for each episode, drawn at its begin."""

    def __init__(self, policies: list[Policy], shares: tuple[float, ...]) -> None:
        self._policies, self._shares = policies, np.array(shares) / sum(shares)
        self._chosen: dict[int, Policy] = {}

    def begin(self, episodes: EpisodeBatch, index: int, rng: np.random.Generator) -> None:
        self._chosen[index] = self._policies[rng.choice(len(self._policies), p=self._shares)]
        self._chosen[index].begin(episodes, index, rng)

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        actions, moves = np.zeros((len(ids), 6), dtype=np.float32), [""] * len(ids)
        for policy in self._policies:
            own = np.array(
                [k for k, i in enumerate(ids) if self._chosen[int(i)] is policy], dtype=np.int64
            )
            if len(own):
                actions[own], reasons = policy.act(episodes, ids[own])
                for k, why in zip(own, reasons, strict=True):
                    moves[k] = why
        return Choice(actions, moves)

    def name(self, index: int) -> str:
        return self._chosen[index].name(index)

    def effort(self, index: int) -> Effort:
        return self._chosen[index].effort(index)


class Own(_Plain):
    """A user's function of one observation, its info and a generator."""

    def __init__(
        self, function: Callable[[Any, dict[str, Any], np.random.Generator], Any], name: str
    ) -> None:
        super().__init__(name)
        self._function = function

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        return _checked(
            [
                self._function(
                    episodes.observation(int(i)), episodes.info(int(i)), self._rngs[int(i)]
                )
                for i in ids
            ],
            self._name,
        )


class Learned(_Plain):
    """A model that maps a batch of observations to a batch of actions."""

    def __init__(self, model: Callable[[Any], Any], name: str) -> None:
        super().__init__(name)
        self._model = model

    def act(self, episodes: EpisodeBatch, ids: NDArray[np.int64]) -> Choice:
        seen = [episodes.observation(int(i)) for i in ids]
        batch = (
            {name: np.stack([one[name] for one in seen]) for name in seen[0]}
            if isinstance(seen[0], dict)
            else np.stack(seen)
        )
        return _checked(list(np.asarray(self._model(batch))), self._name)


def uniform(rng: np.random.Generator) -> NDArray[np.float32]:
    """A uniform action, float32 (6,)."""
    return rng.uniform(-1, 1, 6).astype(np.float32)


def _checked(actions: list[Any], name: str) -> Choice:
    """Actions of somebody else's, cut to [-1, 1]."""
    array = np.array([np.asarray(action, dtype=np.float32).reshape(-1) for action in actions])
    if array.shape != (len(actions), 6) or not np.isfinite(array).all():
        raise InvalidPolicy(
            f"policy {name} must give 6 finite numbers an episode, got {array[:1].tolist()}"
        )
    return Choice(np.clip(array, -1, 1), [""] * len(actions))


def _function(module: str, word: str) -> Callable[[Any, dict[str, Any], np.random.Generator], Any]:
    if os.getcwd() not in sys.path:
        # a user's file lies where the command is typed; last, so that it hides nothing
        sys.path.append(os.getcwd())
    try:
        found = getattr(importlib.import_module(module), word)
    except (ImportError, AttributeError, ValueError, SyntaxError) as error:
        raise InvalidPolicy(f"no policy {module}:{word}: {error}") from error
    if not callable(found):
        raise InvalidPolicy(
            f"policy {module}:{word} must be a function (observation, info, generator) -> action"
        )
    function: Callable[[Any, dict[str, Any], np.random.Generator], Any] = found
    return function
