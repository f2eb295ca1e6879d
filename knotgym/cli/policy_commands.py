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
    task: Annotated[str, typer.Option(help="tie, unknot or convert.")] = "tie",
    nx: NxOption = "2",
    policy: PolicyOption = "expert",
    episodes: Annotated[int, typer.Option(help="Played, for each nx.")] = 200,
    split: Annotated[str, typer.Option(help="train, test, train-code or test-code.")] = "train",
    keep_failed: Annotated[
        bool,
        typer.Option(
            "--keep-failed/--drop-failed", help="Keep episodes that didn't reach the goal."
        ),
    ] = True,
    attempts: Annotated[
        int,
        typer.Option(
            help="Times each episode is played; the shortest that reached the goal is kept."
        ),
    ] = 1,
    labels: Annotated[
        str,
        typer.Option(
            help='"expert": store what it would do at every state, its --budget for each.',
            show_default="none",
        ),
    ] = "",
    out: Annotated[
        Path | None, typer.Option(help="Root of the dataset's id; Minari's own by default.")
    ] = None,
    dataset_id: Annotated[
        str,
        typer.Option(
            "--id",
            help=(
                "Minari id; by default knotgym/tie-nx3/expert-v0 and the like, with a mark for each"
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
                "Stored, and seen by your functions and .pt models: pixels, state, both or"
                " symbolic. A .zip or .onnx model sees what it was trained on."
            ),
            group=ENVIRONMENT,
            show_default="both is stored, state is seen",
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
    integrator_steps: IntegratorStepsOption = 24,
    noise: NoiseOption = 0.1,
    budget: BudgetOption = 20000,
    shares: SharesOption = "0.25,0.25,0.25,0.25",
    author: Annotated[
        list[str] | None, option("--author", help="May be repeated.", group=METADATA)
    ] = None,
    author_email: Annotated[
        list[str] | None, option("--author-email", help="May be repeated.", group=METADATA)
    ] = None,
    code_permalink: Annotated[
        str | None,
        option("--code-permalink", help="Where the code can be seen.", group=METADATA),
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    settings: SettingsOption = None,
    shard: ShardOption = "",
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Play a policy's episodes and write them as a Minari dataset.

    Several --nx make a dataset each.

    Examples:

        knotgym collect --task tie --nx 3 --policy expert --episodes 200

        knotgym collect --task unknot --nx 2-4 --policy mine:act

        knotgym collect --task tie --policy pretrained --labels expert --budget 2000
    """
    with Progress(quiet) as progress:
        from knotgym.datasets.minari_dataset import loading_lines
        from knotgym.generate.episodes.collect import (
            CollectConfig,
            distinct_id,
            require_collectable,
        )
        from knotgym.generate.episodes.collect import collect as run
        from knotgym.tasks import TaskConfig

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options, crossings = run_options(engine, scheduler, workers, shard, existing, quiet), nx
        if dataset_id and len(numbers(crossings)) > 1:
            raise typer.BadParameter(
                f"--id names one dataset, and --nx {nx} makes {len(numbers(crossings))}: leave out"
                " --id, or give one nx"
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
        for config in configs:  # all of them before the first is played
            require_collectable(config, out, options)
        for config in configs:
            run(config, out, options, progress=progress)
            if options.shard.is_whole:
                progress.say_how_to_load(loading_lines(config.dataset_id, out))


def evaluate(
    task: Annotated[
        str, typer.Option(help="tie, unknot, convert, or several with commas.")
    ] = "tie",
    nx: Annotated[
        str, typer.Option("--nx", help="Crossings: 3, or 2,3, or 2-4; several make the matrix.")
    ] = "2",
    policy: PoliciesOption = None,
    episodes: Annotated[int, typer.Option(help="For each policy, task, split and nx.")] = 256,
    split: Annotated[
        str, typer.Option(help="train, test, train-code, test-code; several with commas.")
    ] = "test",
    out: Annotated[Path | None, typer.Option(help="JSON to write.")] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Film of the first episodes of each setup: .webm or .gif, or .mp4 with the extra"
                " video."
            )
        ),
    ] = None,
    filmed: Annotated[int, typer.Option(min=0, help="Episodes of each setup in the film.")] = 2,
    states: StatesOption = None,
    observation: Annotated[
        str,
        option(
            "--observation",
            help=(
                "What your functions and .pt models see: pixels, state, both or symbolic. A .zip or"
                " .onnx model sees what it was trained on."
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
    """Measure success rates, with 95 % intervals.

    Of policies by tasks, splits and numbers of crossings.

    Examples:

        knotgym evaluate --task tie --nx 3 --policy random --episodes 256

        knotgym evaluate --policy random --policy mine:act --task tie,unknot --nx 2-4
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.generate.episodes.evaluate import EvaluateConfig
        from knotgym.generate.episodes.evaluate import run as run_evaluation
        from knotgym.tasks import TaskConfig

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
    """What the options of a policy say."""
    from knotgym.control.planner_config import PlannerConfig
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
