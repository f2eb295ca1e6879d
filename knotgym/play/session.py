"""A player's episode: a rope that is pulled, undone, begun again, or handed to a policy.

Nothing here knows the page. An undone pull leaves no trace: the episode is reset to the same start
and the pulls before it are repeated, which gives the same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common.streams import Stream, generator
from knotgym.control.old_policies import make_policy
from knotgym.control.policy import Policy
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.rollouts import EVALUATION, episode_seed
from knotgym.envs.episode_batch import EpisodeBatch
from knotgym.envs.tasks import TaskConfig
from knotgym.rope.macro_action_config import MacroActionConfig
from knotgym.rope.model import Array

MACRO_PULLS = 10  # most pulls of one foreseen macro-action
_CONTROL = MacroActionConfig()


@dataclass(frozen=True)
class Foreseen:
    """What a policy would do next.

    Attributes:
        bead: the bead that it would pull.
        path: float64 (pulls + 1, 3), metres: where that bead would go.
        code: the Gauss code afterwards.
        success: whether the goal would be reached.
    """

    bead: int
    path: Array
    code: str
    success: bool


class Session:
    """One episode at a time, of the episodes that `knotgym evaluate` plays with the same seed.

    Attributes:
        task: the environment.
        seed: of the run.
        number: the episode's number in the run.
        episodes: the episode, in a batch of one.
        actions: float32 (6,) each, the pulls since the reset.
        reward: sum of the rewards.
        ended: whether the episode is over.
        helped: whether a policy has pulled in this episode.
    """

    def __init__(self, task: TaskConfig, seed: int = 0, number: int = 0) -> None:
        self.task, self.seed = task, seed
        self.episodes = EpisodeBatch(task)
        self._policies: dict[str, Policy] = {}
        self._acting = ""
        self.begin(number)

    @property
    def points(self) -> Array:
        """Vertices of the rope, float64 (beads, 3), metres; valid until the next pull."""
        return self.episodes.simulation.points[0]

    @property
    def success(self) -> bool:
        """Whether the goal has been reached."""
        return bool(self.episodes.info(0)["is_success"])

    @property
    def left(self) -> int:
        """Pulls that are left."""
        return int(self.task.horizon - self.episodes.steps[0])

    def begin(self, number: int) -> None:
        """Reset to the start of an episode."""
        self.number = number
        seed = episode_seed(self.seed, number, EVALUATION)
        self.episodes.begin(0, np.random.default_rng(seed))
        self.actions: list[NDArray[np.float32]] = []
        self.reward, self.ended, self.helped, self._acting = 0.0, False, False, ""

    def pull(self, bead: int, force: ArrayLike) -> None:
        """Pull a bead for one action; ignored once the episode is over.

        Args:
            bead: index, taken modulo the number of beads.
            force: (3,), in units of the largest force; its components are clipped to [-1, 1], and a
                force that isn't finite is ignored.
        """
        wanted = np.asarray(force, dtype=np.float64)
        if wanted.shape != (3,) or not np.isfinite(wanted).all():
            return
        simulation = self.episodes.simulation
        newtons = np.clip(wanted, -1, 1)[None] * simulation.max_force
        self._acting = ""
        self._take(simulation.actions([int(bead) % len(self.points)], newtons, [0])[0])

    def pull_towards(self, bead: int, target: ArrayLike) -> bool:
        """Pull a bead towards a point, as the waypoint controller does; False if it is there.

        Args:
            bead: index.
            target: (3,), metres.
        """
        offset = np.asarray(target, dtype=np.float64) - self.points[bead]
        far = float(np.linalg.norm(offset))
        if not _CONTROL.arrived < far < np.inf:
            return False
        self.pull(bead, offset / far * min(1.0, far / _CONTROL.stride))
        return True

    def undo(self, pulls: int = 1) -> None:
        """Take back the last pulls."""
        self._repeat(self.actions[: max(0, len(self.actions) - pulls)])

    def reset(self) -> None:
        """Take back all pulls."""
        self._repeat([])

    def let_act(self, policy: str) -> None:
        """Let a policy pull once.

        Raises:
            InvalidPolicy: there is no such policy, or it can't act in this task.
        """
        if self.ended:
            return
        acting = self._policy(policy)
        if self._acting != policy:
            rng = generator(Stream.EVALUATION_POLICY, self.seed, self.number, len(self.actions))
            acting.begin(self.episodes, 0, rng)
            self._acting = policy
        self.helped = True
        self._take(acting.act(self.episodes, np.array([0])).actions[0])

    def foresee(self, policy: str) -> Foreseen:
        """Return what a policy would do from here, until it pulls another bead.

        The episode isn't touched: the policy acts in a copy.

        Raises:
            InvalidPolicy: as for `let_act`.
        """
        copy = Session(self.task, self.seed, self.number)
        copy._policies = self._policies
        copy._repeat(self.actions)
        path, bead = [copy.points.copy()], -1
        while not copy.ended and len(path) <= MACRO_PULLS:
            copy.let_act(policy)
            pulled = int(copy.episodes.beads[0])
            if bead not in (-1, pulled):
                break
            bead = pulled
            path.append(copy.points.copy())
        code = str(copy.episodes.codes[0])
        return Foreseen(bead, np.array([points[bead] for points in path]), code, copy.success)

    def _policy(self, name: str) -> Policy:
        if name not in self._policies:
            made = make_policy(PolicyConfig(policy=name))
            made.suited(self.task)
            self._policies[name] = made
        return self._policies[name]

    def _repeat(self, actions: Sequence[NDArray[np.float32]]) -> None:
        helped = self.helped and len(actions) > 0
        self.begin(self.number)
        for action in actions:
            self._take(action)
        self.helped = helped

    def _take(self, action: NDArray[np.float32]) -> None:
        if self.ended:
            return
        rewards, terminated, truncated = self.episodes.step(action[None], np.array([0]))
        self.actions.append(np.clip(action, -1, 1))
        self.reward += float(rewards[0])
        self.ended = bool(terminated[0] or truncated[0])
