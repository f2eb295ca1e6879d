"""Which policy acts, and its settings; nothing here computes, because the command line reads them.

Whether a policy of that name exists is found out when it is made, see `policies`.
"""

from contextlib import suppress
from math import inf
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar

from pydantic import NonNegativeInt, PositiveInt

from knotgym.common import InvalidPolicy, Mark, Share, configuration, require_regular

MIXED = ("random", "scripted", "noisy", "expert")  # what a mixed policy draws from


@configuration
class PassPlannerConfig:
    """Settings of the policy `expert`.

    Attributes:
        candidates: passes tried at a state, at most; four times as many where towing is limited.
        budget: pulls simulated for a search, at most.
        last_resort: pulls that the planner of pulls may simulate for an episode in which no pass
            was found.
    """

    candidates: PositiveInt = 12
    budget: PositiveInt = 2000
    last_resort: NonNegativeInt = 60000


@configuration
class PullPlannerConfig:
    """Settings of the policy `planner`.

    Attributes:
        budget: pulls simulated for an episode, at most.
        batch_size: copies of the rope simulated side by side.
    """

    budget: NonNegativeInt = 60000
    batch_size: PositiveInt = 8


@configuration
class PolicyConfig:
    """Which policy acts, and its settings; where one is wanted, a name stands for its defaults.

    Attributes:
        policy: policy: random, matching, expert, noisy, play or pretrained; a folder written by
            `knotgym train`; or module:name for your own code: a function of (observation) or
            (observation, info, generator), or an object with reset and act. More are in
            docs/learning.md.
        noise: probability that a pull of the noisy policy is random.
        shares: shares of random, scripted, noisy and expert episodes in mixed.
        expert: settings of the expert.
        planner: settings of the planner.
    """

    NAMED_BY: ClassVar = "policy"

    policy: Annotated[
        str, Mark("policy"), Mark("typed", lambda name: ":" in str(name))  # module:name is imported
    ] = "random"
    noise: Share = 0.1
    shares: tuple[float, ...] = (0.25, 0.25, 0.25, 0.25)
    expert: PassPlannerConfig = PassPlannerConfig()
    planner: PullPlannerConfig = PullPlannerConfig()

    def __post_init__(self) -> None:
        fit = len(self.shares) == len(MIXED) and all(0 <= share < inf for share in self.shares)
        if not fit or not 0 < sum(self.shares) < inf:
            raise InvalidPolicy(
                f"shares must be {len(MIXED)} finite numbers of at least 0, not all 0, for"
                f" {', '.join(MIXED)}; got {self.shares}"
            )

    @property
    def plans(self) -> bool:
        """Whether the policy searches, so that an episode takes far longer than its pulls."""
        with suppress(InvalidPolicy):  # a name that another machine knows, such as in an entry
            return bool(self._family().plans)
        return False

    @property
    def is_own(self) -> bool:
        """Whether it is one of the package's own names, so that the seed decides what it does."""
        with suppress(InvalidPolicy):
            family = self._family()
            return family.matches is None and family.make.__module__.startswith("knotgym.")
        return False

    @property
    def short(self) -> str:
        """A name for dataset ids: letters, digits and dashes."""
        kind, _, name = self.policy.partition(":")
        stem = f"{kind}-{Path(name).stem}" if name else Path(kind).stem
        return "".join(letter if letter.isalnum() else "-" for letter in stem)

    def files(self) -> dict[str, Path]:
        """Return each file that decides how the policy acts: weights, user code, transcripts, and
        the planner's table. The package's own code isn't among them; its version is recorded
        elsewhere.

        Raises:
            InvalidPolicy: a file can't be read.
        """
        with InvalidPolicy.instead(f"policy {self.policy}", OSError):
            files = self._family().files(self.policy)
            for path in files.values():
                require_regular(path, "file", InvalidPolicy)
            return {name: Path(files[name]) for name in sorted(files)}

    def card(self) -> dict[str, Any] | None:
        """Return facts about the training of the policy; None if its family records none."""
        return self._family().card(self.policy)

    def _family(self) -> Any:
        # the table makes policies, so it is imported when it is asked
        return resolve_name("knotgym.control.policies:family_of")(self.policy)
