"""Train OGBench's goal-conditioned agents: GCBC, GCIVL, GCIQL, CRL, HIQL.

    git clone https://github.com/seohongpark/ogbench
    knotgym suite --recorded --task tie --nx 2 --out sets
    python examples/learners/goal_conditioned.py gcbc sets/knotgym/*/{expert,noisy}-v0 \\
        --ogbench ogbench --task tie --nx 2 --out gcbc

Needs torch, jax, flax, optax, distrax and ml_collections, and a checkout of OGBench, because its
`impls` can't be installed as a package; its agents and their networks are used unchanged. An action
is a decision, see `decisions.py`: where to pull and the forces until the macro-action ends. A goal
is a Gauss code, in training that of a later state or of another episode's. Writes `agent.msgpack`
and `evaluation.json`.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
from decisions import BEADS, ChunkPolicy, Decisions, Floats, decision_options, nearest, read
from protocol import Training, measure, parser

LEARNERS = ("gcbc", "gcivl", "gciql", "crl", "hiql")
CODE = 12 * 14  # numbers that an observation ends with: the goal's code; before it, the rope's own
ARCS = slice(8 * BEADS, 9 * BEADS)  # of an observation, numbers of arcs
BATCH = 16  # decisions made at once; a fixed batch size is compiled only once


def states_and_goals(observations: Floats) -> tuple[Floats, Floats]:
    """Split observations; a goal has the size of a state, and shows nothing but its code."""
    states = observations[:, :-CODE].copy()
    states[:, ARCS] /= 10
    return states, _only_code(np.concatenate([states[:, :-CODE], observations[:, -CODE:]], axis=1))


def _only_code(states: Floats) -> Floats:
    shown = np.where(np.arange(states.shape[1]) < states.shape[1] - CODE, 0, states)
    # else the plain loop would be all zeros, and HIQL divides by the length of its features
    shown[:, 0] = 1
    return shown


def trajectories(rows: Decisions) -> dict[str, Any]:
    """Return decisions in the layout of OGBench: a row each, and one for the goal reached.

    That row shows its code alone, and its action is no pull.
    """
    own = rows.rows(~rows.hindsight)
    states, goals = states_and_goals(own.observations)
    reached = np.flatnonzero(own.terminals)
    order = np.argsort(np.concatenate([np.arange(len(states)), reached + 0.5]), kind="stable")
    observations = np.concatenate([states, goals[reached]])[order]
    nothing = np.zeros((len(reached), own.chunks.shape[1]), dtype=np.float32)
    terminals = np.concatenate([own.ends & ~own.terminals, np.ones(len(reached), bool)])[order]
    following = np.arange(len(order)) + 1
    following[terminals] -= 1
    return {
        "observations": observations,
        "next_observations": observations[following],
        "actions": np.concatenate([own.chunks, nothing])[order],
        "terminals": terminals.astype(np.float32),
    }


def drawing(loader: Any) -> Any:
    """Return how a loader of OGBench's draws batches whose goals are codes, reached where shown."""
    loader.get_observations = lambda rows: _only_code(loader.dataset["observations"][rows])

    def draw(count: int) -> Any:
        batch = loader.sample(count)
        shown = _only_code(batch["observations"]) == batch["value_goals"]
        batch["masks"] = 1.0 - shown.all(axis=1)
        batch["rewards"] = -batch["masks"] + (not loader.config["gc_negative"])
        return batch

    return draw


class AgentPolicy(ChunkPolicy):
    """Decides as an agent does at temperature 0."""

    def __init__(self, name: str, frame: str, agent: Any, key: Any) -> None:
        super().__init__(name, frame)
        self._agent, self._key = agent, key

    def choose(self, indices: list[int], seen: Floats, points: Floats) -> tuple[Any, Floats]:
        count = len(seen)
        padded = np.resize(seen, (-(-count // BATCH) * BATCH, seen.shape[1]))
        chunks = [
            self._agent.sample_actions(states, goals, seed=self._key, temperature=0.0)
            for states, goals in map(states_and_goals, np.split(padded, len(padded) // BATCH))
        ]
        return nearest(np.concatenate(chunks)[:count], points)


def main() -> None:
    options = decision_options(parser(__doc__ or "", LEARNERS))
    options.add_argument("--ogbench", type=Path, required=True, help="checkout of OGBench")
    options.add_argument("--agent", nargs="*", default=[], help="settings, as in alpha=1.0")
    options.set_defaults(steps=5000, batch=256, rate=3e-4)
    given = options.parse_args()
    if not (given.ogbench / "impls" / "agents").is_dir():
        options.error(f"{given.ogbench} isn't a checkout of OGBench: it has no impls/agents")
    sys.path.insert(0, str(given.ogbench / "impls"))
    data = importlib.import_module("utils.datasets")
    module = importlib.import_module(f"agents.{given.learner}")
    agents = importlib.import_module("agents").agents
    serialization = importlib.import_module("flax.serialization")
    jax = importlib.import_module("jax")

    training = Training(f"OGBench's agents, jax {jax.__version__}", given, given.datasets)
    np.random.seed(given.seed)  # OGBench draws batches from the global generator
    config = module.get_config()
    config.batch_size, config.lr = given.batch, given.rate
    if given.learner == "hiql":
        config.subgoal_steps = 1  # decisions
    for setting in given.agent:
        name, _, value = setting.partition("=")
        config[name] = type(config[name])(value)
    rows = trajectories(read(given.datasets, given.frame))
    loader = getattr(data, config.dataset_class)(data.Dataset.create(**rows), config)
    draw = drawing(loader)
    first = draw(1)
    agent = agents[given.learner].create(
        given.seed, first["observations"], first["actions"], config
    )
    for _ in range(given.steps):
        agent, _ = agent.update(draw(given.batch))
    (given.out / "agent.msgpack").write_bytes(serialization.to_bytes(agent.network.params))
    name = f"ogbench-{given.learner}"
    policy = AgentPolicy(name, given.frame, agent, jax.random.PRNGKey(given.seed))
    measure(name, policy, given, training.ended(), "agent.msgpack")


if __name__ == "__main__":
    main()
