"""The commands `knotgym collect` and `knotgym evaluate`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    METADATA,
    BudgetOption,
    DepthOption,
    EngineOption,
    ExecutorOption,
    HoldOption,
    HorizonOption,
    ImageSizeOption,
    IntegratorStepsOption,
    MaxGoalsOption,
    NoiseOption,
    NxOption,
    OverwriteOption,
    PoliciesOption,
    PolicyOption,
    QuietOption,
    ResetNoiseOption,
    RestartOption,
    ResumeOption,
    SchedulerOption,
    SeedOption,
    SettingsOption,
    ShardOption,
    SharesOption,
    StatesOption,
    TowLimitOption,
    ViewsOption,
    WorkersOption,
    listed,
    numbers,
    option,
    run_options,
    with_settings,
    words,
)
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing

if TYPE_CHECKING:
    from knotgym.control.policies import PolicyConfig


def collect(
    task: Annotated[str, typer.Option(help="Task: tie, unknot or convert.")] = "tie",
    nx: NxOption = "2",
    policy: PolicyOption = "expert",
    episodes: Annotated[int, typer.Option(help="Episodes to play for each --nx.")] = 200,
    split: Annotated[
        str, typer.Option(help="Split of the states: train, test, train-code or test-code.")
    ] = "train",
    keep_failed: Annotated[
        bool,
        typer.Option(
            "--keep-failed/--drop-failed", help="Keep episodes that didn't reach the goal."
        ),
    ] = True,
    attempts: Annotated[
        int,
        typer.Option(help="Rollouts per episode; the shortest one that reaches the goal is kept."),
    ] = 1,
    labels: Annotated[
        str,
        typer.Option(
            help=(
                '"expert" stores the expert\'s action at every state, planned with --budget for'
                " each."
            ),
            show_default="none",
        ),
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="Minari root to write to; Minari's own by default.")
    ] = None,
    dataset_id: Annotated[
        str,
        typer.Option(
            "--id",
            help=(
                "Minari id; by default for example knotgym/tie-nx3/expert-v0, with a mark for each"
                " setting that changes the data, as in expert-state-seed1-v0."
            ),
        ),
    ] = "",
    states: StatesOption = None,
    observation: Annotated[
        str | None,
        option(
            "--observation",
            help=(
                "Observation to store, also the input of your functions and .pt models: pixels,"
                " state, both or symbolic. A .zip or .onnx model gets what it was trained on."
            ),
            group=ENVIRONMENT,
            show_default="both is stored, policies get state",
        ),
    ] = None,
    max_goals: MaxGoalsOption = None,
    image_size: ImageSizeOption = 128,
    views: ViewsOption = "top",
    depth: DepthOption = False,
    horizon: HorizonOption = 50,
    hold: HoldOption = 1,
    tow_limit: TowLimitOption = None,
    reset_noise: ResetNoiseOption = 0.015,
    engine: EngineOption = "mujoco",
    integrator_steps: IntegratorStepsOption = 24,
    noise: NoiseOption = 0.1,
    budget: BudgetOption = 20000,
    shares: SharesOption = "0.25,0.25,0.25,0.25",
    author: Annotated[
        list[str] | None,
        option("--author", help="Author of the dataset; may be repeated.", group=METADATA),
    ] = None,
    author_email: Annotated[
        list[str] | None,
        option("--author-email", help="Author's email; may be repeated.", group=METADATA),
    ] = None,
    code_permalink: Annotated[
        str | None,
        option("--code-permalink", help="URL of the code that made it.", group=METADATA),
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 0,
    executor: ExecutorOption = "local",
    scheduler: SchedulerOption = "",
    settings: SettingsOption = None,
    shard: ShardOption = "",
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Roll out a policy and write its episodes as a Minari dataset.

    Several values of --nx make one dataset each.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --task tie --policy pretrained --labels expert --budget 2000
    """
    with Progress(quiet) as progress:
        from knotgym.datasets.minari_dataset import loading_lines
        from knotgym.envs.tasks import TaskConfig
        from knotgym.generate.episodes.collect import (
            CollectConfig,
            distinct_id,
            require_collectable,
        )
        from knotgym.generate.episodes.collect import collect as run

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options, crossings = run_options(executor, scheduler, workers, shard, existing, quiet), nx
        if dataset_id and len(numbers(crossings)) > 1:
            raise typer.BadParameter(
                f"--id names one dataset, but --nx {nx} makes {len(numbers(crossings))}: leave out"
                " --id or give a single --nx"
            )
        acting = policy_config(policy, noise, budget, shares)
        tasks = [
            TaskConfig(
                task=task,
                nx=one,
                split=split,
                states=None if states is None else str(states),
                observation=observation or "both",
                max_goals=max_goals,
                image_size=image_size,
                views=listed(views),
                depth=depth,
                horizon=horizon,
                hold=hold,
                tow_limit=tow_limit,
                reset_noise=reset_noise,
                engine=engine,
                integrator_steps=integrator_steps,
            )
            for one in numbers(crossings)
        ]
        configs = [
            CollectConfig(
                task=one,
                policy=acting,
                episodes=episodes,
                seed=seed,
                keep_failed=keep_failed,
                attempts=attempts,
                labels=labels,
                seen="" if observation else "state",
                dataset_id=dataset_id,
                author=tuple(author or ()),
                author_email=tuple(author_email or ()),
                code_permalink=code_permalink,
            )
            for one in tasks
        ]
        for number, config in enumerate(configs):
            settled = with_settings(config, settings)
            if settled.dataset_id == config.dataset_id and not dataset_id:
                settled = replace(settled, dataset_id=distinct_id(settled))
            configs[number] = settled
        for config in configs:  # refuse any of them before playing the first
            require_collectable(config, out, options)
        for config in configs:
            run(config, out, options, progress=progress)
            if options.shard.is_whole:
                progress.say_how_to_load(loading_lines(config.dataset_id, out))


def evaluate(
    task: Annotated[
        str, typer.Option(help="Tasks, comma-separated: tie, unknot, convert.")
    ] = "tie",
    nx: Annotated[str, typer.Option("--nx", help="Numbers of crossings: 3, 2,3 or 2-4.")] = "2",
    policy: PoliciesOption = None,
    episodes: Annotated[
        int, typer.Option(help="Episodes for each policy, task, split and --nx.")
    ] = 256,
    split: Annotated[
        str, typer.Option(help="Splits, comma-separated: train, test, train-code, test-code.")
    ] = "test",
    out: Annotated[Path | None, typer.Option(help="JSON file to write.")] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Film of the first episodes of each setup: .gif, or with the extra video .mp4 or"
                " .webm."
            )
        ),
    ] = None,
    filmed: Annotated[int, typer.Option(min=0, help="Episodes per setup in the film.")] = 2,
    states: StatesOption = None,
    observation: Annotated[
        str,
        option(
            "--observation",
            help=(
                "Input of your functions and .pt models: pixels, state, both or symbolic. A .zip or"
                " .onnx model gets what it was trained on."
            ),
            group=ENVIRONMENT,
        ),
    ] = "state",
    max_goals: MaxGoalsOption = None,
    image_size: ImageSizeOption = 128,
    views: ViewsOption = "top",
    depth: DepthOption = False,
    horizon: HorizonOption = 50,
    hold: HoldOption = 1,
    tow_limit: TowLimitOption = None,
    reset_noise: ResetNoiseOption = 0.015,
    engine: EngineOption = "mujoco",
    integrator_steps: IntegratorStepsOption = 24,
    noise: NoiseOption = 0.1,
    budget: BudgetOption = 20000,
    shares: SharesOption = "0.25,0.25,0.25,0.25",
    seed: SeedOption = 0,
    workers: WorkersOption = 0,
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure the success rates of policies, with 95 % confidence intervals.

    Every combination of policy, task, split and number of crossings is one row.

    Examples:

        knotgym evaluate --task tie --nx 3 --policy random --episodes 256

        knotgym evaluate --policy random --policy mine:act --task tie,unknot --nx 2-4
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.envs.tasks import TaskConfig
        from knotgym.generate.episodes.evaluate import EvaluateConfig
        from knotgym.generate.episodes.evaluate import run as run_evaluation

        base = TaskConfig(
            task="tie",
            states=None if states is None else str(states),
            observation=observation,
            max_goals=max_goals,
            image_size=image_size,
            views=listed(views),
            depth=depth,
            horizon=horizon,
            hold=hold,
            tow_limit=tow_limit,
            reset_noise=reset_noise,
            engine=engine,
            integrator_steps=integrator_steps,
        )
        config = EvaluateConfig(
            policies=tuple(
                policy_config(one, noise, budget, shares) for one in policy or ["random"]
            ),
            tasks=words(task),
            nx=numbers(nx),
            splits=words(split),
            episodes=episodes,
            seed=seed,
            task=base,
            filmed=filmed if video else 0,
        )
        run_evaluation(
            config,
            workers=workers,
            out=out,
            video=video,
            quiet=quiet,
            console=progress.console,
            progress=progress,
            existing=Existing(resume=resume, restart=restart, overwrite=overwrite),
        )


def policy_config(policy: str, noise: float, budget: int, shares: str) -> PolicyConfig:
    """Build a policy's configuration from its options."""
    from knotgym.control.planner_config import PlannerConfig
    from knotgym.control.policies import PolicyConfig

    try:
        parts = tuple(float(word) for word in shares.split(","))
    except ValueError:
        raise typer.BadParameter(
            f"--shares takes four comma-separated numbers, got {shares!r}"
        ) from None
    return PolicyConfig(
        policy=policy, noise=noise, shares=parts, planner=PlannerConfig(budget=budget)
    )
