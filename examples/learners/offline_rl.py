"""Train d3rlpy on decisions: behaviour cloning, TD3+BC, IQL, CQL, decision transformer.

    knotgym suite --task tie --nx 2 --states readable --split train --policies expert,noisy \\
        --episodes expert=200,noisy=1200 --out sets
    python examples/learners/offline_rl.py discrete-bc sets/knotgym/*/{expert,noisy}-v0 \\
        --task tie --nx 2 --out bc

Needs d3rlpy, best in an environment of its own because it pins Gymnasium 1.0.0: pip install d3rlpy.
The discrete learners choose the bead by classification; behaviour cloning then says how it is
pulled. The others choose the position of the bead and the pulls as one vector of numbers. Writes
`model.pt` and `evaluation.json`.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

try:
    import d3rlpy
    import structlog
except ModuleNotFoundError as error:
    raise SystemExit("offline_rl.py needs d3rlpy: pip install d3rlpy") from error
import torch
from d3rlpy.dataset import MDPDataset
from d3rlpy.models.encoders import EncoderFactory, VectorEncoderFactory
from decisions import (
    BEADS,
    ChunkPolicy,
    Decisions,
    Eyes,
    Floats,
    decision_options,
    nearest,
    read,
)
from protocol import Training, measure, parser
from torch import Tensor, nn

LEARNERS = {
    "discrete-bc": "DiscreteBCConfig",
    "discrete-cql": "DiscreteCQLConfig",
    "bc": "BCConfig",
    "td3bc": "TD3PlusBCConfig",
    "iql": "IQLConfig",
    "cql": "CQLConfig",
    "dt": "DecisionTransformerConfig",
}
CLONED = "bc", "discrete-bc"
RETURN = 5.0  # of an episode that reaches its goal


class Encoder(nn.Module):
    """Encodes an observation, and perhaps a bead (one-hot, after it) or an action."""

    def __init__(
        self, size: int, bead: bool, action_size: int = 0, hidden: int = 192, width: int = 64
    ) -> None:
        super().__init__()
        self._eyes, self._size, self._bead = Eyes(width), size - BEADS * bead, bead
        self._body = nn.Sequential(
            nn.Linear(self._eyes.size + action_size, hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
        )

    def forward(self, x: Tensor, *action: Tensor) -> Tensor:
        seen = self._eyes.look(x[:, : self._size], x[:, self._size :] if self._bead else None)
        encoded: Tensor = self._body(torch.cat([seen, *action], dim=1))
        return encoded


class BeadLogits(nn.Module):
    """Encodes an observation as a number for each bead."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self._eyes = Eyes(width)

    def forward(self, x: Tensor) -> Tensor:
        logits: Tensor = self._eyes(x).logits
        return logits


@dataclass
class BeadEncoderFactory(EncoderFactory):
    """Makes d3rlpy's networks see beads.

    Attributes:
        sees: "logits" for learners that choose a bead, "bead" where one is given, else "rope".
        width: of the attention.
    """

    sees: str = "rope"
    width: int = 64

    def create(self, observation_shape: Any) -> Any:
        """Make the encoder of a policy."""
        if self.sees == "logits":
            return BeadLogits(self.width)
        return Encoder(observation_shape[0], self.sees == "bead", width=self.width)

    def create_with_action(
        self, observation_shape: Any, action_size: int, discrete_action: bool = False
    ) -> Any:
        """Make the encoder of a critic."""
        return Encoder(observation_shape[0], False, action_size, width=self.width)

    @staticmethod
    def get_type() -> str:
        """Return the name under which d3rlpy stores the factory."""
        return "knotgym-beads"


def trained(name: str, sees: str, given: Any, rows: Decisions, seen: Floats, acted: Any) -> Any:
    """Train a learner of d3rlpy on rows, in the order of their episodes."""
    falling = d3rlpy.optimizers.CosineAnnealingLRFactory(T_max=given.steps)
    optimizer = d3rlpy.optimizers.AdamWFactory(
        weight_decay=0.02,
        clip_grad_norm=1.0,
        # what a critic is to learn changes with the critic until the end
        lr_scheduler_factory=falling if name in (*CLONED, "dt") else None,
    )
    kind = getattr(d3rlpy.algos, LEARNERS[name])
    eyes = BeadEncoderFactory(sees, given.width) if given.width else VectorEncoderFactory()
    ours: dict[str, Any] = {"encoder_factory": eyes, "optim_factory": optimizer}
    ours |= {"learning_rate": given.rate, "target_update_interval": 200}
    settings = {
        field.name: value
        for field in fields(kind)
        for ending, value in ours.items()
        if field.name.endswith(ending)
    }
    learner = kind(batch_size=given.batch, **settings).create(device=given.device)
    discrete = name.startswith("discrete")
    learner.fit(
        MDPDataset(
            seen,
            acted,
            rows.rewards,
            rows.terminals.astype(np.float32),
            (rows.ends & ~rows.terminals).astype(np.float32),
            action_space=d3rlpy.ActionSpace[("CONTINUOUS", "DISCRETE")[discrete]],
            action_size=BEADS if discrete else acted.shape[1],
        ),
        n_steps=given.steps,
        n_steps_per_epoch=given.steps,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )
    return learner


def imitated(rows: Decisions) -> Decisions:
    """Return the rows worth imitating, as one episode: what follows a decision doesn't matter."""
    own = rows.rows(rows.chosen)
    last = np.arange(len(own.beads)) == len(own.beads) - 1
    return own._replace(terminals=last, ends=last)


def with_bead(seen: Floats, beads: Any) -> Floats:
    """Return observations with a one-hot bead after each."""
    return np.concatenate([seen, np.eye(BEADS, dtype=np.float32)[beads]], axis=1)


class LearnedPolicy(ChunkPolicy):
    """Acts as a learner of d3rlpy decides."""

    def __init__(self, name: str, frame: str, learner: Any, puller: Any) -> None:
        """Take a learner of whole decisions, or one of beads, and one that says how to pull."""
        super().__init__(name, frame)
        self._learner, self._puller = learner, puller
        self._contexts: dict[int, Any] = {}  # of a transformer, by episode

    def begin(self, index: int, rng: np.random.Generator) -> None:
        super().begin(index, rng)
        if hasattr(self._learner, "as_stateful_wrapper"):
            self._contexts[index] = self._learner.as_stateful_wrapper(target_return=RETURN)

    def choose(self, indices: list[int], seen: Floats, points: Floats) -> tuple[Any, Floats]:
        if self._puller is not None:
            beads = self._learner.predict(seen)
            return beads, self._puller.predict(with_bead(seen, beads))
        if self._contexts:  # rewards before the end are 0
            pairs = zip(indices, seen, strict=True)
            return nearest(
                np.stack([self._contexts[index].predict(one, 0.0) for index, one in pairs]), points
            )
        return nearest(self._learner.predict(seen), points)


def main() -> None:
    options = decision_options(parser(__doc__ or "", tuple(LEARNERS)))
    options.add_argument(
        "--width", type=int, default=64, help="of the attention over beads; 0: two dense layers"
    )
    options.add_argument("--device", default="cpu:0", help="where d3rlpy trains, such as cuda:0")
    given = options.parse_args()
    # d3rlpy logs every setting
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    training = Training(f"d3rlpy {d3rlpy.__version__}", given, given.datasets)
    d3rlpy.seed(given.seed)
    torch.set_num_threads(1)
    every = read(given.datasets, given.frame)
    rows = imitated(every) if given.learner in CLONED else every.rows(~every.hindsight)
    name = f"d3rlpy-{given.learner}"
    puller, files = None, ["model.pt"]
    if given.learner.startswith("discrete"):
        beads = rows.beads[:, None].astype(np.int32)
        learner = trained(given.learner, "logits", given, rows, rows.observations, beads)
        # the pulls of a bead are learned from macro-actions that weren't cut short
        own = imitated(every.rows(every.whole))
        seen = with_bead(own.observations, own.beads)
        puller = trained("bc", "bead", given, own, seen, own.chunks[:, 3:])
        puller.save_model(str(given.out / "puller.pt"))
        files.append("puller.pt")
    else:
        learner = trained(given.learner, "rope", given, rows, rows.observations, rows.chunks)
    learner.save_model(str(given.out / "model.pt"))
    policy = LearnedPolicy(name, given.frame, learner, puller)
    measure(name, policy, given, training.ended(), *files)


if __name__ == "__main__":
    main()
