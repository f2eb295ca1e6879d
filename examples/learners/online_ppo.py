"""PPO in one file, on vertices: many ropes of the chain engine in arrays, no other library.

    python examples/learners/online_ppo.py --task unknot --nx 2 --tow-limit 0.04 --out ppo.pt
    knotgym evaluate --policy ppo:act --task unknot --nx 2 --tow-limit 0.04 --engine chain

The policy draws the bead from a softmax and the force from a Gaussian; the network that it writes,
with a module that makes it a policy, takes the most likely ones. A million steps take some minutes
on one core. Prints the success rate of the episodes that ended since the last line, as they are
played in training.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from torch import nn
from torch.distributions import Categorical, Normal

import knotgym

# the policy of the file that is written, as module:name
MODULE = '''"""The policy of {model}: knotgym evaluate --policy {name}:act, in this folder."""

import torch

FILES = [__file__[:-3] + ".pt"]
torch.set_num_threads(1)
network = torch.jit.load(FILES[0]).eval()


@torch.no_grad()
def act(observation):
    return network(torch.from_numpy(observation)[None])[0].numpy()
'''

GAMMA, LAMBDA, CLIP = 0.99, 0.95, 0.2
ENTROPY, VALUE, LARGEST_GRADIENT = 0.003, 0.5, 0.5  # weights of the losses; clipping


class Actor(nn.Module):
    """The most likely action, from the vertices of rope and goal (n, 600)."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(600, 256), nn.Tanh(), nn.Linear(256, 256), nn.Tanh())
        self.bead, self.force = nn.Linear(256, 100), nn.Linear(256, 3)
        for layer in (self.bead, self.force):
            nn.init.orthogonal_(layer.weight, 0.01)

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        hidden = self.body(5 * state)  # vertices lie within 0.2 m of the middle
        return pull(state, self.bead(hidden).argmax(1), self.force(hidden))


def pull(state: torch.Tensor, bead: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Actions (n, 6); their position is in units of 2 m."""
    position = state.reshape(-1, 200, 3)[torch.arange(len(state)), bead] / 2
    return torch.cat([position, force], 1).clamp(-1.0, 1.0)


class Agent(nn.Module):
    """Actor and critic."""

    def __init__(self) -> None:
        super().__init__()
        self.actor, self.spread = Actor(), nn.Parameter(torch.full((3,), -0.5))
        self.critic = nn.Sequential(
            *(nn.Linear(600, 256), nn.Tanh(), nn.Linear(256, 256), nn.Tanh(), nn.Linear(256, 1))
        )

    def value(self, state: torch.Tensor) -> torch.Tensor:
        return self.critic(5 * state)[:, 0]

    def choices(self, state: torch.Tensor) -> tuple[Categorical, Normal]:
        hidden = self.actor.body(5 * state)
        force = Normal(self.actor.force(hidden), self.spread.exp())
        return Categorical(logits=self.actor.bead(hidden)), force


def likelihood(
    choices: tuple[Categorical, Normal], beads: torch.Tensor, forces: torch.Tensor
) -> torch.Tensor:
    return choices[0].log_prob(beads) + choices[1].log_prob(forces).sum(1)


def advantages(
    rewards: torch.Tensor, values: torch.Tensor, ended: torch.Tensor, last: torch.Tensor
) -> torch.Tensor:
    """Generalized advantage estimates (steps, ropes); an episode that ended has no future."""
    found, after, ahead = torch.zeros_like(rewards), last, torch.zeros_like(last)
    for step in range(len(rewards) - 1, -1, -1):
        goes_on = 1 - ended[step]
        surprise = rewards[step] + GAMMA * after * goes_on - values[step]
        ahead = surprise + GAMMA * LAMBDA * goes_on * ahead
        found[step], after = ahead, values[step]
    return found


def update(
    agent: Agent, optimizer: torch.optim.Optimizer, batch: Any, epochs: int, size: int
) -> None:
    """Improve on one rollout: states, beads, forces, log likelihoods, advantages, returns."""
    for _ in range(epochs):
        for rows in torch.randperm(len(batch[0])).split(size):
            states, beads, forces, before, gains, returns = (part[rows] for part in batch)
            choices = agent.choices(states)
            ratio = (likelihood(choices, beads, forces) - before).exp()
            gains = (gains - gains.mean()) / (gains.std() + 1e-8)
            gain = torch.min(ratio * gains, ratio.clamp(1 - CLIP, 1 + CLIP) * gains).mean()
            entropy = choices[0].entropy().mean() + choices[1].entropy().sum(1).mean()
            error = (agent.value(states) - returns).square().mean()
            optimizer.zero_grad()
            (VALUE * error - gain - ENTROPY * entropy).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimizer.step()


def train(options: argparse.Namespace) -> Agent:
    torch.manual_seed(options.seed)
    ropes, length = options.envs, options.rollout
    envs: Any = gym.make_vec(
        f"knotgym/{options.task.capitalize()}-v0",
        num_envs=ropes,
        vectorization_mode="vector_entry_point",
        nx=options.nx,
        states=options.states,
        engine=options.engine,
        tow_limit=options.tow_limit,
        observation="state",
        threads=options.threads,
        autoreset_mode="same_step",
    )
    agent = Agent()
    optimizer = torch.optim.Adam(agent.parameters(), options.learning_rate, eps=1e-5)
    state = torch.as_tensor(envs.reset(seed=options.seed)[0])
    rollouts, began = -(-options.steps // (ropes * length)), time.perf_counter()
    goals = ends = 0
    for rollout in range(rollouts):
        for group in optimizer.param_groups:
            group["lr"] = options.learning_rate * (1 - rollout / rollouts)
        steps = []
        with torch.no_grad():
            for _ in range(length):
                choices = agent.choices(state)
                bead, force = (choice.sample() for choice in choices)
                seen, value = state, agent.value(state)
                found, reward, reached, late, _ = envs.step(pull(seen, bead, force).numpy())
                state, ended = torch.as_tensor(found), torch.as_tensor(reached | late)
                scored = torch.as_tensor(reward, dtype=torch.float32)
                odds = likelihood(choices, bead, force)
                steps.append((seen, bead, force, odds, value, scored, ended.float()))
                goals, ends = goals + int((reached & (reward > 0)).sum()), ends + int(ended.sum())
            *acted, values, rewards, over = (torch.stack(part) for part in zip(*steps, strict=True))
            gains = advantages(rewards, values, over, agent.value(state))
        batch = [part.flatten(0, 1) for part in (*acted, gains, gains + values)]
        update(agent, optimizer, batch, options.epochs, options.batch)
        if (rollout + 1) % options.every == 0 or rollout + 1 == rollouts:
            taken = (rollout + 1) * ropes * length
            rate, spent = 100 * goals / max(1, ends), time.perf_counter() - began
            print(f"{taken} steps, {spent:.0f} s: {rate:.1f} % of {ends} episodes", flush=True)
            goals = ends = 0
    return agent


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="unknot", choices=("unknot", "tie", "convert"))
    parser.add_argument("--nx", type=int, default=2)
    parser.add_argument("--states", help="readable (default), random-walk or a state file")
    parser.add_argument("--engine", default="chain", help="chain, or mujoco, which is far slower")
    parser.add_argument("--tow-limit", type=float, help="metres that the rope may be towed")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--envs", type=int, default=256, help="ropes side by side")
    parser.add_argument("--rollout", type=int, default=32, help="steps between two updates")
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--learning-rate", type=float, default=3e-4)
    parser.add_argument("--every", type=int, default=8, help="rollouts between two lines")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("ppo.pt"), help="TorchScript file")
    options = parser.parse_args()
    print(f"knotgym {knotgym.__version__}, {options.task} nx {options.nx}, {options.engine}")
    torch.jit.script(train(options).actor).save(str(options.out))
    names = {"model": options.out.name, "name": options.out.stem}
    options.out.with_suffix(".py").write_text(MODULE.format(**names))


if __name__ == "__main__":
    main()
