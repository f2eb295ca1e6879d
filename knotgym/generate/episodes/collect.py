"""Collect a policy's episodes as a Minari dataset, with any number of processes.

Each process plays a few episodes at a time into a file of the staging folder; the files are merged
at the end. An episode depends only on the seed and its number, so the dataset's bytes don't depend
on the processes. A resumed run keeps the files that are finished.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from knotgym.common.atomic_files import require_output, sha256
from knotgym.common.configuration import Count, Seed, as_json, choice, configuration, differences
from knotgym.common.errors import InvalidInput
from knotgym.control.expert import Expert
from knotgym.control.old_policies import make_policy
from knotgym.control.planner_config import PlannerConfig
from knotgym.control.policies import PolicyConfig
from knotgym.control.policy import Effort
from knotgym.control.rollouts import Rollout, rollout
from knotgym.datasets.episode_writer import EpisodeWriter, merge_episodes
from knotgym.datasets.machine import machine
from knotgym.datasets.minari_dataset import MinariMetadata, publish
from knotgym.envs.tasks import OBSERVATIONS, TaskConfig
from knotgym.generate.episodes.digests import digests, require_unchanged, sources
from knotgym.generate.episodes.results import reference_scores
from knotgym.generate.episodes.tally import Tally
from knotgym.rope.engines import MUJOCO
from knotgym.rope.model import RopeConfig
from knotgym.runs.engine import Batch, Recipe, run
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.runs.staging import require_no_interrupted_run
from knotgym.states.state_file import minari_root, read_states, ships, states_file

REPORT = "collection.json"
OBSERVATION = "both"  # stored by `knotgym collect` by default


@configuration
class CollectConfig:
    """Which episodes to collect.

    Attributes:
        task: the environment; its `observation` is stored.
        policy: the acting policy.
        episodes: episodes to play for each --nx.
        seed: random seed; the same seed gives the same bytes. Episode i has
            `rollouts.episode_seed(seed, i)`.
        keep_failed: keep episodes that didn't reach the goal.
        attempts: rollouts per episode; the shortest one that reaches the goal is kept, or else the
            first.
        labels: "expert" stores the expert's action at every state, planned with --budget for each.
        episodes_per_file: episodes per file of the staging folder; doesn't affect the dataset.
        seen: observation given to functions and models that don't declare their own; "" for the
            stored one.
        dataset_id: Minari id; by default for example knotgym/tie-nx3/expert-v0, with a mark for
            each setting that changes the data, as in expert-state-seed1-v0.
        author: author of the dataset; may be repeated.
        author_email: author's email; may be repeated.
        code_permalink: URL of the code that made it.
    """

    task: TaskConfig = TaskConfig(task="tie", observation=OBSERVATION)
    policy: PolicyConfig = PolicyConfig(policy="expert")
    episodes: Count = 200
    seed: Seed = 0
    keep_failed: bool = True
    attempts: Count = 1
    labels: Annotated[str, choice("", "expert")] = ""
    episodes_per_file: Count = 4
    seen: Annotated[str, choice("", *OBSERVATIONS)] = ""
    dataset_id: str = ""
    author: tuple[str, ...] = ()
    author_email: tuple[str, ...] = ()
    code_permalink: str | None = None

    def __post_init__(self) -> None:
        if self.policy.policy.startswith("prompt:"):
            raise InvalidInput(
                "transcripts can only be evaluated, not collected; give knotgym evaluate --policy"
                f" {self.policy.policy}"
            )
        if not self.dataset_id:
            marks = collection_marks(self.attempts, self.labels)
            object.__setattr__(self, "dataset_id", plain_id(self.task, self.policy, *marks))

    @property
    def core_seconds(self) -> float:
        """Cost of an episode in core seconds, see `PolicyConfig.core_seconds`."""
        return self.attempts * (0.5 + 40.0 * bool(self.labels))

    @property
    def seen_task(self) -> TaskConfig:
        """The environment with the observation that the policy gets."""
        return replace(self.task, observation=self.seen or self.task.observation)

    @property
    def stored_task(self) -> TaskConfig:
        """The environment as stored in the dataset.

        A state file that isn't included in knotgym is copied into the dataset and found by its id.
        """
        if ships(self.task.states):
            return self.task
        return replace(self.task, states=self.dataset_id)


def plain_id(task: TaskConfig, policy: PolicyConfig, *marks: str) -> str:
    """Return the id of a dataset from its task, its policy and further marks."""
    split = "" if task.split == "train" else task.split
    engine = "" if task.engine == MUJOCO else task.engine
    name = "-".join([policy.short, *filter(None, (engine, split, *marks))])
    return f"knotgym/{task.task}-nx{task.nx}/{name}-v0"


def collection_marks(attempts: int, labels: str) -> tuple[str, ...]:
    """Return the marks of best-of-n rollouts and of expert labels."""
    return f"best{attempts}" if attempts > 1 else "", "labelled" if labels else ""


def distinct_id(config: CollectConfig) -> str:
    """Return the default id of a collection: `plain_id`, with a mark for every setting but the
    number of episodes that changes its content.

    A set of states is named, a state file marked by its digest; settings of the environment and
    the policy that have no mark of their own share one digest.

    >>> config = CollectConfig(task=TaskConfig(task="tie"), policy=PolicyConfig(policy="expert"))
    >>> distinct_id(config)
    'knotgym/tie-nx2/expert-pixels-v0'
    """
    task, policy, seed = config.task, config.policy, config.seed
    states = "" if task.states in (None, "readable") else str(task.states)
    if not ships(task.states):
        file = states_file(task.states)
        states = f"states{sha256(file)[:8]}" if file.is_file() else ""
    marked = ("task", "nx", "split", "states", "engine", "observation")
    plain = TaskConfig(**{name: getattr(task, name) for name in marked})
    rules = list(differences(as_json(plain), as_json(task)))
    if config.labels or policy.policy in ("noisy", "mixed", "expert", "play"):
        usual = PolicyConfig(policy=policy.policy)
        rules += differences(as_json(usual), as_json(policy))
    digest = f"rules{hashlib.sha256('; '.join(rules).encode()).hexdigest()[:8]}" if rules else ""
    return plain_id(
        task,
        policy,
        states,
        "" if task.observation == OBSERVATION else task.observation,
        f"seed{seed}" if seed else "",
        "" if config.keep_failed else "successes",
        *collection_marks(config.attempts, config.labels),
        digest,
    )


class EpisodeFile(NamedTuple):
    """A unit of work: make episodes `numbers` and write them to `path`."""

    config: CollectConfig
    numbers: range
    path: Path


def collect(
    config: CollectConfig,
    out: Path | None,
    options: RunOptions,
    *,
    progress: Progress | None = None,
) -> Path:
    """Collect a dataset and return its folder.

    Args:
        out: Minari root to write to; None for Minari's own.
        options: how to execute the run. A shard writes main_data.hdf5 and collection.json to a
            folder NAME-shard-2-of-8, which Minari doesn't list.

    Raises:
        Occupied, InvalidInput: as in `runs.engine.run`.
        InvalidInput: no episode is left to keep.
    """
    folder = _folder(config, out, options)
    recipe = EpisodeRecipe(config, options)
    if progress is not None:
        tell_if_long(progress, config.core_seconds * len(recipe.numbers), options.workers)
    return run(recipe, folder, options, progress)


def require_collectable(config: CollectConfig, out: Path | None, options: RunOptions) -> None:
    """Require that a collection's output doesn't exist and no interrupted run left work.

    Raises:
        Occupied: it does, and `options` don't say what to do with it.
    """
    folder = _folder(config, out, options)
    if not options.resume:
        require_output(folder, folder=True, overwrite=options.overwrite)
    require_no_interrupted_run(folder, options)


def _folder(config: CollectConfig, out: Path | None, options: RunOptions) -> Path:
    return options.shard.folder((out or minari_root()) / config.dataset_id)


class EpisodeRecipe(Recipe):
    """Recipe for a policy's episodes, see `runs.engine.Recipe`.

    Each unit writes a file of a few episodes. The finished files are the checkpoint.
    """

    def __init__(self, config: CollectConfig, options: RunOptions) -> None:
        make_policy(config.policy).suited(config.seen_task)  # refuses before any work is done
        _metadata(config, Tally())  # refuses a bad id
        if not ships(config.task.states):
            read_states(states_file(config.task.states), images=False)
        self.config, self.shard, self.tally = config, options.shard, Tally()
        self.engine = config.task.engine
        self.numbers = options.shard.share(config.episodes)
        self.files: list[EpisodeFile] = []
        if not self.numbers:
            raise InvalidInput(
                f"shard {options.shard} of {config.episodes} episodes has none: split the run into"
                " fewer shards"
            )

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": self.sources()}

    def sources(self) -> dict[str, Any]:
        """Return the digests of everything that is read."""
        return sources_of(self.config)

    def work(self) -> Callable[[EpisodeFile], Tally]:
        """Return what makes a file."""
        return play

    def batches(self, folder: Path) -> Iterator[Batch]:
        size = self.config.episodes_per_file
        for first in range(0, len(self.numbers), size):
            few, path = self.numbers[first : first + size], f"episodes-{first // size:06d}.h5"
            self.files.append(EpisodeFile(self.config, few, folder / path))
        finished = {file.path: _finished(file.path) for file in self.files}
        self.tally = sum((tally for tally in finished.values() if tally is not None), Tally())

        def absorb(file: EpisodeFile, tally: Tally) -> None:
            self.tally += tally

        left = [file for file in self.files if finished[file.path] is None]
        yield Batch(self.work(), left, absorb, "playing files of a few episodes")

    def status(self) -> Status:
        facts = {"reached the goal": f"{self.tally.succeeded}"}
        return Status(self.tally.played, len(self.numbers), "episodes", facts, even=True)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        require_unchanged(request["source"], self.sources())
        paths = [file.path for file in self.files]
        if self.shard.is_whole:
            return write_whole(self.config, paths, self.tally, folder, request)
        folder.mkdir()
        merge_episodes(paths, folder / "main_data.hdf5")
        files = {"main_data.hdf5": sha256(folder / "main_data.hdf5")}
        _report(folder / REPORT, request, self.tally, files)
        return folder

    def summary(self) -> str:
        tally = self.tally
        return (
            f"{tally.kept} episodes, {tally.steps} steps; {tally.succeeded} of {tally.played}"
            f" reached the goal, {tally.played - tally.succeeded} failed"
            f" ({'kept' if self.config.keep_failed else 'dropped'}); planning"
            f" {tally.planned_actions / tally.played:.0f} simulated actions and"
            f" {tally.planning_seconds / tally.played:.1f} s an episode"
        )


def sources_of(config: CollectConfig) -> dict[str, Any]:
    """Return the digests of a collection's policies, including a labelling expert, and states."""
    labeller = [replace(config.policy, policy="expert")] if config.labels else []
    return sources([config.policy, *labeller], [config.task])


def write_whole(
    config: CollectConfig,
    files: Sequence[Path],
    tally: Tally,
    root: Path,
    request: dict[str, Any],
    *,
    concatenate: bool = False,
    machines: Sequence[dict[str, str]] | None = None,
) -> Path:
    """Write a run's dataset below `root` from files of episodes, and return its folder.

    Args:
        files: files of episodes.
        tally: totals of the episodes.
        root: Minari root to write to.
        request: of the run.
        concatenate: see `publish`.
        machines: the machines that played the episodes; this one by default.

    Raises:
        InvalidInput: no episode is left to keep.
    """
    if not tally.kept:
        raise InvalidInput(
            f"none of {tally.played} episodes reached the goal and failed ones are dropped, so"
            " nothing is left to write"
        )
    carried = None if ships(config.task.states) else states_file(config.task.states)
    metadata = replace(_metadata(config, tally), digests=digests(request["source"]))
    made = publish(files, metadata, root, concatenate=concatenate, states=carried)
    _report(made / "data" / REPORT, request, tally, machines=machines)
    return made


def _report(
    path: Path,
    request: dict[str, Any],
    tally: Tally,
    files: dict[str, str] | None = None,
    machines: Sequence[dict[str, str]] | None = None,
) -> None:
    content = {
        "format": "knotgym-collection",
        "format_version": 1,
        **request,
        "machines": machines or [machine()],
        "tally": {**asdict(tally), "planning_seconds": round(tally.planning_seconds, 1)},
        **({"files": files} if files else {}),
    }
    path.write_text(json.dumps(content, indent=1, sort_keys=True), encoding="utf-8")


def play(file: EpisodeFile) -> Tally:
    """Play a file's episodes and write it."""
    return write_episodes(file, _best_of_attempts(file.config, file.numbers))


def write_episodes(file: EpisodeFile, rollouts: Sequence[Rollout]) -> Tally:
    """Write a file and then its tally, which marks it as finished."""
    config = file.config
    kept = [played for played in rollouts if played.success or config.keep_failed]
    with EpisodeWriter(file.path, config.stored_task) as writer:
        for played in kept:
            writer.add(played.episode, played.number)
    tally = Tally(
        played=len(rollouts),
        succeeded=sum(played.success for played in rollouts),
        kept=len(kept),
        steps=sum(len(played.episode) for played in kept),
        successful_steps=sum(len(played.episode) for played in rollouts if played.success),
        planned_actions=sum(played.effort.actions for played in rollouts),
        planning_seconds=sum(played.effort.seconds for played in rollouts),
        simulation_failures=sum(bool(played.episode.simulation_failed[-1]) for played in rollouts),
    )
    sealed = {"sha256": sha256(file.path), "tally": asdict(tally)}
    write_sealed(file.path.with_suffix(".json"), sealed)
    return tally


def _best_of_attempts(config: CollectConfig, numbers: range) -> list[Rollout]:
    """Return each episode's shortest successful rollout, or else its first.

    Its planning effort is the sum over all rollouts of the episode.
    """
    policy = make_policy(config.policy)
    labeller = Expert(PlannerConfig(budget=config.policy.planner.budget)) if config.labels else None
    attempts = [
        rollout(config.seen_task, policy, numbers, config.seed, attempt=one, labeller=labeller)
        for one in range(config.attempts)
    ]
    best = []
    for tries in zip(*attempts, strict=True):
        kept = min(tries, key=lambda one: (not one.success, len(one.episode) * one.success))
        effort = reduce(Effort.plus, (one.effort for one in tries))
        best.append(replace(kept, effort=effort))
    return best


def _finished(path: Path) -> Tally | None:
    """Return the tally of a file if it is finished and intact, otherwise None."""
    try:
        sealed = read_sealed(path.with_suffix(".json"))
        return Tally(**sealed["tally"]) if sealed["sha256"] == sha256(path) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _metadata(config: CollectConfig, tally: Tally) -> MinariMetadata:
    """Return Minari's metadata; reference scores are those of random and expert policies."""
    task, policy = config.task, config.policy
    measured = task.engine == MUJOCO and task.rope == RopeConfig() and not task.endless
    scores = reference_scores().get(f"{task.task}-nx{task.nx}", {}) if measured else {}
    is_noisy = policy.policy in ("noisy", "mixed")
    noise = f", each pull a random one with probability {policy.noise}" * is_noisy
    planned = tally.planned_actions / max(tally.played, 1)
    # the expert's looks have limits of their own
    allowed = f", of {policy.planner.budget} allowed" * (policy.policy == "planner")
    planning = f" Planning took {planned:.0f} simulated actions an episode{allowed}."
    labels = " At every state stands what an expert would do there (infos/expert_action)."
    tried = f", the best of {config.attempts} attempts each" * (config.attempts > 1)
    text = (
        f"KnotGym, task {task.task} with {task.nx} crossings, {task.split} split, engine"
        f" {task.engine}: {tally.kept} episodes of policy {policy.policy}{noise}{tried}, seed"
        f" {config.seed}. {tally.succeeded} of {tally.played} episodes played reached the goal"
        f" within {task.horizon} steps; failed ones are"
        f" {'kept' if config.keep_failed else 'dropped'}.{labels * bool(config.labels)}"
        f"{planning * bool(planned)}"
    )
    return MinariMetadata(
        dataset_id=config.dataset_id,
        algorithm_name=policy.policy,
        description=text,
        author=config.author,
        author_email=config.author_email,
        code_permalink=config.code_permalink,
        ref_min_score=scores.get("random"),
        ref_max_score=scores.get("expert"),
        num_episodes_average_score=scores.get("episodes"),
    )
