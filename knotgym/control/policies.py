"""Look up policies by name and make them.

random          uniform in [-1, 1]^6
constant        (1, 1, 1, 1, 1, 1) at every step, which tows the rope
scripted        one macro-action after another, without a goal
expert          plans passes; does the same thing in the same state
noisy           the expert, but each pull is a random one with probability `noise`, after which it
                looks again; half of the episodes begin with a random pass
play            the expert, to another goal whenever one is reached; for endless tasks
planner         plans pulls in the chain engine from the rope's current state
mixed           draws one of random, scripted, noisy and expert for each episode
module:name     user code, see `own_policies`; the module may lie in the current folder
FOLDER          a learner that `knotgym train` wrote; `pretrained`, `pretrained-clone` ship
recorded:DATASET  repeats the pulls of a dataset's episodes, see `recorded_policy`

`register_policy` adds a single name. A `PolicyFamily` handles every name of some form; packages
provide families through the entry-point group `knotgym.policies`, as `knotgym.learn` provides
FOLDER. Worker processes make their own
policies, so a name must be registered in every process that uses it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from knotgym.common import InvalidPolicy, one_line, require_regular
from knotgym.control.basic_policies import RandomPolicy
from knotgym.control.own_policies import OwnPolicy, load_own, module_card, module_files
from knotgym.control.planning import PASSES, PassPlanner, PullPlanner
from knotgym.control.planning.pass_policies import Mixed, Noisy, Play, Scripted
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.recorded_policy import PREFIX as RECORDED
from knotgym.control.recorded_policy import load_recording, recording_files
from knotgym.control.sampler import Policy

GROUP = "knotgym.policies"  # entry points that each name a PolicyFamily


@dataclass(frozen=True, kw_only=True)
class PolicyFamily:
    """Policies whose names share a form, such as `module:name` or the path of a folder.

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
        name: neither module:name nor a path.
        constructor: makes the policy from a configuration.
        files: what decides how the policy acts, such as its weights; results hold their digests.

    Raises:
        InvalidPolicy: the name is taken, or would be read as a module or path.
    """
    if name in _constructors:
        raise InvalidPolicy(f"a policy named {name!r} is already registered")
    if not name or any(mark in name for mark in ":/\\."):
        raise InvalidPolicy(
            f"a policy's name must not look like module:name or a path, got {name!r}"
        )
    _constructors[name], _files[name] = constructor, tuple(files)


def make_policy(config: PolicyConfig) -> Policy:
    """Make the policy of a configuration.

    Raises:
        InvalidPolicy: the function or file doesn't exist, or its library isn't installed.
    """
    return _family(config.policy).make(config)


def policy_files(config: PolicyConfig) -> dict[str, Path]:
    """Return each file that decides how a policy acts: weights, user code, transcripts, and the
    planner's table. The package's own code isn't among them; its version is recorded elsewhere.

    Raises:
        InvalidPolicy: a file can't be read.
    """
    try:
        files = _family(config.policy).files(config.policy)
        for path in files.values():
            require_regular(path, "file", InvalidPolicy)
        return {name: Path(files[name]) for name in sorted(files)}
    except OSError as error:
        raise InvalidPolicy(f"policy {config.policy}: {one_line(error)}") from error


def training_card(name: str) -> dict[str, Any] | None:
    """Facts about the training of a policy, or None if its family records none."""
    return _family(name).card(name)


def _family(name: str) -> PolicyFamily:
    """The first family whose form a name has. Entry points are read only if they are needed."""
    if _REGISTERED.matches(name):
        return _REGISTERED
    families = (_RECORDED, *_entry_point_families(), _OWN_CODE)
    for family in families:
        if family.matches(name):
            return family
    raise InvalidPolicy(
        f"no policy {name!r}; use {', '.join((*_constructors, *(one.form for one in families)))}"
    )


@cache
def _entry_point_families() -> tuple[PolicyFamily, ...]:
    families = []
    for one in sorted(entry_points(group=GROUP), key=lambda one: one.value):
        try:
            families.append(one.load())
        except (Exception, SystemExit) as error:  # another package's import may raise anything
            raise InvalidPolicy(
                f"the policies of entry point {one.name} = {one.value} can't be loaded:"
                f" {one_line(error)}"
            ) from error
    return tuple(families)


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
_OWN_CODE = PolicyFamily(
    form="module:name",
    matches=lambda name: ":" in name,
    make=lambda config: load_own(config.policy),
    files=module_files,
    card=module_card,
)


def _expert(config: PolicyConfig) -> PassPlanner:
    return PassPlanner(config.expert, config.planner)


def _noisy(config: PolicyConfig) -> Noisy:
    return Noisy(_expert(config), config.noise)


def _mixed(config: PolicyConfig) -> Mixed:
    policies = (RandomPolicy(), Scripted(), _noisy(config), _expert(config))
    return Mixed(policies, config.shares)


_tables = tuple(path for path in PASSES.values() if path.is_file())
register_policy("random", lambda config: RandomPolicy())
register_policy("constant", lambda config: OwnPolicy(lambda seen: [1.0] * 6, "constant"))
register_policy("scripted", lambda config: Scripted())
register_policy("expert", _expert, _tables)
register_policy("noisy", _noisy, _tables)
register_policy("play", lambda config: Play(_expert(config)), _tables)
register_policy("planner", lambda config: PullPlanner(config.planner), _tables)
register_policy("mixed", _mixed, _tables)
