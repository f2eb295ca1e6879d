"""Train one of eight offline learners in torch, on decisions.

    python examples/learners/offline_torch.py IQL knotgym/tie-nx2/varied-bench-v0 --out iql.pt

Writes iql.pt and iql.py, a policy: `knotgym evaluate --policy iql:act`, in the same folder. All
have the same networks, optimizer and batches, so what they differ in is their loss:

    DiscreteBC  classifies the bead and regresses the forces
    BC, GCBC    regress the decision; for the episode's goal, for a state that its episode reached
    Flow        learns a velocity field from noise to decisions (flow matching, arXiv 2210.02747)
    IQL         arXiv 2110.06169, with advantage-weighted regression
    TD3BC       arXiv 2106.06860, with an update of the actor for each of the critics
    GCIVL       IQL's value of states and goals, without critics (OGBench, arXiv 2410.20092)
    CRL         a classifier of goals reached from goals at random (arXiv 2206.07568), and TD3BC's
                actor on its logits
"""

import copy
import shlex
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("offline_torch.py needs torch: pip install '.[torch]'") from error
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy

from knotgym.common import sha256
from knotgym.datasets import columns_of
from knotgym.loaders import GoalSampling, Window, arrays

MODULE = """import torch
from knotgym.loaders import as_policy

FILES = [__file__[:-3] + ".pt"]
CARD = {card}  # what an entry claims of the training
torch.set_num_threads(1)
network = torch.jit.load(FILES[0]).eval()


@torch.inference_mode()
def predict(observations):
    found = network(torch.from_numpy(observations))
    # of each bead there is a score, too, which has no bounds
    return (found.clamp(-1, 1) if found.ndim == 2 else found).numpy()


act = as_policy(predict)
"""
DECISION, BEADS = 43, 100
EXPECTILE, POLYAK, GREED, WEIGHT, LARGEST = 0.9, 0.01, 2.5, 3.0, 100.0
# goals of each set: the episode's own, states that it reached later, any, and a mixture for values
GOALS = {
    "own": None,
    "reached": GoalSampling(p_currgoal=0, p_trajgoal=1, p_randomgoal=0, geom_sample=False),
    "random": GoalSampling(p_currgoal=0, p_trajgoal=0, p_randomgoal=1),
    "mixed": GoalSampling(),
}
Batch = dict[str, Tensor]


class Network(nn.Module):
    """Three layers over inputs that are standardized by the rows `like` (n, inputs)."""

    def __init__(self, like: Tensor, outputs: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("mean", like.mean(0))
        self.register_buffer("std", like.std(0).clamp(min=1e-3))
        sizes = like.shape[1], 512, 512
        layers = [
            nn.Sequential(nn.Linear(size, 512), nn.LayerNorm(512), nn.ReLU(), nn.Dropout(dropout))
            for size in sizes[:2]
        ]
        self.body = nn.Sequential(*layers, nn.Linear(512, outputs))

    def forward(self, inputs: Tensor) -> Tensor:
        return self.body((inputs - self.mean) / self.std)


class BC:
    """A learner: its networks, and the loss of a batch."""

    sets: tuple[str, ...] = ("own",)
    outputs = DECISION

    def __init__(self, data: Batch) -> None:
        self.actor = self.policy = Network(data["observations"], self.outputs, 0.1)
        self.networks: list[nn.Module] = [self.actor]
        self.targets: list[tuple[nn.Module, nn.Module]] = []

    def target(self, network: nn.Module) -> nn.Module:
        """A copy that follows a network slowly, and passes no gradient to it."""
        self.networks.append(network)
        self.targets.append((network, copy.deepcopy(network).requires_grad_(False)))
        return self.targets[-1][1]

    def loss(self, *batches: Batch) -> Tensor:
        return self.errors(batches[0]).mean()

    def errors(self, batch: Batch) -> Tensor:
        return (self.actor(batch["observations"]) - batch["actions"]).square().mean(1)

    def greedy(self, critics: nn.Module, batch: Batch) -> Tensor:
        """TD3+BC's loss of the actor: the critics' least value, beside the error of a clone."""
        chosen = self.actor(batch["observations"]).clamp(-1, 1)
        worth = critics(torch.cat([batch["observations"], chosen], 1)).amin(1)
        return self.errors(batch).mean() - GREED * (worth / worth.abs().mean().detach()).mean()


class GCBC(BC):
    sets = ("reached",)


class OfEachBead(nn.Module):
    """A score of each bead, and the last numbers of a decision, the same for all."""

    def __init__(self, actor: Network) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, seen: Tensor) -> Tensor:
        scores, pulls = self.actor(seen).split([100, 40], 1)
        return torch.cat([scores[:, :, None], pulls[:, None].expand(-1, 100, -1)], 2)


class DiscreteBC(BC):
    outputs = BEADS + DECISION - 3

    def __init__(self, data: Batch) -> None:
        super().__init__(data)
        self.policy = OfEachBead(self.actor)

    def loss(self, *batches: Batch) -> Tensor:
        (batch,) = batches
        logits, pulls = self.actor(batch["observations"]).split([BEADS, DECISION - 3], 1)
        right = cross_entropy(logits, batch["beads"], label_smoothing=0.05)
        return right + 4 * (pulls - batch["actions"][:, 3:]).square().mean()


class Sampler(nn.Module):
    """Decisions from a velocity field, begun in the middle of the noise."""

    def __init__(self, field: Network) -> None:
        super().__init__()
        self.field = field

    def forward(self, seen: Tensor) -> Tensor:
        decisions = torch.zeros(len(seen), 43)
        for step in range(10):
            times = torch.full((len(seen), 1), step / 10)
            decisions = decisions + self.field(torch.cat([seen, decisions, times], 1)) / 10
        return decisions


class Flow(BC):
    def __init__(self, data: Batch) -> None:
        seen, noise = data["observations"], torch.randn(len(data["actions"]), DECISION)
        self.field = Network(torch.cat([seen, noise, torch.rand(len(seen), 1)], 1), DECISION, 0.1)
        self.policy, self.networks, self.targets = Sampler(self.field), [self.field], []

    def loss(self, *batches: Batch) -> Tensor:
        (batch,) = batches
        actions = batch["actions"]
        noise, times = torch.randn_like(actions), torch.rand(len(actions), 1)
        between = (1 - times) * noise + times * actions
        velocity = self.field(torch.cat([batch["observations"], between, times], 1))
        return (velocity - (actions - noise)).square().mean()


class GCIVL(BC):
    sets = ("mixed", "reached")

    def __init__(self, data: Batch) -> None:
        super().__init__(data)
        self.value = Network(data["observations"], 1)
        self.slow = self.target(self.value)

    def loss(self, *batches: Batch) -> Tensor:
        batch, later = batches
        gain = self.ahead(batch) - self.value(batch["observations"])[:, 0]
        worth = self.ahead(later) - self.slow(later["observations"])[:, 0]
        return expectile(gain) + (weights(worth) * self.errors(later)).mean()

    def ahead(self, batch: Batch) -> Tensor:
        return batch["rewards"] + batch["discounts"] * self.slow(batch["next_observations"])[:, 0]


class TD3BC(BC):
    def __init__(self, data: Batch) -> None:
        super().__init__(data)
        self.critics = Network(torch.cat([data["observations"], data["actions"]], 1), 2)
        self.slow, self.slow_actor = self.target(self.critics), self.target(self.actor)

    def loss(self, *batches: Batch) -> Tensor:
        (batch,) = batches
        after, actions = batch["next_observations"], batch["actions"]
        with torch.no_grad():
            noise = (0.2 * torch.randn_like(actions)).clamp(-0.5, 0.5)
            following = (self.slow_actor(after) + noise).clamp(-1, 1)
            ahead = self.slow(torch.cat([after, following], 1)).amin(1)
        return self.temporal(batch, ahead) + self.greedy(self.slow, batch)

    def temporal(self, batch: Batch, ahead: Tensor) -> Tensor:
        """The critics' squared error, given the value of what follows (n,)."""
        found = self.critics(torch.cat([batch["observations"], batch["actions"]], 1))
        wanted = batch["rewards"] + batch["discounts"] * ahead
        return (found - wanted[:, None]).square().mean()


class IQL(TD3BC):
    def __init__(self, data: Batch) -> None:
        super().__init__(data)
        self.value = Network(data["observations"], 1)
        self.networks.append(self.value)

    def loss(self, *batches: Batch) -> Tensor:
        (batch,) = batches
        seen, after = batch["observations"], batch["next_observations"]
        gain = self.slow(torch.cat([seen, batch["actions"]], 1)).amin(1) - self.value(seen)[:, 0]
        error = self.temporal(batch, self.value(after)[:, 0].detach())
        return expectile(gain) + error + (weights(gain) * self.errors(batch)).mean()


class CRL(TD3BC):
    sets = ("reached", "random")

    def loss(self, *batches: Batch) -> Tensor:
        logits = [
            self.critics(torch.cat([one["observations"], one["actions"]], 1)) for one in batches
        ]
        right = [torch.ones_like(logits[0]), torch.zeros_like(logits[1])]
        told = binary_cross_entropy_with_logits(torch.cat(logits), torch.cat(right))
        return told + self.greedy(self.slow, batches[0])


LEARNERS = {one.__name__: one for one in (DiscreteBC, BC, GCBC, Flow, IQL, TD3BC, GCIVL, CRL)}


def expectile(gain: Tensor) -> Tensor:
    """The loss by which a value becomes an expectile of what it is compared with."""
    return (torch.where(gain > 0, EXPECTILE, 1 - EXPECTILE) * gain.square()).mean()


def weights(gain: Tensor) -> Tensor:
    return (WEIGHT * gain.detach()).exp().clamp(max=LARGEST)


def load(datasets: list[str], goals: GoalSampling | None) -> Batch:
    found = arrays(
        datasets,
        observation="marked",
        action="decision",
        frame="canonical",
        window=Window(discount=0.99, goals=goals),
    )
    data = {name: torch.from_numpy(column) for name, column in found.items()}
    data["rewards"] = data["rewards"].float() / (5 if goals is None else 1)
    data["discounts"] = data["discounts"].float()
    return data


def train(name: str, datasets: list[str], steps: int, seed: int, out: Path) -> None:
    """Train a learner; write its policy."""
    torch.manual_seed(seed)
    began, kind = time.process_time(), LEARNERS[name]
    data = [load(datasets, GOALS[one]) for one in kind.sets]
    learner = kind(data[0])
    trained = {id(one): one for network in learner.networks for one in network.parameters()}
    optimizer = torch.optim.AdamW(trained.values(), 1e-3, weight_decay=0.02)
    for _ in range(steps):
        rows = torch.randint(len(data[0]["beads"]), (256,))
        batches = [{key: column[rows] for key, column in one.items()} for one in data]
        optimizer.zero_grad()
        learner.loss(*batches).backward()
        optimizer.step()
        with torch.no_grad():
            for network, slow in learner.targets:
                for new, old in zip(network.parameters(), slow.parameters(), strict=True):
                    old.lerp_(new, POLYAK)
    torch.jit.script(learner.policy).save(str(out))
    opened = [columns_of(one) for one in datasets]
    card = {
        "learner": name,
        "data": {part.name: sha256(part.path) for one in opened for part in one.parts or [one]},
        "parameters": sum(one.numel() for one in learner.policy.parameters()),
        "updates": steps,
        "seed": seed,
        "action": "decision",
        "seconds": round(time.process_time() - began, 1),
        "command": shlex.join(["python", "examples/learners/offline_torch.py", *sys.argv[1:]]),
    }
    out.with_suffix(".py").write_text(MODULE.format(card=card))


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("learner", choices=LEARNERS)
    parser.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="TorchScript file")
    given = parser.parse_args()
    torch.set_num_threads(1)
    train(given.learner, given.datasets, given.steps, given.seed, given.out)


if __name__ == "__main__":
    main()
