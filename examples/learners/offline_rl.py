"""Train d3rlpy on state observations: behaviour cloning, IQL, TD3+BC, CQL or decision transformer.

    knotgym suite --task tie,convert --nx 2,3 --states readable --out benchmark
    python examples/learners/offline_rl.py iql benchmark/knotgym/*/noisy-v0 --out iql

Needs d3rlpy, best in an environment of its own because it pins Gymnasium 1.0.0: pip install d3rlpy.
By default (--relabel all) every code that an episode passes through also serves as a goal that it
reached. --labelled adds datasets of `knotgym collect --policy POLICY.pt --labels expert`, with the
expert's actions as targets; behaviour cloning with them is DAgger, reported as d3rlpy-bc-dagger.
Writes `model.d3`, `evaluation.json`, and `policy.pt` for `knotgym evaluate --policy` (not for the
transformer, which is stateful).
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

try:
    import d3rlpy
    import structlog
except ModuleNotFoundError as error:
    raise SystemExit("offline_rl.py needs d3rlpy: pip install d3rlpy") from error
from numpy.typing import NDArray
from protocol import Training, measure, parser

from knotgym.control.learned_policies import ModelPolicy, load_model
from knotgym.control.own_policies import OwnPolicy
from knotgym.control.policy import Policy
from knotgym.loaders import to_d3rlpy

LEARNERS = {
    "bc": "BCConfig",
    "iql": "IQLConfig",
    "td3bc": "TD3PlusBCConfig",
    "cql": "CQLConfig",
    "dt": "DecisionTransformerConfig",
}
RETURN = 5.0  # return of an episode that reaches its goal


class Transformer:
    """A decision transformer in one episode, conditioned on the return of a success."""

    def __init__(self, learner: Any) -> None:
        self._learner, self._own = learner, None

    def __deepcopy__(self, memo: dict[int, Any]) -> Transformer:
        return Transformer(self._learner)  # weights are shared, the context isn't

    def reset(self) -> None:
        self._own = self._learner.as_stateful_wrapper(target_return=RETURN)

    def act(self, observation: NDArray[np.float32]) -> Any:
        assert self._own is not None
        return np.clip(self._own.predict(observation, 0.0), -1, 1)  # rewards before the end are 0


def buffer_of(datasets: list[str], relabel: str | None, labelled: list[str]) -> Any:
    """Load all episodes into one buffer; labelled ones with the expert's actions."""
    played = (to_d3rlpy(one, observation="state", relabel=relabel) for one in datasets)
    taught = (to_d3rlpy(one, observation="state", labels=True) for one in labelled)
    whole, *others = (*played, *taught)
    for other in others:
        for episode in other.episodes:
            whole.append_episode(episode)
    return whole


def main() -> None:
    options = parser(__doc__ or "", tuple(LEARNERS))
    options.add_argument(
        "--relabel", choices=("all", "last", "none"), default="all", help="hindsight goals"
    )
    options.add_argument("--labelled", nargs="+", default=[], help="datasets with expert actions")
    given = options.parse_args()
    # d3rlpy logs every setting, including the means of all 600 inputs
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    training = Training(f"d3rlpy {d3rlpy.__version__}", given, [*given.datasets, *given.labelled])
    d3rlpy.seed(given.seed)
    config = getattr(d3rlpy.algos, LEARNERS[given.learner])(
        batch_size=given.batch,
        observation_scaler=d3rlpy.preprocessing.StandardObservationScaler(),
    )
    learner = config.create(device="cpu:0")
    learner.fit(
        buffer_of(
            given.datasets, None if given.relabel == "none" else given.relabel, given.labelled
        ),
        n_steps=given.steps,
        n_steps_per_epoch=given.steps,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )
    learner.save(str(given.out / "model.d3"))
    name = f"d3rlpy-{given.learner}{'-dagger' if given.labelled else ''}"
    policy: Policy
    if given.learner == "dt":
        policy = OwnPolicy(Transformer(learner), name)
    else:
        learner.save_policy(str(given.out / "policy.pt"))
        policy = ModelPolicy(load_model(given.out / "policy.pt"), name)
    report = {**training.ended(), "relabel": given.relabel}
    measure(name, policy, given, report, "model.d3")


if __name__ == "__main__":
    main()
