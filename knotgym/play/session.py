"""A player's episode: a rope that is pulled, undone, begun again, or handed to a policy.

Nothing here knows the page. An undone pull leaves no trace: the episode is reset to the same start
and the pulls before it are repeated, which gives the same bytes.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from knotgym.common import Array, Stream
from knotgym.control import Player, Policy, PolicyConfig, make_policy
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import WaypointFollower

_ROPE = np.zeros(1, dtype=np.int64)  # the only one of a batch


class HandPull(NamedTuple):
    """A pull that was made.

    Attributes:
        bead: that was pulled.
        force: float32 (3,), in units of the largest.
        helped: whether a policy chose it.
    """

    bead: int
    force: NDArray[np.float32]
    helped: bool = False


class Session:
    """One episode at a time, of the episodes that `knotgym evaluate` plays with the same seed.

    Attributes:
        task: the environment.
        seed: of the run.
        number: the episode's number in the run.
        batch: the episode, in a batch of one.
        pulls: since the reset.
        reward: sum of the rewards.
        ended: whether the episode is over.
    """

    def __init__(self, task: TaskConfig, seed: int = 0, number: int = 0) -> None:
        self.task, self.seed, self.batch = task, seed, EpisodeBatch(task)
        self._policies: dict[PolicyConfig, Policy] = {}
        # the policy that pulled last, if one did
        self._acting: tuple[PolicyConfig, Player] | None = None
        self.begin(number)

    @property
    def points(self) -> Array:
        """Vertices of the rope, float64 (beads, 3), metres; valid until the next pull."""
        return np.asarray(self.batch.simulation.points[0])

    @property
    def success(self) -> bool:
        """Whether the goal has been reached."""
        return bool(self.batch.successes(_ROPE)[0])

    def begin(self, number: int) -> None:
        """Reset to the start of an episode."""
        self.number = number
        seed = Stream.EVALUATION_EPISODE.derived_seed(self.seed, number)
        self.batch.begin(_ROPE, [seed])
        self.pulls, self.reward, self.ended = list[HandPull](), 0.0, False
        self._acting = None

    def pull(self, bead: int, force: ArrayLike) -> None:
        """Pull a bead for one action; ignored once the episode is over.

        Args:
            bead: index, taken modulo the number of beads.
            force: (3,), in units of the largest force; its components are clipped to [-1, 1], and a
                force that isn't finite is ignored.
        """
        wanted = np.asarray(force, dtype=np.float32)
        if wanted.shape == (3,) and np.isfinite(wanted).all():
            self._acting = None
            self._take(HandPull(int(bead) % len(self.points), np.clip(wanted, -1, 1)))

    def pull_towards(self, bead: int, target: ArrayLike) -> bool:
        """Pull a bead towards a point, as the waypoint controller does; False if it is there.

        Args:
            bead: index.
            target: (3,), metres.
        """
        offset = np.asarray(target, dtype=np.float64) - self.points[bead]
        far = float(np.linalg.norm(offset))
        if not WaypointFollower.ARRIVED < far < np.inf:
            return False
        self.pull(bead, offset / far * min(1.0, far / WaypointFollower.STRIDE))
        return True

    def undo(self) -> None:
        """Take back the last pull."""
        earlier = self.pulls[:-1]
        self.begin(self.number)
        for pull in earlier:
            self._take(pull)

    def let_act(self, policy: PolicyConfig) -> None:
        """Let a policy pull once.

        Raises:
            InvalidPolicy: there is no such policy, or it can't act in this task.
        """
        if self.ended:
            return
        if self._acting is None or self._acting[0] != policy:
            self._acting = policy, self._player(policy)
        while not len((pulls := self._acting[1].act(_ROPE)).ids):
            pass  # it hasn't planned its pull yet
        self._take(HandPull(int(pulls.beads[0]), pulls.forces[0].copy(), helped=True))

    def _player(self, config: PolicyConfig) -> Player:
        if config not in self._policies:
            made = make_policy(config)
            made.compatible_task(self.task)
            self._policies[config] = made
        player = self._policies[config].player(self.batch)
        player.begin(_ROPE, [Stream.POLICY.generator(int(self.batch.seed[0]), len(self.pulls))])
        return player

    def _take(self, pull: HandPull) -> None:
        if self.ended:
            return
        outcome = self.batch.pull(_ROPE, np.array([pull.bead]), pull.force[None])
        self.pulls.append(pull)
        self.reward += float(outcome.rewards[0])
        self.ended = bool(outcome.terminated[0] or outcome.truncated[0])
