"""Look up policies by name and make them.

random          uniform in [-1, 1]^6
constant        (1, 1, 1, 1, 1, 1) at every step, which tows the rope
scripted        one macro-action after another, without a goal
matching        pulls the bead farthest from its place in the goal's shape; needs to see the shape
expert          plans passes; does the same thing in the same state
noisy           the expert, but each pull is a random one with probability `noise`, after which it
                looks again; half of the episodes begin with a random pass
varied          noisy without the random pulls: half of the episodes begin with a random pass
play            the expert, to another goal whenever one is reached; for endless tasks
planner         plans pulls in the chain engine from the rope's current state
mixed           draws one of random, scripted, noisy and expert for each episode
module:name     user code, see `own_policies`; the module may lie in the current folder
FOLDER          a learner that `knotgym train` wrote; `pretrained`, `pretrained-clone` ship

All of them are rows of one table, each a `PolicyFamily`: `register_policy` adds one, and packages
provide others through the entry-point group `knotgym.policies`, as `knotgym.learn` provides FOLDER.
Worker processes make their own policies, so a name must be registered in every process that uses
it.
"""

import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from knotgym.common import InvalidPolicy, KnotgymError, one_line
from knotgym.control.planning.passes import PassValues
from knotgym.control.planning.planners import PassPlayer, PullPlayer, chooses_pulls
from knotgym.control.policy_config import PolicyConfig
from knotgym.control.sampler import Player, Policy, SimplePolicy, rollouts
from knotgym.envs import EpisodeBatch, TaskConfig
from knotgym.rope import CHAIN

GROUP = "knotgym.policies"  # entry points that each name a PolicyFamily


@dataclass(frozen=True, kw_only=True)
class PolicyFamily:
    """A row of the table of policies: a single name, or all names of some form.

    Attributes:
        form: the name, or what such names look like, for error messages.
        make: make the policy, or raise InvalidPolicy.
        matches: tell whether a name has this form. Must be cheap; what the name refers to need not
            exist. None for the single name `form`.
        files: name -> the files that decide how the policy acts, by the names used for them in
            results.
        card: name -> facts about the policy's training, or None if it has none.
        plans: whether it searches, so that an episode takes far longer than its pulls.
    """

    form: str
    make: Callable[[PolicyConfig], Policy]
    matches: Callable[[str], bool] | None = None
    files: Callable[[str], Mapping[str, Path]] = lambda name: {}
    card: Callable[[str], dict[str, Any] | None] = lambda name: None
    plans: bool = False


_table: dict[str, PolicyFamily] = {}  # by form, in the order in which names are looked up


def register_policy(family: PolicyFamily) -> None:
    """Add a row to the table of policies.

    Raises:
        InvalidPolicy: the form is taken, or a single name would be read as a module or path.
    """
    name = family.form
    if name in _table:
        raise InvalidPolicy(f"a policy named {name!r} is already registered")
    if family.matches is None and (not name or any(mark in name for mark in ":/\\.")):
        raise InvalidPolicy(
            f"a policy's name must not look like module:name or a path, got {name!r}"
        )
    _table[name] = family


def make_policy(config: Any) -> Policy:
    """Make the policy of a PolicyConfig; or of what a user's module may hold, see `own_policies`.

    Raises:
        InvalidPolicy: the function or file doesn't exist, its library isn't installed, or what
            makes the policy raises anything else, SystemExit included.
    """
    if not isinstance(config, PolicyConfig):
        return _later("own_policies:own_policy")(config, type(config).__name__)
    with user_code(config.policy):
        return family_of(config.policy).make(config)


@contextmanager
def user_code(name: str) -> Iterator[None]:
    """Run user code; re-raise what it raises, even by `sys.exit`, as InvalidPolicy."""
    try:
        yield
    except KnotgymError:
        raise
    except (Exception, SystemExit) as error:
        # the innermost frame is where the user's code, or a library that it called, went wrong
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(frame.filename).name}, line {frame.lineno}"
        raise InvalidPolicy(
            f"policy {name} raised {type(error).__name__}: {one_line(error)} ({place})"
        ) from error


def _rows() -> Iterator[PolicyFamily]:
    """Yield the table; entry points are read only if no row before them has the name."""
    yield from _table.values()
    yield from _entry_point_families()
    yield _OWN_CODE


def family_of(name: str) -> PolicyFamily:
    """Return the first family whose form a name has; raise InvalidPolicy if none has."""
    for family in _rows():
        if family.form == name if family.matches is None else family.matches(name):
            return family
    several = "; for several, repeat evaluate's --policy, or `dataset merge` what each collected"
    forms = ", ".join(family.form for family in _rows())
    raise InvalidPolicy(f"no policy {name!r}; use {forms}{several * (',' in name)}")


@cache
def _entry_point_families() -> tuple[PolicyFamily, ...]:
    families = []
    for point in sorted(entry_points(group=GROUP), key=lambda point: point.value):
        said = f"the policies of entry point {point.name} = {point.value} can't be loaded"
        # another package's import may raise anything
        with InvalidPolicy.instead(said, Exception, SystemExit):
            families.append(point.load())
    return tuple(families)


def compile_planning() -> None:
    """Compile what the expert needs, by two pulls of an episode in the chain engine."""
    task = TaskConfig(task="tie", nx=2, engine=CHAIN, horizon=2, observation="state")
    rollouts(make_policy(PolicyConfig(policy="expert")), task, [0])


def _later(name: str) -> Callable[..., Any]:
    """Return a function of a module of this room, which is imported when it is called."""
    return lambda *given: resolve_name(f"knotgym.control.{name}")(*given)


def _endless(task: TaskConfig) -> TaskConfig:
    """Return the task; it must be endless, and its actions must be pulls."""
    if not task.endless:
        raise InvalidPolicy(
            "policy play goes on after every goal, so the task must be endless; set"
            " task.endless, and a task.horizon such as 500"
        )
    return chooses_pulls(task)


def _planned(
    name: str,
    player: Callable[[PolicyConfig, EpisodeBatch], Player],
    compatible_task: Callable[[TaskConfig], TaskConfig] = chooses_pulls,
) -> PolicyFamily:
    """Return the row of a policy whose player uses the tables of passes."""

    def _make(config: PolicyConfig) -> Policy:
        return SimplePolicy(name, partial(player, config), compatible_task)

    tables = (PassValues.table(split) for split in ("train", "train-code"))
    files = {path.name: path for path in tables if path.is_file()}
    return PolicyFamily(form=name, make=_make, files=lambda name: files, plans=True)


for _row in (
    PolicyFamily(
        form="random",
        make=lambda config: SimplePolicy("random", _later("basic_policies:RandomPlayer")),
    ),
    PolicyFamily(
        form="constant",
        make=lambda config: _later("own_policies:own_policy")(lambda seen: [1.0] * 6, "constant"),
    ),
    PolicyFamily(
        form="scripted",
        make=lambda config: SimplePolicy(
            "scripted", _later("planning.pass_policies:ScriptedPlayer"), chooses_pulls
        ),
    ),
    PolicyFamily(
        form="matching",
        make=lambda config: SimplePolicy(
            "matching",
            _later("shape_matching:MatchingPlayer"),
            _later("shape_matching:MatchingPlayer.compatible_task"),
        ),
    ),
    _planned("expert", PassPlayer),
    _planned("noisy", _later("planning.pass_policies:NoisyPlayer")),
    _planned("varied", _later("planning.pass_policies:NoisyPlayer.varied")),
    _planned("play", _later("planning.pass_policies:PlayPlayer"), _endless),
    _planned("planner", lambda config, batch: PullPlayer(config.planner, batch)),
    _planned("mixed", _later("planning.pass_policies:MixedPlayer")),
):
    register_policy(_row)
_OWN_CODE = PolicyFamily(
    form="module:name",
    make=_later("own_policies:load"),
    matches=lambda name: ":" in name,
    files=_later("own_policies:files"),
    card=_later("own_policies:card_of"),
)
