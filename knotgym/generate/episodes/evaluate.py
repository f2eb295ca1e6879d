"""Evaluate the success rate of policies on tasks, crossing numbers and splits.

Confidence intervals are over states, see `cluster_interval`. With several crossing numbers or
splits, the results are a generalization matrix for policies trained on one of them.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common.atomic_files import atomic_write, require_output
from knotgym.common.configuration import Count, Seed, Whole, as_json, configuration, read_json
from knotgym.common.errors import InvalidInput, Occupied
from knotgym.control.old_policies import make_policy
from knotgym.control.policies import PolicyConfig, training_card
from knotgym.control.rollouts import EVALUATION, Rollout, rollout
from knotgym.datasets.trajectory import Episode
from knotgym.envs.task_states import state_origins
from knotgym.envs.tasks import TaskConfig
from knotgym.generate.episodes.digests import digests, require_unchanged, sources
from knotgym.generate.episodes.results import Result, show
from knotgym.runs.compilation import compile_first
from knotgym.runs.engine import Batch, Recipe
from knotgym.runs.engine import run as run_recipe
from knotgym.runs.executors import executor
from knotgym.runs.intervals import cluster_interval
from knotgym.runs.pools import Pool
from knotgym.runs.progress import Progress, Status, tell_if_long
from knotgym.runs.run_options import RunOptions
from knotgym.runs.sealed_json import read_sealed, write_sealed
from knotgym.runs.shards import WHOLE, Shard

SIDE_BY_SIDE = 8  # episodes per piece of work
_PLANNED = 4  # those of policies that plan: one may take minutes, and finished pieces are kept


@configuration
class EvaluateConfig:
    """What to evaluate.

    Attributes:
        policies: each is evaluated on every task, crossing number and split.
        tasks: tasks, comma-separated: tie, unknot, convert.
        nx: numbers of crossings: 3, 2,3 or 2-4.
        splits: splits, comma-separated: train, test, train-code, test-code.
        episodes: episodes for each policy, task, split and --nx. Episode i is the same for every
            policy.
        seed: random seed; the same seed gives the same episodes, and none of them is in a dataset.
        task: settings shared by all environments; its task, nx and split are not used.
        filmed: episodes per setup in the film.
    """

    policies: tuple[PolicyConfig, ...] = (PolicyConfig(),)
    tasks: tuple[str, ...] = ("tie",)
    nx: tuple[int, ...] = (2,)
    splits: tuple[str, ...] = ("test",)
    episodes: Count = 256
    seed: Seed = 0
    task: TaskConfig = TaskConfig(task="tie", observation="state")
    filmed: Whole = 0

    def __post_init__(self) -> None:
        if not all((self.policies, self.tasks, self.nx, self.splits)):
            raise InvalidInput("give at least one policy, task, number of crossings and split")
        list(self.setups())  # raises if an environment can't be made

    def setups(self) -> Iterator[tuple[PolicyConfig, TaskConfig]]:
        """Yield every combination of policy and environment."""
        for policy in self.policies:
            for task in self.tasks:
                for split in self.splits:
                    for nx in self.nx:
                        yield policy, replace(self.task, task=task, nx=nx, split=split)


class PlayedEpisode(NamedTuple):
    """Outcome of one episode; `start` and `goal` are rows of the state file."""

    start: int
    goal: int
    success: bool
    steps: int
    total: float
    planned_actions: int
    planning_seconds: float
    failed: bool


class _Piece(NamedTuple):
    """A unit of work: a few episodes of one setup, whose outcomes are written to `path`."""

    policy: PolicyConfig
    task: TaskConfig
    numbers: range
    seed: int
    filmed: int
    path: Path | None


def _play(piece: _Piece) -> tuple[list[PlayedEpisode], list[Episode]]:
    """Play the episodes of a piece; return their outcomes and the episodes to film."""
    policy = make_policy(piece.policy)
    rollouts = rollout(piece.task, policy, piece.numbers, piece.seed, streams=EVALUATION)
    films = [one.episode for one in rollouts if one.number < piece.filmed]
    played = [_played(one) for one in rollouts]
    if piece.path is not None:
        write_sealed(piece.path, {"played": played})
    return played, films


def evaluate(
    config: EvaluateConfig, pool: Pool, progress: Progress | None = None
) -> tuple[list[Result], list[Episode]]:
    """Play every setup and write nothing.

    Returns:
        The results in the order of `config.setups`, and the filmed episodes.
    """
    recipe = EvaluationRecipe(config)
    recipe.play(pool, progress)
    return recipe.results, recipe.films


class EvaluationRecipe(Recipe):
    """Recipe for an evaluation, see `runs.engine.Recipe`.

    Each unit writes the outcomes of a few episodes. The finished files are the checkpoint. They
    have no films, so filmed episodes are played again when a run is resumed.
    """

    def __init__(
        self,
        config: EvaluateConfig,
        video: Path | None = None,
        overwrite: bool = False,
        shard: Shard = WHOLE,
    ) -> None:
        for policy, task in config.setups():  # refuses before any work is done
            make_policy(policy).suited(task)
        self.config, self.video, self.overwrite = config, video, overwrite
        self.shard, self.numbers = shard, shard.share(config.episodes)
        if not self.numbers:
            raise InvalidInput(
                f"shard {shard} of {config.episodes} episodes has none: split the evaluation into"
                " fewer shards"
            )
        self.engine, self.source = config.task.engine, sources_of(config)
        self.played: dict[_Piece, list[PlayedEpisode]] = {}
        self.films: list[Episode] = []
        self.results: list[Result] = []

    def request(self) -> dict[str, Any]:
        return {"config": as_json(self.config), "source": self.source}

    def begin(self) -> None:
        if self.video is not None:
            require_output(self.video, folder=False, overwrite=self.overwrite)

    def batches(self, folder: Path | None) -> Iterator[Batch]:
        numbers, setups = self.numbers, list(self.config.setups())
        for policy, task in setups:
            count = _PLANNED if policy.plans else SIDE_BY_SIDE
            for first in range(0, len(numbers), count):
                few, name = numbers[first : first + count], f"{len(self.played):06d}.json"
                path = None if folder is None else folder / name
                piece = _Piece(policy, task, few, self.config.seed, self.config.filmed, path)
                self.played[piece] = _finished(path)

        def absorb(piece: _Piece, result: tuple[list[PlayedEpisode], list[Episode]]) -> None:
            self.played[piece] = result[0]
            self.films += result[1]

        left = [
            piece
            for piece, played in self.played.items()
            if not played or piece.numbers.start < piece.filmed
        ]
        yield Batch(_play, left, absorb, "playing a few episodes at a time")
        for setup in setups:
            pieces = [played for piece, played in self.played.items() if piece[:2] == setup]
            self.results.append(_result(*setup, [one for piece in pieces for one in piece]))

    def play(self, pool: Pool, progress: Progress | None = None) -> None:
        """Play everything without a staging folder."""
        for batch in self.batches(None):
            for done, _ in enumerate(batch.follow(pool), 1):
                if progress is not None:
                    progress.stage(batch.name, done, len(batch.units))
                    progress.show(self.status)

    def status(self) -> Status:
        total = sum(len(piece.numbers) for piece in self.played)
        return Status(sum(map(len, self.played.values())), total, "episodes", even=True)

    def finish(self, folder: Path, request: dict[str, Any]) -> Path:
        require_unchanged(self.source, sources_of(self.config))
        self.write_film()  # before the output, which says that all is done
        text = as_text(report(self.config, self.results, self.source, self.shard))
        folder.write_text(text, encoding="utf-8")
        return folder

    def write_film(self) -> None:
        """Write the video, if one is wanted."""
        if self.video is not None:
            from knotgym.rendering.video import write_film

            frames = [frame for one in self.films for frame in film(one, self.config.task)]
            with atomic_write(self.video, overwrite=self.overwrite) as temporary:
                write_film(temporary, frames)

    def summary(self) -> str:
        return f"{len(self.results)} results of {len(self.numbers)} episodes each"


def _finished(path: Path | None) -> list[PlayedEpisode]:
    """Return the outcomes in the file of a piece; [] if it isn't finished and intact."""
    try:
        return [PlayedEpisode(*one) for one in read_sealed(path)["played"]] if path else []
    except (OSError, ValueError, KeyError, TypeError):
        return []


# fields of a learner's card
_TRAINING = ("weights_sha256", "seconds", "episodes")


def sources_of(config: EvaluateConfig) -> dict[str, Any]:
    """Return the digests of the policies and states of an evaluation, see `sources`."""
    return sources(config.policies, (task for _, task in config.setups()))


def report(
    config: EvaluateConfig, results: Sequence[Result], source: dict[str, Any], shard: Shard = WHOLE
) -> dict[str, Any]:
    """Return the content of the result file; `source` is `sources_of(config)` before playing."""
    learners = {
        one.policy: {name: card[name] for name in _TRAINING}
        for one in config.policies
        if (card := training_card(one.policy)) is not None
    }
    made_by = {"settings": asdict(config), "digests": digests(source), "learners": learners}
    return {
        "version": knotgym.__version__,
        **totals(results),
        **made_by,
        **({} if shard.is_whole else {"shard": asdict(shard)}),
        "results": [asdict(one) for one in results],
    }


def totals(results: Sequence[Result]) -> dict[str, Any]:
    """Return the success rate over all setups, its 95 % interval and the number of episodes."""
    columns: dict[str, list[Any]] = {"success": [], "start": [], "goal": []}
    for one in results:
        columns["success"] += one.outcomes["success"]
        for side, origin in (("start", one.start_states), ("goal", one.goal_states)):
            columns[side] += [f"{origin} {row}" for row in one.outcomes[side]]
    return {
        "success_rate": float(np.mean(columns["success"])),
        "interval": list(cluster_interval(*columns.values())),
        "episodes": len(columns["success"]),
    }


def as_text(report: dict[str, Any]) -> str:
    """Format a report as JSON, with each list of numbers on one line."""
    text = json.dumps(report, indent=1)
    return re.sub(r"\[[-\d\s.,]+\]", lambda found: " ".join(found[0].split()), text) + "\n"


def run(
    config: EvaluateConfig,
    options: RunOptions,
    *,
    out: Path | None = None,
    video: Path | None = None,
    progress: Progress | None = None,
) -> list[Result]:
    """Evaluate, print the results, and write the requested files.

    Args:
        options: how to execute the run; with `resume`, a finished evaluation is only printed.
        out: JSON file to write, see `report`; a shard writes its own beside it.
        video: film to write, of `config.filmed` episodes per setup, or 2.

    Raises:
        InvalidInput: resume, restart or a shard is requested without `out`, or a film of a shard.
        InvalidInput, Occupied, Failed: as in `runs.engine.run`, and for `video`.
        InvalidInput: the video format can't be written here.
        InvalidInput: the state file lacks states that a task needs.
    """
    if progress is None:
        progress = Progress(quiet=True)
    if out is None and (options.resume or options.restart):
        raise InvalidInput("--resume and --restart need the --out of the evaluation; give it too")
    if video is not None:
        from knotgym.rendering.video import require_film

        require_film(video)
        config = replace(config, filmed=config.filmed or 2)
    if not options.shard.is_whole:
        if out is None or video is not None:
            wrong = "needs the --out of the evaluation" if out is None else "can't be filmed"
            raise InvalidInput(f"a shard {wrong}")
        out = options.shard.file(out)
    recipe = EvaluationRecipe(config, video, options.overwrite, options.shard)
    spent = sum(0.5 for policy, _ in config.setups()) * len(recipe.numbers)
    tell_if_long(progress, spent, options.workers)
    if out is not None:
        run_recipe(recipe, out, options, progress, is_folder=False, made_by=_request_in)
        if not recipe.results:  # it was finished already
            recipe.results = [Result(**row) for row in read_json(out)["results"]]
        if video is not None and not video.exists():
            raise Occupied(
                f"{out} is finished already, but the film {video} isn't there; --overwrite without"
                " --resume makes both again"
            )
    else:
        recipe.begin()
        compile_first(progress, recipe.engine, options.workers)
        with executor(options.workers, options.scheduler) as pool:
            recipe.play(pool, progress)
        recipe.write_film()
    if not options.quiet:
        show(recipe.results, progress.console, config.task.engine)
    if video is not None:
        progress.say(f"{video}: {len(recipe.films)} episodes")
    return recipe.results


def _request_in(out: Path) -> dict[str, Any] | None:
    """Return the request of the evaluation that wrote a file; None if it isn't one."""
    try:
        content = read_json(out)
        found = content["digests"]
        source = {name: found.pop(name) for name in ("states", "policies")}
        shard = content.get("shard", asdict(WHOLE))
        [Result(**row) for row in content["results"]]
        return {"config": content["settings"], "source": source, "shard": shard, **found}
    except (OSError, KeyError, TypeError, ValueError, AttributeError):
        return None


def film(episode: Episode, task: TaskConfig) -> list[NDArray[np.uint8]]:
    """Return the frames of a film of an episode: all its views, each pull, and its reason."""
    from knotgym.rendering.video import film_frames

    moves = [""] * len(episode.points) if episode.move is None else episode.move
    headings = [
        f"{episode.policy}  step {k} of {len(episode)}  {move}" for k, move in enumerate(moves)
    ]
    pulls = [
        (int(bead), force / task.rope.max_force)
        for bead, force in zip(episode.bead[1:], episode.force[1:], strict=True)
    ]
    return film_frames(
        list(episode.points), episode.goal_points, headings, pulls, episode.is_success, task.views
    )


def _played(one: Rollout) -> PlayedEpisode:
    episode = one.episode
    return PlayedEpisode(
        episode.options["start"],
        episode.options["goal"],
        one.success,
        len(episode),
        float(episode.rewards.sum()),
        one.effort.actions,
        one.effort.seconds,
        bool(episode.simulation_failed[-1]),
    )


def _result(policy: PolicyConfig, task: TaskConfig, played: Sequence[PlayedEpisode]) -> Result:
    successes = sum(one.success for one in played)
    outcomes = {
        name: [int(getattr(one, name)) for one in played]
        for name in ("start", "goal", "success", "steps")
    }
    low, high = cluster_interval(outcomes["success"], outcomes["start"], outcomes["goal"])
    origins = state_origins(task)
    return Result(
        policy=policy.policy,
        task=task.task,
        nx=task.nx,
        split=task.split,
        action=make_policy(policy).suited(task).action,
        episodes=len(played),
        successes=successes,
        success_rate=successes / len(played),
        low=low,
        high=high,
        steps=float(np.mean([one.steps for one in played if one.success])) if successes else None,
        mean_return=float(np.mean([one.total for one in played])),
        planned_actions=float(np.mean([one.planned_actions for one in played])),
        planning_seconds=float(np.mean([one.planning_seconds for one in played])),
        simulation_failures=sum(one.failed for one in played),
        start_states=origins["start"],
        goal_states=origins["goal"],
        outcomes=outcomes,
    )
