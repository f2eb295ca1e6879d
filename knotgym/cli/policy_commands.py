"""The commands `knotgym collect` and `knotgym evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from knotgym.cli.options import (
    EngineOption,
    ResumeOption,
    SchedulerOption,
    SettingsOption,
    ShardOption,
    numbers,
    run_options,
    with_settings,
)

if TYPE_CHECKING:
    from knotgym.control.policies import PolicyConfig

_POLICIES = (
    "random, constant, scripted, expert, noisy-expert, mixed, module:function, or a .zip (SB3),"
    " .onnx or .pt file."
)

Policy = Annotated[str, typer.Option("--policy", help=_POLICIES)]
States = Annotated[
    Path | None,
    typer.Option(help="readable (default) or random-walk, which ship, or a state file."),
]
Observation = Annotated[str, typer.Option(help="pixels, state, both or symbolic.")]
Views = Annotated[
    str, typer.Option(help="Views in the picture, with commas: of top, left and front.")
]
Depth = Annotated[bool, typer.Option("--depth", help="Depth as a fourth channel of the picture.")]
Horizon = Annotated[int, typer.Option(help="Steps until truncation.")]
Hold = Annotated[int, typer.Option(help="Consecutive steps the goal code must show.")]
TowLimit = Annotated[
    float | None,
    typer.Option(help="Metres that the rope's centre may be towed; no bound by default."),
]
ResetNoise = Annotated[
    float, typer.Option(help="Scale of the noise at reset, radians per joint and metres.")
]
IntegratorSteps = Annotated[
    int,
    typer.Option(help="MuJoCo steps in an action; 20 are faster, on slightly other trajectories."),
]
Noise = Annotated[float, typer.Option(help="Chance that a noisy expert's pull is a random one.")]
Budget = Annotated[int, typer.Option(help="Actions that an expert may simulate for an episode.")]
Shares = Annotated[str, typer.Option(help="Of random, scripted, noisy-expert and expert in mixed.")]
Seed = Annotated[int, typer.Option(help="Of everything; the same seed gives the same bytes.")]
Workers = Annotated[
    int, typer.Option(help="Processes; 0 for one a core. Does not change the result.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but errors.")]


def collect(
    task: Annotated[str, typer.Option(help="tie, unknot or convert.")] = "tie",
    nx: Annotated[int, typer.Option("--nx", help="Crossings of the tangled side.")] = 2,
    policy: Policy = "expert",
    episodes: Annotated[int, typer.Option(help="Played.")] = 200,
    split: Annotated[str, typer.Option(help="train or test.")] = "train",
    states: States = None,
    observation: Observation = "both",
    image_size: Annotated[int, typer.Option(help="Pixels, each half of the picture.")] = 128,
    views: Views = "top",
    depth: Depth = False,
    horizon: Horizon = 50,
    hold: Hold = 1,
    tow_limit: TowLimit = None,
    reset_noise: ResetNoise = 0.015,
    integrator_steps: IntegratorSteps = 24,
    noise: Noise = 0.1,
    budget: Budget = 20000,
    shares: Shares = "0.25,0.25,0.25,0.25",
    keep_failed: Annotated[
        bool,
        typer.Option(
            "--keep-failed/--drop-failed", help="Keep episodes that didn't reach the goal."
        ),
    ] = True,
    out: Annotated[
        Path | None, typer.Option(help="Root of the dataset's id; Minari's own by default.")
    ] = None,
    dataset_id: Annotated[
        str,
        typer.Option("--id", help="Minari id; knotgym/tie-nx3/expert-v0 and the like by default."),
    ] = "",
    author: Annotated[
        list[str] | None, typer.Option(help="For the metadata; may be repeated.")
    ] = None,
    author_email: Annotated[
        list[str] | None, typer.Option(help="For the metadata; may be repeated.")
    ] = None,
    code_permalink: Annotated[str | None, typer.Option(help="For the metadata.")] = None,
    seed: Seed = 0,
    workers: Workers = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    settings: SettingsOption = None,
    shard: ShardOption = "",
    resume: ResumeOption = False,
    quiet: Quiet = False,
) -> None:
    """Play a policy's episodes and write them as a Minari dataset."""
    from knotgym.generate.episodes.collect import CollectConfig
    from knotgym.generate.episodes.collect import collect as run
    from knotgym.tasks import TaskConfig

    options = run_options(engine, scheduler, workers, shard, resume, quiet)
    config = CollectConfig(
        task=TaskConfig(
            task=task,
            nx=nx,
            split=split,
            states=None if states is None else str(states),
            observation=observation,
            image_size=image_size,
            views=_listed(views),
            depth=depth,
            horizon=horizon,
            hold=hold,
            tow_limit=tow_limit,
            reset_noise=reset_noise,
            integrator_steps=integrator_steps,
        ),
        policy=policy_config(policy, noise, budget, shares),
        episodes=episodes,
        seed=seed,
        keep_failed=keep_failed,
        dataset_id=dataset_id,
        author=tuple(author or ()),
        author_email=tuple(author_email or ()),
        code_permalink=code_permalink,
    )
    run(with_settings(config, settings), out, options)


def evaluate(
    task: Annotated[
        str, typer.Option(help="tie, unknot, convert, or several with commas.")
    ] = "tie",
    nx: Annotated[
        str, typer.Option("--nx", help="Crossings: 3, or 2,3, or 2-4; several make the matrix.")
    ] = "2",
    policy: Annotated[
        list[str] | None, typer.Option("--policy", help=f"{_POLICIES} May be repeated.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="For each policy, task, split and nx.")] = 256,
    split: Annotated[str, typer.Option(help="train, test, or both with a comma.")] = "test",
    states: States = None,
    observation: Annotated[
        str, typer.Option(help="What models and functions see: pixels, state, both or symbolic.")
    ] = "state",
    views: Views = "top",
    depth: Depth = False,
    horizon: Horizon = 50,
    hold: Hold = 1,
    tow_limit: TowLimit = None,
    reset_noise: ResetNoise = 0.015,
    integrator_steps: IntegratorSteps = 24,
    noise: Noise = 0.1,
    budget: Budget = 20000,
    shares: Shares = "0.25,0.25,0.25,0.25",
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Film of the first episodes of each setup, .mp4 or .gif.")
    ] = None,
    filmed: Annotated[int, typer.Option(help="Episodes of each setup in the film.")] = 2,
    seed: Seed = 0,
    workers: Workers = 0,
    quiet: Quiet = False,
) -> None:
    """Measure success rates with 95 % intervals: policies by tasks, splits and numbers of
    crossings.
    """
    from knotgym.generate.episodes.evaluate import EvaluateConfig
    from knotgym.generate.episodes.evaluate import run as run_evaluation
    from knotgym.tasks import TaskConfig

    base = TaskConfig(
        task="tie",
        states=None if states is None else str(states),
        observation=observation,
        views=_listed(views),
        depth=depth,
        horizon=horizon,
        hold=hold,
        tow_limit=tow_limit,
        reset_noise=reset_noise,
        integrator_steps=integrator_steps,
    )
    config = EvaluateConfig(
        policies=tuple(policy_config(one, noise, budget, shares) for one in policy or ["random"]),
        tasks=_words(task),
        nx=numbers(nx),
        splits=_words(split),
        episodes=episodes,
        seed=seed,
        task=base,
        filmed=filmed if video else 0,
    )
    run_evaluation(config, workers=workers, out=out, video=video, quiet=quiet, console=Console())


def policy_config(policy: str, noise: float, budget: int, shares: str) -> PolicyConfig:
    """What the options of a policy say."""
    from knotgym.control.planner import PlannerConfig
    from knotgym.control.policies import PolicyConfig

    try:
        parts = tuple(float(word) for word in shares.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"--shares takes four numbers with commas, got {shares!r}"
        ) from None
    return PolicyConfig(
        policy=policy, noise=noise, shares=parts, planner=PlannerConfig(budget=budget)
    )


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(_listed(text)))


def _listed(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))
