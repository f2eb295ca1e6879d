"""Train PPO with the settings of the paper, on pictures or on states; needs torch.

    python baselines/ppo.py --task unknot --nx 2 --observation pixels --out ppo-unknot-nx2
    KNOTGYM_PPO=ppo-unknot-nx2 PYTHONPATH=baselines knotgym evaluate --policy ppo:act \\
        --task unknot --nx 2 --set task.observation=pixels --out evaluation.json

Networks, their first weights and the updates are those of Stable-Baselines3's `CnnPolicy` and
`MlpPolicy`, with rollouts that stay on the GPU (rows that don't fill a batch are left out).
Trains on the train split and writes to --out:

    policy.pt    weights of the policy, without pickled objects
    ppo.json     settings, curve (training episodes of each rollout) and times

`act` is a policy for `knotgym evaluate`: the deterministic action of the folder in KNOTGYM_PPO.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Normal

import knotgym

WEIGHTS, SETTINGS = "policy.pt", "ppo.json"
VALUE, LARGEST_GRADIENT, EPSILON = 0.5, 0.5, 1e-5  # the library's defaults


def parser() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--task", default="unknot", choices=("unknot", "tie", "convert"))
    options.add_argument("--nx", type=int, default=2)
    options.add_argument("--states", help="readable (default), random-walk or a state file")
    options.add_argument("--observation", default="pixels", choices=("pixels", "state"))
    options.add_argument("--image-size", type=int, default=128)
    options.add_argument("--engine", default="mujoco", choices=("mujoco", "chain"))
    options.add_argument("--tow-limit", type=float)
    options.add_argument("--endless", action="store_true", help="don't end episodes at the goal")
    options.add_argument("--steps", type=int, default=1_000_000, help="whole rollouts are made")
    # the paper's settings; it gives no length of a rollout, 2,048 is the library's default
    options.add_argument("--envs", type=int, default=32)
    options.add_argument("--rollout", type=int, default=2048, help="steps of each environment")
    options.add_argument("--batch", type=int, default=64)
    options.add_argument("--epochs", type=int, default=10)
    options.add_argument("--learning-rate", type=float, default=1e-5)
    options.add_argument("--features", type=int, default=768, help="of the picture")
    options.add_argument("--gamma", type=float, default=0.99)
    options.add_argument("--lam", type=float, default=0.95)
    options.add_argument("--clip", type=float, default=0.2)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--threads", type=int, default=0, help="of the simulation; 0 for all")
    options.add_argument("--device", default="cpu", help="cpu or cuda")
    options.add_argument("--out", type=Path, required=True, help="folder to create")
    return options


class Agent(nn.Module):
    """Actor and critic: on pictures they share the features, on states they share nothing."""

    def __init__(self, shape: tuple[int, ...], features: int) -> None:
        super().__init__()
        if len(shape) == 3:
            height, width, channels = shape
            self.actor_body = nn.Sequential(
                *(nn.Conv2d(channels, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU()),
                *(nn.Conv2d(64, 64, 3), nn.ReLU(), nn.Flatten()),
            )
            flat = self.actor_body(torch.zeros(1, channels, height, width)).shape[1]
            self.actor_body.extend([nn.Linear(flat, features), nn.ReLU()])
            self.critic_body = self.actor_body
        else:
            features = 64
            self.actor_body, self.critic_body = (
                nn.Sequential(
                    *(nn.Flatten(), nn.Linear(int(np.prod(shape)), 64), nn.Tanh()),
                    *(nn.Linear(64, 64), nn.Tanh()),
                )
                for _ in range(2)
            )
        self.action, self.value = nn.Linear(features, 6), nn.Linear(features, 1)
        self.log_spread = nn.Parameter(torch.zeros(6))
        for layer in self.modules():
            if isinstance(layer, (nn.Linear, nn.Conv2d)):
                gain = {self.action: 0.01, self.value: 1.0}.get(layer, 2**0.5)
                nn.init.orthogonal_(layer.weight, gain)
                nn.init.zeros_(layer.bias)

    def forward(self, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (n, 6) and values (n,) of observations (n, ...)."""
        if seen.dtype == torch.uint8:
            seen = seen.permute(0, 3, 1, 2).float() / 255
        shown = self.actor_body(seen)
        valued = shown if self.critic_body is self.actor_body else self.critic_body(seen)
        return self.action(shown), self.value(valued)[:, 0]

    def likelihood(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Return the log-probabilities (n,) of actions that aren't clipped yet."""
        spread = self.log_spread.exp()
        return Normal(mean, spread, validate_args=False).log_prob(actions).sum(1)


def updater(
    agent: Agent, batch: Sequence[Tensor], given: argparse.Namespace
) -> Callable[[Tensor], None]:
    """Return what takes an optimizer step on rows of a rollout, recorded as a graph on a GPU."""
    cuda = given.device != "cpu"
    optimizer = torch.optim.Adam(
        agent.parameters(), given.learning_rate, eps=EPSILON, capturable=cuda
    )
    index = torch.arange(given.batch, device=given.device)

    def step() -> None:
        seen, actions, before, gains, returns = (part[index] for part in batch)
        mean, values = agent(seen)
        ratio = (agent.likelihood(mean, actions) - before).exp()
        gains = (gains - gains.mean()) / (gains.std() + 1e-8)
        gain = torch.min(ratio * gains, ratio.clamp(1 - given.clip, 1 + given.clip) * gains).mean()
        loss = VALUE * nn.functional.mse_loss(returns, values) - gain
        optimizer.zero_grad(set_to_none=False)
        loss.backward()
        nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
        optimizer.step()

    graph = torch.cuda.CUDAGraph() if cuda else None
    if graph is not None:
        before = [part.detach().clone() for part in agent.parameters()]
        beside = torch.cuda.Stream()
        with torch.cuda.stream(beside):
            for _ in range(3):
                step()
        torch.cuda.current_stream().wait_stream(beside)
        with torch.cuda.graph(graph):
            step()
        # what the rehearsals changed is undone
        with torch.no_grad():
            for part, own in zip(agent.parameters(), before, strict=True):
                part.copy_(own)
            for moments in optimizer.state.values():
                for own in moments.values():
                    own.zero_()

    def update(rows: Tensor) -> None:
        index.copy_(rows)
        graph.replay() if graph else step()

    return update


def train(given: argparse.Namespace) -> None:
    """Train, and write the weights and the report."""
    torch.manual_seed(given.seed)
    names = ("nx", "states", "engine", "endless", "tow_limit", "observation", "image_size")
    envs: Any = gym.make_vec(
        f"knotgym/{given.task.capitalize()}-v0",
        num_envs=given.envs,
        vectorization_mode="vector_entry_point",
        threads=given.threads,
        autoreset_mode="same_step",
        **{name: getattr(given, name) for name in names if getattr(given, name) is not None},
    )
    space, device = envs.single_observation_space, torch.device(given.device)
    agent = Agent(space.shape, given.features).to(device)
    shape, kind = (given.rollout, given.envs), torch.float32
    own = torch.uint8 if given.observation == "pixels" else kind
    seen = torch.empty(*shape, *space.shape, dtype=own, device=device)
    actions = torch.empty(*shape, 6, device=device)
    odds, values, rewards, over, gains, returns = torch.empty(6, *shape, device=device)
    parts = tuple(one.flatten(0, 1) for one in (seen, actions, odds, gains, returns))
    update, curve, began = updater(agent, parts, given), list[dict[str, Any]](), time.perf_counter()
    found = torch.from_numpy(envs.reset(seed=given.seed)[0])
    reached = np.zeros(given.envs, dtype=bool)
    for rollout in range(-(-given.steps // (given.envs * given.rollout))):
        counts = dict.fromkeys(("episodes", "successes", "at_the_end"), 0)
        with torch.no_grad():
            for k in range(given.rollout):
                seen[k] = found.to(device)
                mean, values[k] = agent(seen[k])
                actions[k] = mean + agent.log_spread.exp() * torch.randn_like(mean)
                odds[k] = agent.likelihood(mean, actions[k])
                pulls = actions[k].clamp(-1.0, 1.0).cpu().numpy()
                next_, reward, terminated, truncated, infos = envs.step(pulls)
                found, ended = torch.from_numpy(next_), terminated | truncated
                reached |= reward > 0
                counts["at_the_end"] += int((reward[ended] > 0).sum())
                # an episode that only ran out of time goes on being worth what the critic thinks
                late = np.flatnonzero(truncated & ~terminated)
                if len(late):
                    last = torch.from_numpy(np.stack(list(infos["final_obs"][late]))).to(device)
                    reward[late] += given.gamma * agent(last)[1].cpu().numpy()
                rewards[k] = torch.from_numpy(reward).to(device, kind)
                over[k] = torch.from_numpy(ended).to(device)
                counts["episodes"] += int(ended.sum())
                counts["successes"] += int(reached[ended].sum())
                reached[ended] = False
            after, ahead = agent(found.to(device))[1], torch.zeros(given.envs, device=device)
            for k in range(given.rollout - 1, -1, -1):
                goes_on = 1 - over[k]
                surprise = rewards[k] + given.gamma * after * goes_on - values[k]
                ahead = surprise + given.gamma * given.lam * goes_on * ahead
                gains[k], after = ahead, values[k]
            returns.copy_(gains + values)
        for _ in range(given.epochs):
            for rows in torch.randperm(len(parts[0]), device=device).split(given.batch):
                if len(rows) == given.batch:
                    update(rows)
        steps = (rollout + 1) * given.envs * given.rollout
        row = {"steps": steps, **counts, "seconds": time.perf_counter() - began}
        curve.append(row)
        print(", ".join(f"{name} {value:.0f}" for name, value in row.items()), flush=True)
        given.out.mkdir(parents=True, exist_ok=True)
        torch.save(agent.state_dict(), given.out / WEIGHTS)
        settings = {name: value for name, value in vars(given).items() if name != "out"}
        report = {"settings": settings, "shape": space.shape, "curve": curve}
        text = json.dumps({"knotgym": knotgym.__version__, **report}, indent=1)
        (given.out / SETTINGS).write_text(text, encoding="utf-8")


@cache
def _trained() -> Agent:
    folder = Path(os.environ["KNOTGYM_PPO"])
    report = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
    agent = Agent(tuple(report["shape"]), report["settings"]["features"])
    agent.load_state_dict(torch.load(folder / WEIGHTS, weights_only=True, map_location="cpu"))
    return agent.eval()


@torch.no_grad()
def act(observation: NDArray[Any]) -> NDArray[np.float32]:
    """Return the most likely action of the trained policy."""
    pull: NDArray[np.float32] = _trained()(torch.from_numpy(observation)[None])[0][0].numpy()
    return pull.clip(-1.0, 1.0)


if __name__ == "__main__":
    train(parser().parse_args())
