"""What states are wanted: the configuration of `knotgym generate`."""

from __future__ import annotations

from dataclasses import dataclass

from knotgym.common.configuration import as_json, differences
from knotgym.common.errors import KnotgymError
from knotgym.control.planner_config import PlannerConfig
from knotgym.generate.states.candidates import CandidateConfig
from knotgym.generate.states.code_frequencies import FrequencyConfig
from knotgym.generate.states.search import SearchSettings
from knotgym.rope.model import RopeConfig
from knotgym.topology.knots import LISTED_NX


class InvalidGenerateConfig(KnotgymError, ValueError):
    """States that cannot be made as asked."""


@dataclass(frozen=True, kw_only=True)
class GenerateConfig:
    """What states are wanted.

    Attributes:
        nx: crossing numbers, each curated on its own.
        count: states for each of them, as many distinct codes among them as there are.
        every_code: instead of count, so many states of every code; 0 for count.
        balance: "even" over codes and chirality, or "empirical": codes as often as a random policy
            meets them.
        split_by: "state", or "code" for splits that share no code.
        train_share: of the states (or codes) that are for training.
        knot: type of the rope's knot; "0_1" starts from the plain loop, any other name or file as
            `curves.knot_curve`.
        seed: of everything.
        choice: accepted states, for each state wanted, that a code has to choose the most unlike
            from (`curation.most_unlike`). A code wanted once gets no candidates for that.
        most_spare: of them, beyond those wanted, in each crossing number.
        attempts: candidates tried, for each state wanted, before giving up.
        cycles: of search and a wave of candidates, after which what there is is enough; 0 to go on
            until all wanted is there.
        wave: candidates made in a cycle.
        candidate: how they are made and judged.
        planner: what is spent on a targeted search.
        search: how codes are searched for.
        frequencies: how codes are counted for the empirical balance.
        more_rounds: of search in a cycle, at most, while none of what lacks is known.
        targets: codes that a cycle searches for with the planner, where its search found fewer new
            classes than that.
        stuck: candidates of a code, none of them accepted, after which it is a target again.
    """

    nx: tuple[int, ...] = (3,)
    count: int = 40
    every_code: int = 0
    balance: str = "even"
    split_by: str = "state"
    train_share: float = 0.5
    knot: str = "0_1"
    seed: int = 0
    choice: int = 6
    most_spare: int = 80
    attempts: int = 100
    cycles: int = 0
    wave: int = 48
    candidate: CandidateConfig = CandidateConfig()
    planner: PlannerConfig = PlannerConfig(budget=3000)
    search: SearchSettings = SearchSettings()
    frequencies: FrequencyConfig = FrequencyConfig()
    more_rounds: int = 4
    targets: int = 8
    stuck: int = 48

    def __post_init__(self) -> None:
        if (
            not self.nx
            or any(not 0 <= nx <= LISTED_NX for nx in self.nx)
            or len(set(self.nx)) != len(self.nx)
        ):
            raise InvalidGenerateConfig(
                f"nx takes different numbers of crossings from 0 to {LISTED_NX}, got"
                f" {', '.join(map(str, self.nx)) or 'none'}"
            )
        for name in ("count", "choice", "attempts", "wave", "stuck"):
            if getattr(self, name) < 1:
                raise InvalidGenerateConfig(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("every_code", "most_spare", "cycles", "more_rounds", "targets"):
            if getattr(self, name) < 0:
                raise InvalidGenerateConfig(f"{name} must be at least 0, got {getattr(self, name)}")
        if self.balance not in ("even", "empirical"):
            raise InvalidGenerateConfig(
                f'balance must be "even" or "empirical", got {self.balance!r}'
            )
        if self.split_by not in ("state", "code"):
            raise InvalidGenerateConfig(
                f'split_by must be "state" or "code", got {self.split_by!r}'
            )
        if not 0 <= self.train_share <= 1:
            raise InvalidGenerateConfig(f"train_share must be in [0, 1], got {self.train_share}")
        if self.seed < 0:
            raise InvalidGenerateConfig(f"seed must be at least 0, got {self.seed}")
        if self.candidate.rope != RopeConfig():
            changed = ", ".join(differences(as_json(RopeConfig()), as_json(self.candidate.rope)))
            raise InvalidGenerateConfig(
                "states are made of the rope that environments reset and verify replays, so"
                f" candidate.rope must be RopeConfig(); got one whose {changed}"
            )
