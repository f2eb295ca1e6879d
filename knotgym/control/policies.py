"""Policies by name: which there are, and how one is made.

random          uniform in [-1, 1]^6
constant        (1, 1, 1, 1, 1, 1) at every step, which tows the rope
scripted        one macro-action after the other, without a goal
expert          plans in the simulator from the state the rope is in, see `expert`
noisy-expert    an expert; each step is a random one instead with probability `noise`, and the
                expert plans anew
mixed           each episode is one of the four
module:name     of the user's own: a function of (observation) or (observation, info, generator),
                or an object with `reset` and `act`, see `own_policies`; its module may lie in the
                current folder
FOLDER          a learner that `knotgym train` wrote; `pretrained` for the one that ships
FILE            a model that takes observations: .zip (Stable-Baselines3; FILE.zip:SAC for another
                algorithm than PPO), .onnx, or .pt (TorchScript)
prompt:FILE     what a model did in the episodes of transcripts (`knotgym prompt`), once more

`register_policy` adds a name. Workers make their policies themselves: a name that is registered
outside the package must be so in every process that uses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path

from knotgym.atomic_files import sha256
from knotgym.control.basic_policies import (
    ConstantPolicy,
    MixedPolicy,
    NoisyPolicy,
    RandomPolicy,
    ScriptedPolicy,
)
from knotgym.control.expert import Expert
from knotgym.control.learned_policies import (
    MODEL_FILES,
    ModelPolicy,
    is_learner,
    learner_files,
    load_learner,
    load_model,
)
from knotgym.control.own_policies import OwnPolicy, load_own, module_files
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import Choice, Effort, InvalidPolicy, Policy
from knotgym.control.transcript_policy import TranscriptPolicy, load_transcripts
from knotgym.control.transition_graph import TRANSITIONS
from knotgym.errors import one_line
from knotgym.prompting.transcripts import transcripts_at

__all__ = [
    "MIXED",
    "Choice",
    "Effort",
    "InvalidPolicy",
    "Policy",
    "PolicyConfig",
    "make_policy",
    "policy_digests",
    "policy_names",
    "register_policy",
]

TRANSCRIPTS = "prompt"  # before the colon: what comes after it is a file, not a name
MIXED = ("random", "scripted", "noisy-expert", "expert")  # what a mixed policy draws from


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Which policy.

    Attributes:
        policy: a name or a place, as in the module's first lines.
        noise: chance that a noisy expert's step is a random one.
        shares: of random, scripted, noisy-expert and expert in a mixed policy.
        planner: of the experts; its macro-actions are the scripted policy's too.
    """

    policy: str = "random"
    noise: float = 0.1
    shares: tuple[float, ...] = (0.25, 0.25, 0.25, 0.25)
    planner: PlannerConfig = PlannerConfig()

    def __post_init__(self) -> None:
        if not 0 <= self.noise <= 1:
            raise InvalidPolicy(f"noise must be in [0, 1], got {self.noise}")
        fit = len(self.shares) == len(MIXED) and all(0 <= one < inf for one in self.shares)
        if not fit or not 0 < sum(self.shares) < inf:
            raise InvalidPolicy(
                f"shares must be {len(MIXED)} finite numbers of at least 0, not all 0, for"
                f" {', '.join(MIXED)}; got {self.shares}"
            )
        place = ":" in self.policy or Path(self.policy).suffix in MODEL_FILES
        place = place or is_learner(self.policy)
        if self.policy not in _constructors and not place:
            raise InvalidPolicy(
                f"no policy {self.policy!r}; there is {', '.join(_constructors)}, module:name,"
                " prompt:FILE, pretrained, a learner's folder, or a .zip, .onnx or .pt file"
            )

    @property
    def core_seconds(self) -> float:
        """Estimate of what an episode of 50 steps costs on one core of the machine of
        docs/validation.md; policies that plan take longer.
        """
        return 3.0 if "expert" in self.policy or self.policy == "mixed" else 0.5

    @property
    def short(self) -> str:
        """A name for datasets, letters, digits and dashes."""
        stem = self.policy
        if stem not in _constructors:
            stem = Path(stem.partition(":")[0]).stem.split(".")[-1]
        return "".join(letter if letter.isalnum() else "-" for letter in stem)


Constructor = Callable[[PolicyConfig], Policy]
_constructors: dict[str, Constructor] = {}
_files: dict[str, tuple[Path, ...]] = {}  # that a registered policy is made from


def register_policy(name: str, constructor: Constructor, files: Sequence[Path] = ()) -> None:
    """Let `name` stand for the policy that `constructor` makes of a configuration.

    Args:
        name: neither module:name nor that of a model file.
        constructor: makes the policy.
        files: what decides how it acts, such as its weights; results hold their digests.

    Raises:
        InvalidPolicy: the name is taken, or would be read as a module or file.
    """
    if name in _constructors:
        raise InvalidPolicy(f"there is a policy {name!r} already")
    if not name or ":" in name or Path(name).suffix in MODEL_FILES:
        raise InvalidPolicy(f"a policy's name is neither module:name nor a file, got {name!r}")
    _constructors[name], _files[name] = constructor, tuple(files)


def policy_names() -> tuple[str, ...]:
    """The names registered, in order."""
    return tuple(_constructors)


def make_policy(config: PolicyConfig) -> Policy:
    """The policy of a configuration.

    Raises:
        InvalidPolicy: the function or file isn't there, or its library isn't installed.
    """
    if config.policy in _constructors:
        return _constructors[config.policy](config)
    if is_learner(config.policy):
        return load_learner(config.policy)
    place, _, word = config.policy.partition(":")
    if place == TRANSCRIPTS:
        return TranscriptPolicy(load_transcripts(Path(word)), word)
    if Path(place).suffix in MODEL_FILES:
        return ModelPolicy(load_model(Path(place), word), config.short)
    return OwnPolicy(load_own(place, word), config.policy)


def policy_digests(config: PolicyConfig) -> dict[str, str]:
    """SHA-256 of the files that decide how a policy acts, by their names: weights, code of the
    user's own, transcripts, and tables of the planner. The package's code is `versions`'s.

    Raises:
        InvalidPolicy: a file can't be read.
    """
    name, (place, _, word) = config.policy, config.policy.partition(":")
    table = {TRANSITIONS.name: TRANSITIONS} if TRANSITIONS.is_file() else {}
    if name in _constructors:
        files = {path.name: path for path in _files[name]}
        files |= table if "expert" in name or name == "mixed" else {}
    elif is_learner(name):
        files = table | learner_files(name)
    elif place == TRANSCRIPTS:
        files = {"transcripts": transcripts_at(Path(word)) or Path(word)}
    elif Path(place).suffix in MODEL_FILES:
        files = {Path(place).name: Path(place)}
    else:
        files = module_files(place)
    try:
        return {called: sha256(files[called]) for called in sorted(files)}
    except OSError as error:
        raise InvalidPolicy(f"policy {name}: {one_line(error)}") from error


def _scripted(config: PolicyConfig) -> Policy:
    return ScriptedPolicy(config.planner.macro_actions)


def _mixed(config: PolicyConfig) -> Policy:
    expert = Expert(config.planner)  # one for both: what it knows of an episode is kept by episode
    noisy = NoisyPolicy("noisy-expert", expert, config.noise)
    return MixedPolicy([RandomPolicy(), _scripted(config), noisy, expert], config.shares)


register_policy("random", lambda config: RandomPolicy())
register_policy("constant", lambda config: ConstantPolicy())
register_policy("scripted", _scripted)
register_policy("expert", lambda config: Expert(config.planner))
register_policy(
    "noisy-expert",
    lambda config: NoisyPolicy("noisy-expert", Expert(config.planner), config.noise),
)
register_policy("mixed", _mixed)
