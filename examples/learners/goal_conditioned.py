"""Train OGBench's goal-conditioned agents on state observations: GCBC, GCIVL, GCIQL, CRL, HIQL.

    git clone https://github.com/seohongpark/ogbench
    knotgym suite --task tie,convert --nx 2,3 --states readable --out benchmark
    python examples/learners/goal_conditioned.py gcivl benchmark/knotgym/*/noisy-v0 \\
        --ogbench ogbench --out gcivl

Needs jax, flax, optax, distrax and ml_collections, and a checkout of OGBench, because its `impls`
can't be installed as a package; its agents and data loader are used unchanged. The data are what
`knotgym dataset export --to ogbench` writes. Training goals are states of the episodes, so rewards
are unused; in evaluation the agent gets the goal's exemplar. Writes `agent.msgpack` and
`evaluation.json`.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from protocol import Training, measure, parser

from knotgym.control.learned_policies import ModelPolicy
from knotgym.datasets.exports.ogbench_export import to_ogbench

LEARNERS = ("gcbc", "gcivl", "gciql", "crl", "hiql")
SCALE = 5.0  # scales metres to values of about 1
BATCH = 8  # episodes evaluated at once; a fixed batch size is compiled only once


def arrays_of(datasets: list[str]) -> dict[str, NDArray[Any]]:
    """Concatenate the exported training files in the layout that the agents need.

    An episode of T actions has T rows, and the last of them is terminal.
    """
    parts: dict[str, list[NDArray[Any]]] = {}
    for dataset in datasets:
        with TemporaryDirectory() as folder:
            to_ogbench(dataset, folder)
            (path,) = Path(folder).glob("*-train.npz")
            with np.load(path) as file:
                ends = file["terminals"]
                states, actions = SCALE * file["observations"], file["actions"]
        acted = np.flatnonzero(~ends)
        for name, values in {
            "observations": states[acted],
            "actions": actions[acted],
            "next_observations": states[acted + 1],
            "terminals": ends[acted + 1].astype(np.float32),
        }.items():
            parts.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in parts.items()}


def acting(agent: Any, key: Any) -> Any:
    """Return a policy from observations (n, 600), vertices of rope and goal, to actions (n, 6)."""

    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        count = len(observations)
        several = np.resize(SCALE * observations, (max(count, BATCH), 600))
        rope, goal = np.split(several, 2, axis=1)
        # temperature 0, as in OGBench's evaluation; the key then hardly matters
        actions = agent.sample_actions(observations=rope, goals=goal, seed=key, temperature=0.0)
        return np.clip(np.asarray(actions)[:count], -1, 1)

    return act


def main() -> None:
    options = parser(__doc__ or "", LEARNERS)
    options.add_argument("--ogbench", type=Path, required=True, help="checkout of OGBench")
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
    config.batch_size = given.batch
    batches = getattr(data, config.dataset_class)(
        data.Dataset.create(**arrays_of(given.datasets)), config
    )
    first = batches.sample(1)
    agent = agents[given.learner].create(
        given.seed, first["observations"], first["actions"], config
    )
    for _ in range(given.steps):
        agent, _ = agent.update(batches.sample(given.batch))
    (given.out / "agent.msgpack").write_bytes(serialization.to_bytes(agent.network.params))
    name = f"ogbench-{given.learner}"
    measure(
        name,
        ModelPolicy(acting(agent, jax.random.PRNGKey(given.seed)), name),
        given,
        training.ended(),
        "agent.msgpack",
    )


if __name__ == "__main__":
    main()
