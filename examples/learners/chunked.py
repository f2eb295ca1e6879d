"""Train a flow policy over chunks of pulls, or chunked Q-learning on top of it, in torch.

    knotgym suite --task tie --nx 2 --states readable --split train --policies expert,noisy \\
        --episodes expert=200,noisy=1200 --out sets
    python examples/learners/chunked.py flow sets/knotgym/*/{expert,noisy}-v0 \\
        --task tie --nx 2 --out flow
    python examples/learners/chunked.py qc sets/knotgym/*/{expert,noisy}-v0 \\
        --flow flow/flow.pt --task tie --nx 2 --out qc

`flow` learns a velocity field that carries noise to the demonstrator's decisions (flow matching,
arXiv 2210.02747). `qc` is Q-chunking (arXiv 2507.07969): a critic of whole chunks picks the best of
several that the flow proposes, and learns from what followed them. Writes the weights and
`evaluation.json`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from decisions import ChunkPolicy, Decisions, Eyes, Floats, decision_options, nearest, read
from protocol import Training, measure, parser
from torch import Tensor, nn

EULER = 10  # steps from noise to a decision
PROPOSALS = 8  # decisions that the critic chooses from
DISCOUNT = 0.95  # per decision
TARGET = 0.01  # share by which the target critic follows the critic at each step


class Network(nn.Module):
    """From observations and chunks to a velocity of the chunk, or a value."""

    def __init__(self, chunk: int, outputs: int, hidden: int = 256) -> None:
        super().__init__()
        self.eyes, self.chunk = Eyes(), chunk
        self._body = nn.Sequential(
            nn.Linear(self.eyes.size + chunk + 1, hidden),
            nn.GELU(),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Linear(hidden, outputs),
        )

    def forward(self, looked: Tensor, chunks: Tensor, times: Tensor) -> Tensor:
        """Take what `eyes` see (n, ...), chunks (n, chunk), and times (n, 1) of the flow."""
        out: Tensor = self._body(torch.cat([looked, chunks, times], dim=1))
        return out


def proposals(flow: Network, seen: Tensor, noise: Tensor) -> Tensor:
    """Carry noise (n, k, chunk) to k decisions for each of n observations."""
    count, many, size = noise.shape
    looked = flow.eyes.look(seen).repeat_interleave(many, 0)
    chunks = noise.reshape(count * many, size)
    for step in range(EULER):
        times = torch.full((len(chunks), 1), step / EULER)
        chunks = chunks + flow(looked, chunks, times) / EULER
    return chunks.reshape(count, many, size).clamp(-1, 1)


def fit(network: Network, given: Any, loss: Any, after: Any = None) -> None:
    """Minimize a loss, with a learning rate that falls to 0; call `after` each step."""
    optimizer = torch.optim.AdamW(network.parameters(), given.rate, weight_decay=0.02)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, given.steps)
    for _ in range(given.steps):
        optimizer.zero_grad()
        loss().backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        falling.step()
        if after is not None:
            after()


def trained_flow(rows: Decisions, given: Any) -> Network:
    """Fit the velocity field to the decisions that are worth imitating."""
    own = rows.rows(rows.chosen & rows.whole)
    seen, chunks = (torch.from_numpy(x).to(given.device) for x in (own.observations, own.chunks))
    flow = Network(chunks.shape[1], chunks.shape[1])

    def loss() -> Tensor:
        index = torch.randint(len(seen), (given.batch,))
        noise, times = torch.randn(given.batch, flow.chunk), torch.rand(given.batch, 1)
        between = (1 - times) * noise + times * chunks[index]
        velocity = flow(flow.eyes.look(seen[index]), between, times)
        return nn.functional.mse_loss(velocity, chunks[index] - noise)

    fit(flow, given, loss)
    return flow


def values(critic: Network, seen: Tensor, chunks: Tensor) -> Tensor:
    """Return the values (n, k) of k chunks for each of n observations."""
    count, many, size = chunks.shape
    looked = critic.eyes.look(seen).repeat_interleave(many, 0)
    flat = chunks.reshape(count * many, size)
    return critic(looked, flat, torch.zeros(len(flat), 1)).reshape(count, many)


def trained_critic(rows: Decisions, flow: Network, given: Any) -> Network:
    """Learn the values of chunks; the flow's proposals in each state are drawn once."""
    seen, chunks = (torch.from_numpy(x).to(given.device) for x in (rows.observations, rows.chunks))
    with torch.inference_mode():
        offered = torch.cat(
            [
                proposals(flow, part, torch.randn(len(part), PROPOSALS, flow.chunk))
                for part in seen.split(512)
            ]
        )
    rewards = torch.from_numpy(rows.rewards).to(given.device)
    going = torch.from_numpy(~rows.ends).float().to(given.device)
    critic, target = (Network(flow.chunk, 1) for _ in range(2))
    target.load_state_dict(critic.state_dict())

    def loss() -> Tensor:
        index = torch.randint(len(seen), (given.batch,))
        following = (index + 1).clamp(max=len(seen) - 1)  # unused where an episode ends
        with torch.no_grad():
            best = values(target, seen[following], offered[following]).amax(1)
        wanted = rewards[index] + DISCOUNT * going[index] * best
        return nn.functional.mse_loss(
            values(critic, seen[index], chunks[index][:, None])[:, 0], wanted
        )

    def after() -> None:
        with torch.no_grad():
            for own, other in zip(target.parameters(), critic.parameters(), strict=True):
                own.lerp_(other, TARGET)

    fit(critic, given, loss, after)
    return critic


class FlowPolicy(ChunkPolicy):
    """Acts as the flow decides, or as the critic chooses among its proposals."""

    def __init__(self, name: str, frame: str, flow: Network, critic: Network | None) -> None:
        super().__init__(name, frame)
        self._flow, self._critic = flow.eval(), critic

    def choose(self, indices: list[int], seen: Floats, points: Floats) -> tuple[Any, Floats]:
        many = 1 if self._critic is None else PROPOSALS
        shape = many, self._flow.chunk
        noise = np.stack([self.rngs[index].standard_normal(shape) for index in indices])
        observations = torch.from_numpy(seen)
        with torch.inference_mode():
            chunks = proposals(self._flow, observations, torch.from_numpy(noise).float())
            if self._critic is not None:
                best = values(self._critic, observations, chunks).argmax(1)
                chunks = chunks[torch.arange(len(best)), best, None]
        return nearest(chunks[:, 0].numpy(), points)


def main() -> None:
    options = decision_options(parser(__doc__ or "", ("flow", "qc")))
    options.add_argument("--device", default="cpu", help="where it is trained, such as cuda")
    options.add_argument("--flow", type=Path, help="weights of a flow, instead of training one")
    given = options.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(given.seed)
    torch.set_default_device(given.device)
    training = Training(f"torch {torch.__version__}", given, given.datasets)
    rows = read(given.datasets, given.frame)
    if given.flow is None:
        flow = trained_flow(rows, given)
    else:
        flow = Network(rows.chunks.shape[1], rows.chunks.shape[1])
        flow.load_state_dict(torch.load(given.flow, weights_only=True))
    critic = (
        trained_critic(rows.rows(~rows.hindsight), flow, given) if given.learner == "qc" else None
    )
    torch.set_default_device("cpu")  # where it acts
    torch.save(flow.cpu().state_dict(), given.out / "flow.pt")
    if critic is not None:
        torch.save(critic.cpu().state_dict(), given.out / "critic.pt")
    name = f"torch-{given.learner}"
    files = ["flow.pt"] if critic is None else ["flow.pt", "critic.pt"]
    measure(name, FlowPolicy(name, given.frame, flow, critic), given, training.ended(), *files)


if __name__ == "__main__":
    main()
