"""Policies of the old protocol by name, and as policies of the new one, until they are ported."""

from typing import Any

import numpy as np

from knotgym.control.demonstrator import Demonstrator, DemonstratorConfig
from knotgym.control.expert import Expert
from knotgym.control.old_basic_policies import ConstantPolicy as OldConstantPolicy
from knotgym.control.old_basic_policies import (
    MixedPolicy,
    NoisyPolicy,
    PlayPolicy,
    RandomPolicy,
    ScriptedPolicy,
)
from knotgym.control.planner_config import PlannerConfig
from knotgym.rope.actions import decode_actions


class Adapted:
    """A policy of the old protocol as one of `rollouts`."""

    def __init__(self, old: Any, name: str) -> None:
        self.old, self.name = old, name

    def compatible_task(self, task: Any) -> Any:
        return self.old.suited(task)

    def player(self, batch: Any) -> Any:
        return _Player(self, batch)


class _Player:
    def __init__(self, policy: Adapted, batch: Any) -> None:
        self._old, self._batch = policy.old, batch
        self.planned = np.zeros(batch.count, np.int64)
        self.names = [policy.name] * batch.count

    def begin(self, ids: Any, rngs: Any) -> None:
        for index, rng in zip(ids.tolist(), rngs, strict=True):
            self._old.begin(self._batch, index, rng)
            self.names[index] = self._old.name(index)

    def act(self, ids: Any) -> Any:
        from knotgym.control.rollouts import Pulls

        batch = self._batch
        if batch.task.action != "pull":
            view = batch.view
            deciding = ids[~view.busy[ids]]
            if len(deciding):
                view.begin(self._old.act(batch, deciding).actions, deciding)
            pulls = Pulls(ids, *view.pulls_of(ids))
            view.pulled(ids, np.zeros(len(ids), dtype=bool))
            return pulls
        chosen = self._old.act(batch, ids)
        actions = np.asarray(chosen.actions, np.float32)
        simulation = batch.simulation
        beads, _ = decode_actions(actions, simulation.points[ids], simulation.rope.config)
        self.planned[ids] = [self._old.effort(i).actions for i in ids.tolist()]
        macros = chosen.macros
        if macros is not None:
            macros = np.where(macros < 0, 0, macros) * (macros[:, 3:] != 0)
        return Pulls(ids, beads, actions[:, 3:], macros)


def old_policy(config: Any) -> Any:
    planner = PlannerConfig(budget=config.planner.budget, batch_size=config.planner.batch_size)
    expert = Demonstrator(DemonstratorConfig(), planner)
    noisy = NoisyPolicy("noisy", expert, config.noise)
    scripted = ScriptedPolicy(config.planner.macro_actions)
    made = {
        "random": RandomPolicy,
        "constant": OldConstantPolicy,
        "scripted": lambda: scripted,
        "expert": lambda: expert,
        "noisy": lambda: noisy,
        "play": lambda: PlayPolicy(DemonstratorConfig(), planner),
        "planner": lambda: Expert(planner),
        "mixed": lambda: MixedPolicy([RandomPolicy(), scripted, noisy, expert], config.shares),
    }
    return made[config.policy]()


def make_policy(config: Any) -> Any:
    from knotgym.control import policies, policy_config

    if config.policy in ("random", "constant", "scripted", *policy_config._PLANNED):
        return old_policy(config)
    made = policies._family(config.policy).make(config)
    return getattr(made, "old", made)
