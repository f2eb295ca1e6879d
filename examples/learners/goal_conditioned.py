"""OGBench's own goal-conditioned agents on state observations: GCBC, GCIVL, GCIQL, CRL and HIQL.

    git clone https://github.com/seohongpark/ogbench
    knotgym suite --task tie,convert --nx 2,3 --states readable --out benchmark
    python examples/learners/goal_conditioned.py gcivl benchmark/knotgym/*/scripted-v0 \\
        --ogbench ogbench --out gcivl

Needs jax, flax, optax, distrax and ml_collections, and a checkout of OGBench, whose agents and
reader of data are used as they are: its `impls` isn't a package that could be installed. What they
read is what `knotgym dataset export --to ogbench` writes. Their goals are states that episodes come
to, so rewards play no part; the goal's exemplar is what they are shown. Writes `agent.msgpack` and
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
SCALE = 5.0  # metres to numbers of about 1
SIDE_BY_SIDE = 8  # episodes that are played at once: batches of one size are compiled once


def arrays_of(datasets: list[str]) -> dict[str, NDArray[Any]]:
    """The training files of the export, one after another, in the form that the agents take:
    an episode of T actions has T rows, and the last of them is terminal.
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
    """A function of observations (n, 600), vertices of rope and goal, to actions (n, 6)."""

    def act(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        count = len(observations)
        several = np.resize(SCALE * observations, (max(count, SIDE_BY_SIDE), 600))
        rope, goal = np.split(several, 2, axis=1)
        # at temperature 0 as OGBench evaluates; the key then decides next to nothing
        actions = agent.sample_actions(observations=rope, goals=goal, seed=key, temperature=0.0)
        return np.clip(np.asarray(actions)[:count], -1, 1)

    return act


def main() -> None:
    options = parser(__doc__ or "", LEARNERS)
    options.add_argument("--ogbench", type=Path, required=True, help="its checkout")
    given = options.parse_args()
    if not (given.ogbench / "impls" / "agents").is_dir():
        options.error(f"{given.ogbench} is no checkout of OGBench: it has no impls/agents")
    sys.path.insert(0, str(given.ogbench / "impls"))
    data = importlib.import_module("utils.datasets")
    module = importlib.import_module(f"agents.{given.learner}")
    agents = importlib.import_module("agents").agents
    serialization = importlib.import_module("flax.serialization")
    jax = importlib.import_module("jax")

    training = Training(f"OGBench's agents, jax {jax.__version__}", given, given.datasets)
    np.random.seed(given.seed)  # its batches are drawn from there
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
