"""Look up policies by name and make them.

random          uniform in [-1, 1]^6
constant        (1, 1, 1, 1, 1, 1) at every step, which tows the rope
scripted        one macro-action after another, without a goal
expert          does the same thing in the same state, see `demonstrator`
noisy           the expert, but each pull is a random one with probability `noise`, after which it
                looks again; half of the episodes begin with a random pass
play            the expert, to another goal whenever one is reached; for endless tasks
planner         plans in the chain engine from the rope's current state, see `expert`
mixed           draws one of random, scripted, noisy and expert for each episode
module:name     user code: a function of (observation) or (observation, info, generator), or an
                object with `reset` and `act`, see `own_policies`; the module may lie in the
                current folder
FOLDER          a learner that `knotgym train` wrote; `pretrained`, `pretrained-clone` ship
FILE            a model that takes observations: .zip (Stable-Baselines3; FILE.zip:SAC selects an
                algorithm other than PPO), .onnx, or .pt (TorchScript)
prompt:FILE     replays the actions in the transcripts of `knotgym prompt`
recorded:DATASET  repeats the actions of a dataset's episodes, see `recorded_policy`

`register_policy` adds a single name. A `PolicyFamily` handles every name of some form; packages
provide families through the entry-point group `knotgym.policies`, and FOLDER and prompt:FILE are
provided in this way by `knotgym.learn` and `knotgym.prompting`. Worker processes make their own
policies, so a name must be registered in every process that uses it.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from math import inf
from pathlib import Path
from typing import Any

from knotgym.common.atomic_files import sha256
from knotgym.common.configuration import Share, configuration
from knotgym.common.errors import InvalidPolicy, one_line
from knotgym.control.demonstrator import Demonstrator, DemonstratorConfig
from knotgym.control.expert import Expert
from knotgym.control.learned_policies import MODEL_FILES, ModelPolicy, load_model
from knotgym.control.old_basic_policies import (
    ConstantPolicy,
    MixedPolicy,
    NoisyPolicy,
    PlayPolicy,
    RandomPolicy,
    ScriptedPolicy,
)
from knotgym.control.own_policies import OwnPolicy, load_own, module_files
from knotgym.control.pass_counts import PASSES
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policy import Choice, Effort, Policy
from knotgym.control.recorded_policy import PREFIX as RECORDED
from knotgym.control.recorded_policy import load_recording, recording_files
from knotgym.control.transition_graph import TRANSITIONS

__all__ = [
    "MIXED",
    "Choice",
    "Effort",
    "InvalidPolicy",
    "Policy",
    "PolicyConfig",
    "PolicyFamily",
    "make_policy",
    "policy_digests",
    "register_policy",
    "training_card",
]

GROUP = "knotgym.policies"  # entry points that each name a PolicyFamily
MIXED = ("random", "scripted", "noisy", "expert")  # what a mixed policy draws from


@configuration
class PolicyConfig:
    """Which policy acts, and its settings.

    Attributes:
        policy: policy: random, constant, scripted, expert, noisy, play, planner, mixed, pretrained
            or pretrained-clone; a folder written by `knotgym train`; a .zip (SB3), .onnx or .pt
            file; prompt:FILE or recorded:DATASET, to score transcripts of `knotgym prompt` or a
            recording; or module:name for your own code: a function of (observation) or
            (observation, info, generator), or an object with reset and act.
        noise: probability that a pull of the noisy policy is random.
        shares: shares of random, scripted, noisy and expert episodes in mixed.
        demonstrator: settings of the expert.
        planner: settings of the planner; the scripted policy uses its macro-actions.
    """

    policy: str = "random"
    noise: Share = 0.1
    shares: tuple[float, ...] = (0.25, 0.25, 0.25, 0.25)
    demonstrator: DemonstratorConfig = DemonstratorConfig()
    planner: PlannerConfig = PlannerConfig()

    def __post_init__(self) -> None:
        fit = len(self.shares) == len(MIXED) and all(0 <= one < inf for one in self.shares)
        if not fit or not 0 < sum(self.shares) < inf:
            raise InvalidPolicy(
                f"shares must be {len(MIXED)} finite numbers of at least 0, not all 0, for"
                f" {', '.join(MIXED)}; got {self.shares}"
            )
        _family(self.policy)

    @property
    def core_seconds(self) -> float:
        """Rough cost of an episode of 50 steps, in seconds on one core of the machine described in
        docs/validation.md. Policies that plan take longer.
        """
        return 3.0 if self.policy in ("expert", "noisy", "play", "planner", "mixed") else 0.5

    @property
    def short(self) -> str:
        """A name for dataset ids: letters, digits and dashes."""
        stem = self.policy
        if stem not in _constructors:
            stem = Path(stem.partition(":")[0]).stem.split(".")[-1]
        return "".join(letter if letter.isalnum() else "-" for letter in stem)


@dataclass(frozen=True, kw_only=True)
class PolicyFamily:
    """Policies whose names share a form, such as `module:name` or the path of a model file.

    Attributes:
        form: what such a name looks like, for error messages.
        matches: tell whether a name has this form. Must be cheap; what the name refers to need not
            exist.
        make: make the policy, or raise InvalidPolicy.
        files: name -> the files that decide how the policy acts, by the names used for them in
            results.
        card: name -> facts about the policy's training, or None if it has none.
    """

    form: str
    matches: Callable[[str], bool]
    make: Callable[[PolicyConfig], Policy]
    files: Callable[[str], Mapping[str, Path]]
    card: Callable[[str], dict[str, Any] | None] = lambda name: None


Constructor = Callable[[PolicyConfig], Policy]
_constructors: dict[str, Constructor] = {}
_files: dict[str, tuple[Path, ...]] = {}  # files that a registered policy is made from


def register_policy(name: str, constructor: Constructor, files: Sequence[Path] = ()) -> None:
    """Register a policy under a name.

    Args:
        name: neither module:name nor the path of a model file.
        constructor: makes the policy from a configuration.
        files: what decides how the policy acts, such as its weights; results hold their digests.

    Raises:
        InvalidPolicy: the name is taken, or would be read as a module or file.
    """
    if name in _constructors:
        raise InvalidPolicy(f"a policy named {name!r} is already registered")
    if not name or ":" in name or _is_model_file(name):
        raise InvalidPolicy(
            f"a policy's name must not look like module:name or a model file, got {name!r}"
        )
    _constructors[name], _files[name] = constructor, tuple(files)


def make_policy(config: PolicyConfig) -> Policy:
    """Make the policy of a configuration.

    Raises:
        InvalidPolicy: the function or file doesn't exist, or its library isn't installed.
    """
    return _family(config.policy).make(config)


def policy_digests(config: PolicyConfig) -> dict[str, str]:
    """SHA-256 of each file that decides how a policy acts: weights, user code, transcripts, and the
    planner's table. The package's own code isn't among them; its version is recorded elsewhere.

    Raises:
        InvalidPolicy: a file can't be read.
    """
    files = _family(config.policy).files(config.policy)
    try:
        return {name: sha256(files[name]) for name in sorted(files)}
    except OSError as error:
        raise InvalidPolicy(f"policy {config.policy}: {one_line(error)}") from error


def training_card(name: str) -> dict[str, Any] | None:
    """Facts about the training of a policy, or None if its family records none."""
    return _family(name).card(name)


def _family(name: str) -> PolicyFamily:
    """The first family whose form a name has. Entry points are read only if they are needed."""
    if _REGISTERED.matches(name):
        return _REGISTERED
    families = (_RECORDED, *_entry_point_families(), _MODEL_FILE, _OWN_CODE)
    for family in families:
        if family.matches(name):
            return family
    raise InvalidPolicy(
        f"no policy {name!r}; use {', '.join((*_constructors, *(one.form for one in families)))}"
    )


_CHECKOUT = Path(__file__).parents[2] / "pyproject.toml"


@cache
def _entry_point_families() -> tuple[PolicyFamily, ...]:
    found = {one.value: one for one in entry_points(group=GROUP)}
    # A checkout that is on the path but isn't installed, or was installed before it declared an
    # entry point, lacks that metadata; its pyproject.toml has it.
    if _CHECKOUT.is_file():
        declared = tomllib.loads(_CHECKOUT.read_text(encoding="utf-8")).get("project", {})
        for name, value in declared.get("entry-points", {}).get(GROUP, {}).items():
            found.setdefault(value, EntryPoint(name, value, GROUP))
    families = []
    for value in sorted(found):
        try:
            families.append(found[value].load())
        except Exception as error:  # another package's import may raise anything
            raise InvalidPolicy(
                f"the policies of entry point {found[value].name} = {value} can't be loaded:"
                f" {one_line(error)}"
            ) from error
    return tuple(families)


def _is_model_file(name: str) -> bool:
    return Path(name.partition(":")[0]).suffix in MODEL_FILES


def _model(config: PolicyConfig) -> Policy:
    path, _, algorithm = config.policy.partition(":")
    return ModelPolicy(load_model(Path(path), algorithm), config.short)


def _model_files(name: str) -> dict[str, Path]:
    path = Path(name.partition(":")[0])
    return {path.name: path}


def _own(config: PolicyConfig) -> Policy:
    module, _, name = config.policy.partition(":")
    return OwnPolicy(load_own(module, name), config.policy)


_REGISTERED = PolicyFamily(
    form="a registered name",
    matches=lambda name: name in _constructors,
    make=lambda config: _constructors[config.policy](config),
    files=lambda name: {path.name: path for path in _files[name]},
)
_RECORDED = PolicyFamily(
    form=f"{RECORDED}DATASET",
    matches=lambda name: name.startswith(RECORDED),
    make=lambda config: load_recording(config.policy),
    files=recording_files,
)
_MODEL_FILE = PolicyFamily(
    form="a .zip, .onnx or .pt file", matches=_is_model_file, make=_model, files=_model_files
)
_OWN_CODE = PolicyFamily(
    form="module:name",
    matches=lambda name: ":" in name,
    make=_own,
    files=lambda name: module_files(name.partition(":")[0]),
)


def _scripted(config: PolicyConfig) -> Policy:
    return ScriptedPolicy(config.planner.macro_actions)


def _expert(config: PolicyConfig) -> Demonstrator:
    return Demonstrator(config.demonstrator, config.planner)


def _noisy(config: PolicyConfig) -> Policy:
    return NoisyPolicy("noisy", _expert(config), config.noise)


def _mixed(config: PolicyConfig) -> Policy:
    expert = _expert(config)  # shared by both: it keeps what it knows by episode
    noisy = NoisyPolicy("noisy", expert, config.noise)
    return MixedPolicy([RandomPolicy(), _scripted(config), noisy, expert], config.shares)


_planner_files = tuple(path for path in (TRANSITIONS,) if path.is_file())
_expert_files = (*_planner_files, *(path for path in PASSES.values() if path.is_file()))
register_policy("random", lambda config: RandomPolicy())
register_policy("constant", lambda config: ConstantPolicy())
register_policy("scripted", _scripted)
register_policy("expert", _expert, _expert_files)
register_policy("noisy", _noisy, _expert_files)
register_policy(
    "play", lambda config: PlayPolicy(config.demonstrator, config.planner), _expert_files
)
register_policy("planner", lambda config: Expert(config.planner), _planner_files)
register_policy("mixed", _mixed, _expert_files)
