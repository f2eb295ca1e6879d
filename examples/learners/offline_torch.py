"""Train offline learners in torch, all with one actor and one budget: they differ in their loss.

    python examples/learners/offline_torch.py IQL knotgym/tie-nx2/varied-bench-v0 --out iql.pt

Writes iql.pt, a state_dict, and iql.py, a policy: `knotgym evaluate --policy iql:act`, in the same
folder. With `--action macro` it learns of macro-actions, such as those of the tiers `wander`. While
it trains, it plays the task of the set, and iql.curve has a plot of its success.

    BC       clones what was done; the goal is the episode's own
    GCBC     the same for a state that the episode reached later, NextBC for the next code it showed
    Flow     GCBC by a velocity field from noise to actions (flow matching, arXiv 2210.02747)
    GCIVL    GCBC, weighted by a value of states and goals (OGBench, arXiv 2410.20092)
    IQL      the same, with critics (arXiv 2110.06169)
    TD3BC    GCBC beside the critics' value of what the actor does (arXiv 2106.06860)
    CRL      the same, with a classifier of goals reached as critic (arXiv 2206.07568)
"""

import copy
import inspect
import time
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

try:
    import torch
except ModuleNotFoundError as error:
    raise SystemExit("offline_torch.py needs torch: pip install '.[torch]'") from error
from cards import card_of
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits as logistic
from torch.nn.functional import one_hot

from knotgym.datasets import columns_of
from knotgym.learn import Trials
from knotgym.loaders import GoalSampling, Transitions, Window, arrays, as_policy

MODULE = """import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot
from knotgym.loaders import as_policy

FILES = [__file__[:-3] + ".pt"]
CARD = {card}  # what an entry claims of the training
torch.set_num_threads(1)


{classes}

network = {made}
network.load_state_dict(torch.load(FILES[0], weights_only=True))
network.eval()


@torch.inference_mode()
def predict(observations):
    return network.act(torch.from_numpy(observations)).numpy()


act = as_policy(predict, action="{action}", observation="{observation}")
"""
BATCH, RATE, DECAY, TRIALS = 128, 1e-3, 0.02, 64
DISCOUNT, EXPECTILE, POLYAK, GREED, WEIGHT, LARGEST = 0.98, 0.9, 0.01, 2.5, 1.0, 100.0
SETTINGS = ("observation", "action", "updates", "width", "seed")
Batch = dict[str, Tensor]


class Network(nn.Module):
    """Three layers over inputs that are standardized."""

    def __init__(self, inputs: int, outputs: int, width: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        layers = [
            nn.Sequential(nn.Linear(n, width), nn.LayerNorm(width), nn.ReLU(), nn.Dropout(dropout))
            for n in (inputs, width)
        ]
        self.body = nn.Sequential(*layers, nn.Linear(width, outputs))

    def like(self, rows: Tensor) -> None:
        """Standardize as rows (n, inputs) need it."""
        self.mean, self.std = rows.mean(0), rows.std(0).clamp(min=1e-3)

    def forward(self, inputs: Tensor) -> Tensor:
        return self.body((inputs - self.mean) / self.std)


class Actor(nn.Module):
    """A score of each bead, and the rest of an action given the bead."""

    REST, VECTOR = 0, 0  # outputs of the rest; numbers of an action as critics and fields see it

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.body, self.scores = Network(inputs, width, width, 0.1), nn.Linear(width, 100)
        self.which, self.rest = nn.Linear(100, width), nn.Linear(width, self.REST)
        apart = (torch.arange(100)[:, None] - torch.arange(100) + 50) % 100 - 50
        # a bead that is near is nearly as good
        self.near = nn.Buffer((-((apart / 3) ** 2)).softmax(1), persistent=False)

    def forward(self, seen: Tensor, beads: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the scores (n, 100), and the rest for beads (n,), or for their mean."""
        hidden = self.body(seen).relu()
        scores = self.scores(hidden)
        chosen = scores.softmax(1) if beads is None else one_hot(beads, 100).float()
        return scores, self.rest((hidden + self.which(chosen)).relu())

    def act(self, seen: Tensor) -> Tensor:
        beads = self(seen)[0].argmax(1)
        return self.acted(beads, self(seen, beads)[1], seen)

    def errors(self, batch: dict[str, Tensor]) -> Tensor:
        """How far the actor is from what was done: (n,)."""
        scores, rest = self(batch["observations"], batch["beads"])
        missed = -(self.near[batch["beads"]] * scores.log_softmax(1)).sum(1)
        return missed + self.off(rest, batch["actions"])


class Decisions(Actor):
    """Decisions: where the bead lies, and 40 numbers."""

    REST, VECTOR = 40, 43

    @staticmethod
    def vector(actions: Tensor) -> Tensor:
        return actions

    @staticmethod
    def chosen(vector: Tensor) -> Tensor:
        return vector.clamp(-1, 1)

    def off(self, rest: Tensor, actions: Tensor) -> Tensor:
        return 4 * (rest - actions[:, 3:]).square().mean(1)

    def soft(self, seen: Tensor) -> Tensor:
        """The mean action, (n, VECTOR), through which a gradient passes."""
        scores, rest = self(seen)
        places = (scores.softmax(1)[:, None] @ seen[:, :300].unflatten(1, (100, 3)))[:, 0]
        return torch.cat([places * 3, rest], 1).clamp(-1, 1)  # 1 is a third of a metre

    def acted(self, beads: Tensor, rest: Tensor, seen: Tensor) -> Tensor:
        places = seen[:, :300].unflatten(1, (100, 3))[torch.arange(len(seen)), beads]
        return torch.cat([places * 3, rest], 1).clamp(-1, 1)


class Macros(Actor):
    """Macro-actions: bead, target and side; as a vector, both beads as points of a circle."""

    REST, VECTOR = 200, 5

    @staticmethod
    def circle(beads: Tensor) -> Tensor:
        angles = beads * (2 * np.pi / 100)
        return torch.stack([angles.cos(), angles.sin()], -1)

    @classmethod
    def vector(cls, actions: Tensor) -> Tensor:
        ends = [cls.circle(actions[:, k]) for k in (0, 1)]
        return torch.cat([*ends, 2.0 * actions[:, 2:] - 1], 1)

    @staticmethod
    def chosen(vector: Tensor) -> Tensor:
        turns = torch.atan2(vector[:, [1, 3]], vector[:, [0, 2]]) * (100 / (2 * np.pi))
        return torch.cat([turns.round().long() % 100, (vector[:, 4:] > 0).long()], 1)

    def off(self, rest: Tensor, actions: Tensor) -> Tensor:
        found = rest.log_softmax(1).unflatten(1, (2, 100))
        own = found[torch.arange(len(rest)), actions[:, 2]]
        return -(self.near[actions[:, 1]] * own).sum(1)

    def soft(self, seen: Tensor) -> Tensor:
        """The mean action, (n, VECTOR), through which a gradient passes."""
        scores, rest = self(seen)
        ends, every = rest.softmax(1).unflatten(1, (2, 100)), self.circle(torch.arange(100))
        sides = ends.sum(2) @ torch.tensor([[-1.0], [1.0]])
        return torch.cat([scores.softmax(1) @ every, ends.sum(1) @ every, sides], 1)

    def acted(self, beads: Tensor, rest: Tensor, seen: Tensor) -> Tensor:
        best = rest.argmax(1)
        return torch.stack([beads, best % 100, best // 100], 1)


class Field(nn.Module):
    """Actions of a velocity field, begun in the middle of the noise."""

    def __init__(self, kind: type[Actor], inputs: int, width: int) -> None:
        super().__init__()
        self.kind, size = kind, kind.VECTOR
        self.body = Network(inputs + size + 1, size, width, 0.1)

    def act(self, seen: Tensor) -> Tensor:
        vector = torch.zeros(len(seen), self.kind.VECTOR)
        for step in range(10):
            times = torch.full((len(seen), 1), step / 10)
            vector = vector + self.body(torch.cat([seen, vector, times], 1)) / 10
        return self.kind.chosen(vector)


KINDS = {"decision": Decisions, "macro": Macros}


class BC:
    """A learner: its networks, and the loss of a batch of each of its `sets`."""

    sets: tuple[str, ...] = ("own",)

    def __init__(self, kind: type[Actor], width: int, seen: Tensor) -> None:
        self.policy: nn.Module
        self.actor = self.policy = kind(seen.shape[1], width)
        self.actor.body.like(seen)
        self.seen, self.width, self.vector = seen, width, kind.VECTOR
        self.networks: list[nn.Module] = [self.actor]
        self.targets: list[tuple[nn.Module, nn.Module]] = []

    def network(self, more: int, outputs: int) -> Network:
        """A network of observations and `more` inputs, which is trained."""
        made = Network(self.seen.shape[1] + more, outputs, self.width)
        made.like(torch.cat([self.seen, torch.randn(len(self.seen), more)], 1))
        self.networks.append(made)
        return made

    def target(self, network: nn.Module) -> nn.Module:
        """A copy that follows a network slowly, and passes no gradient to it."""
        self.targets.append((network, copy.deepcopy(network).requires_grad_(False)))
        return self.targets[-1][1]

    def loss(self, *batches: Batch) -> Tensor:
        return self.actor.errors(batches[0]).mean()


class GCBC(BC):
    sets = ("reached",)


class NextBC(BC):
    sets = ("next",)


class Flow(GCBC):
    def __init__(self, kind: type[Actor], width: int, seen: Tensor) -> None:
        super().__init__(kind, width, seen)
        self.policy = self.field = Field(kind, seen.shape[1], width)
        noise = torch.randn(len(seen), kind.VECTOR), torch.rand(len(seen), 1)
        self.field.body.like(torch.cat([seen, *noise], 1))
        self.networks = [self.field]

    def loss(self, *batches: Batch) -> Tensor:
        (batch,) = batches
        made = batch["vectors"]
        noise, times = torch.randn_like(made), torch.rand(len(made), 1)
        between = (1 - times) * noise + times * made
        velocity = self.field.body(torch.cat([batch["observations"], between, times], 1))
        return (velocity - (made - noise)).square().mean()


class GCIVL(BC):
    sets = ("mixed", "reached")

    def __init__(self, kind: type[Actor], width: int, seen: Tensor) -> None:
        super().__init__(kind, width, seen)
        self.value = self.network(0, 1)
        self.slow = self.target(self.value)

    def loss(self, *batches: Batch) -> Tensor:
        batch, later = batches
        gain = self.ahead(batch) - self.value(batch["observations"])[:, 0]
        worth = self.ahead(later) - self.slow(later["observations"])[:, 0]
        return expectile(gain) + weighted(worth, self.actor.errors(later))

    def ahead(self, batch: Batch) -> Tensor:
        return batch["rewards"] + batch["discounts"] * self.slow(batch["next_observations"])[:, 0]


class TD3BC(BC):
    sets = ("mixed", "reached")

    def __init__(self, kind: type[Actor], width: int, seen: Tensor) -> None:
        super().__init__(kind, width, seen)
        self.critics = self.network(self.vector, 2)
        self.slow, self.slow_actor = self.target(self.critics), self.target(self.actor)

    def loss(self, *batches: Batch) -> Tensor:
        batch, later = batches
        after = batch["next_observations"]
        with torch.no_grad():
            ahead = self.slow(torch.cat([after, self.slow_actor.soft(after)], 1)).amin(1)
        return self.temporal(batch, ahead) + self.greedy(later)

    def temporal(self, batch: Batch, ahead: Tensor) -> Tensor:
        """The critics' squared error, given the value of what follows (n,)."""
        found = self.critics(torch.cat([batch["observations"], batch["vectors"]], 1))
        wanted = batch["rewards"] + batch["discounts"] * ahead
        return (found - wanted[:, None]).square().mean()

    def greedy(self, batch: Batch) -> Tensor:
        """The actor's loss: the critics' least value, beside the error of a clone."""
        seen = batch["observations"]
        worth = self.slow(torch.cat([seen, self.actor.soft(seen)], 1)).amin(1)
        cloned = self.actor.errors(batch).mean()
        return cloned - GREED * (worth / worth.abs().mean().detach()).mean()


class IQL(TD3BC):
    def __init__(self, kind: type[Actor], width: int, seen: Tensor) -> None:
        super().__init__(kind, width, seen)
        self.value = self.network(0, 1)

    def loss(self, *batches: Batch) -> Tensor:
        found = [
            self.slow(torch.cat([one["observations"], one["vectors"]], 1)).amin(1)
            - self.value(one["observations"])[:, 0]
            for one in batches
        ]
        ahead = self.value(batches[0]["next_observations"])[:, 0].detach()
        error = self.temporal(batches[0], ahead)
        return expectile(found[0]) + error + weighted(found[1], self.actor.errors(batches[1]))


class CRL(TD3BC):
    sets = ("reached", "random")

    def loss(self, *batches: Batch) -> Tensor:
        logits = [
            self.critics(torch.cat([one["observations"], one["vectors"]], 1)) for one in batches
        ]
        right = [torch.ones_like(logits[0]), torch.zeros_like(logits[1])]
        return logistic(torch.cat(logits), torch.cat(right)) + self.greedy(batches[0])


LEARNERS: dict[str, type[BC]] = {
    one.__name__: one for one in (BC, GCBC, NextBC, Flow, GCIVL, IQL, TD3BC, CRL)
}


def expectile(gain: Tensor) -> Tensor:
    return (torch.where(gain > 0, EXPECTILE, 1 - EXPECTILE) * gain.square()).mean()


def weighted(gain: Tensor, errors: Tensor) -> Tensor:
    """The mean of errors, weighted by advantages."""
    weights = (WEIGHT * gain.detach()).exp().clamp(max=LARGEST)
    return (weights / weights.mean() * errors).mean()


def shown(datasets: Sequence[str], views: dict[str, Any]) -> Any:
    """Load the actions in which a code was first shown, with that code as the goal."""
    parts = []
    for one in datasets:
        moves = Transitions(one, relabel="all", **views)
        parts.append(moves.batch(np.flatnonzero(moves.terminals)))
    return {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}


def own(datasets: Sequence[str], views: dict[str, Any], goals: GoalSampling | None = None) -> Any:
    """Load all actions, with the episodes' own goals if no others are drawn."""
    return arrays(datasets, window=Window(discount=DISCOUNT, goals=goals), **views)


SETS: dict[str, Callable[[Sequence[str], dict[str, Any]], Any]] = {
    "own": own,
    "next": shown,
    "reached": partial(
        own, goals=GoalSampling(p_currgoal=0, p_trajgoal=1, p_randomgoal=0, geom_sample=False)
    ),
    "random": partial(own, goals=GoalSampling(p_currgoal=0, p_trajgoal=0, p_randomgoal=1)),
    "mixed": partial(own, goals=GoalSampling()),
}


def load(given: Namespace, name: str) -> Batch:
    """Load one of the SETS as tensors."""
    views = {"observation": given.observation, "action": given.action, "frame": "canonical"}
    found = {k: torch.from_numpy(v) for k, v in SETS[name](given.datasets, views).items()}
    own = {k: found[k] for k in ("observations", "next_observations", "actions")}
    own["beads"] = found.get("beads", found["actions"][:, 0]).long()
    own["vectors"] = KINDS[given.action].vector(found["actions"])
    more = {k: found[k].float() for k in ("rewards", "discounts") if k in found}
    return own | more


def train(learner: BC, data: Sequence[Batch], updates: int) -> Iterator[tuple[int, Tensor]]:
    """Train a learner on a set for each of its `sets`; yield the number and loss of each update."""
    trained = {id(one): one for network in learner.networks for one in network.parameters()}
    optimizer = torch.optim.AdamW(trained.values(), RATE, weight_decay=DECAY)
    for update in range(1, updates + 1):
        batches = []
        for each in data:
            rows = torch.randint(len(each["beads"]), (BATCH,))
            batches.append({key: column[rows] for key, column in each.items()})
        optimizer.zero_grad()
        loss = learner.loss(*batches)
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            for network, slow in learner.targets:
                for new, old in zip(network.parameters(), slow.parameters(), strict=True):
                    old.lerp_(new, POLYAK)
        yield update, loss.detach()


def make(given: Namespace, sets: dict[str, Batch]) -> None:
    """Train a learner by the command's options; write its weights, and the module that plays them.

    `sets` are those of the SETS that are loaded; others are added.
    """
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    began, kind, made = time.process_time(), KINDS[given.action], LEARNERS[given.learner]
    for one in made.sets:
        if one not in sets:
            sets[one] = load(given, one)
    data = [sets[one] for one in made.sets]
    learner = made(kind, given.width, data[0]["observations"])
    tasks = [columns_of(one).task for one in given.datasets]
    tasks = [replace(task, task=task.tasks[0], horizon=50) for task in tasks]
    trials, rows, played = Trials(tasks, TRIALS, given.seed), list[tuple[float, ...]](), 0.0
    views = {"action": given.action, "observation": given.observation}
    acting = torch.inference_mode()(lambda seen: learner.policy.act(torch.from_numpy(seen)).numpy())
    for update, loss in train(learner, data, given.updates):
        if given.every and update % given.every == 0:
            since = time.process_time()
            learner.policy.eval()  # draws no random number of torch's
            success = trials.success(as_policy(acting, **views))
            learner.policy.train()
            rows.append((update, loss.item(), success))
            trials.draw(given.out.with_suffix(".curve"), ("loss",), rows)
            print(f"update {update}: loss {loss:.3f}, success {100 * success:.0f} %", flush=True)
            played += time.process_time() - since
    torch.save(learner.policy.state_dict(), given.out)
    settings = {name: getattr(given, name) for name in SETTINGS}
    options = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    words = __file__, given.learner, *given.datasets, *options
    seconds = time.process_time() - began - played
    settings["parameters"] = sum(one.numel() for one in learner.policy.parameters())
    card = card_of(given.learner, given.datasets, seconds, words, **settings)
    policy = Field if isinstance(learner.policy, Field) else kind
    classes = "\n\n".join(map(inspect.getsource, dict.fromkeys((Network, Actor, kind, policy))))
    sizes = [str(data[0]["observations"].shape[1]), str(given.width)]
    made_of = [kind.__name__] * (policy is Field) + sizes
    call = f"{policy.__name__}({', '.join(made_of)})"
    module = MODULE.format(card=card, classes=classes, made=call, **views)
    given.out.with_suffix(".py").write_text(module)


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("learner", choices=LEARNERS)
    parser.add_argument("datasets", nargs="+", help="Minari ids or folders, of the train split")
    goal = "what is seen of the goal: its code, or vertices that show it"
    parser.add_argument("--observation", choices=("marked", "state"), default="marked", help=goal)
    parser.add_argument("--action", choices=KINDS, default="decision")
    for name, usual in (("updates", 600), ("width", 128), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=usual)
    parser.add_argument("--every", type=int, default=100, help="updates between trials; 0: none")
    parser.add_argument("--out", type=Path, required=True, help="file of weights")
    make(parser.parse_args(), {})


if __name__ == "__main__":
    main()
