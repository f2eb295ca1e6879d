"""The command `knotgym suite`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    BudgetOption,
    EngineOption,
    ExecutorOption,
    ObservationOption,
    OverwriteOption,
    QuietOption,
    RestartOption,
    ResumeOption,
    SchedulerOption,
    WorkersOption,
    numbers,
    option,
    run_options,
    words,
)
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing


def suite(
    task: Annotated[
        str, typer.Option(help="Tasks, comma-separated: unknot, tie, convert.")
    ] = "unknot,tie,convert",
    nx: Annotated[
        str, typer.Option("--nx", help="Numbers of crossings, from 2 to 4: 3 or 2,3.")
    ] = "2-4",
    policies: Annotated[
        str,
        typer.Option(help="Policies, comma-separated: random, scripted, noisy-expert, expert."),
    ] = "random,scripted,noisy-expert,expert",
    states: Annotated[
        str,
        option(
            "--states",
            help="Sets of states, comma-separated: readable, random-walk.",
            group=ENVIRONMENT,
        ),
    ] = "readable,random-walk",
    episodes: Annotated[
        str,
        typer.Option(
            help=(
                "Episodes per dataset: 100 for all, or expert=3000,random=100 by policy; others"
                " keep their default."
            ),
            show_default="random=250,scripted=500,noisy-expert=150,expert=1000",
        ),
    ] = "",
    engine: EngineOption = "mujoco",
    observation: ObservationOption = "state",
    budget: BudgetOption = 1000,
    out: Annotated[
        Path | None, typer.Option(help="Minari root to write to; Minari's own by default.")
    ] = None,
    scores: Annotated[
        list[Path] | None,
        typer.Option(
            help=(
                "Results of `knotgym evaluate --out` to add to the card's table, besides those in"
                " the folder `evaluations` next to the card; may be repeated."
            )
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            help=(
                "Random seed of every dataset. Not 0, the default of `evaluate`, whose episodes on"
                " the train split would then start like those of the datasets."
            )
        ),
    ] = 1,
    workers: WorkersOption = 0,
    executor: ExecutorOption = "local",
    scheduler: SchedulerOption = "",
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Collect the fixed benchmark of offline datasets, or a part of it.

    It has episodes of four policies for each of nine setups, on the train split of two sets of
    states, and one card for all. The expected time is printed first. With --resume, finished
    datasets are kept and the others are collected.

    Examples:

        knotgym suite --resume

        knotgym suite --task tie --nx 3 --states readable --policies expert,random --resume
    """
    with Progress(quiet) as progress:
        from knotgym.generate.episodes.suite import SuiteConfig, make_suite

        config = SuiteConfig(
            tasks=words(task),
            nx=numbers(nx),
            policies=words(policies),
            states=words(states),
            episodes=_sizes(episodes, words(policies)),
            engine=engine,
            observation=observation,
            budget=budget,
            seed=seed,
        )
        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options = run_options(executor, scheduler, workers, "", existing, quiet)
        make_suite(config, out, options, scores=tuple(scores or ()), progress=progress)


def _sizes(text: str, policies: tuple[str, ...]) -> dict[str, int]:
    """Read "100", for every policy, or "expert=3000,random=100".

    >>> _sizes("100", ("random", "expert"))
    {'random': 100, 'expert': 100}
    """
    if not text:
        return {}
    pairs = [word.partition("=") for word in words(text)]
    if len(pairs) == 1 and not pairs[0][1]:
        pairs = [(policy, "=", pairs[0][0]) for policy in policies]
    if not all(name and count.isdecimal() and len(count) < 10 for name, _, count in pairs):
        raise typer.BadParameter(
            f"--episodes takes a number, or one per policy (expert=3000,random=100); got {text!r}"
        )
    return {name: int(count) for name, _, count in pairs}
