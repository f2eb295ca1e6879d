"""The command `knotgym suite`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    ENVIRONMENT,
    BudgetOption,
    EngineOption,
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
        str, typer.Option(help="Of unknot, tie and convert, with commas.")
    ] = "unknot,tie,convert",
    nx: Annotated[str, typer.Option("--nx", help="Crossings, of 2 to 4: 3, or 2,3.")] = "2-4",
    policies: Annotated[
        str, typer.Option(help="Of random, scripted, noisy-expert and expert, with commas.")
    ] = "random,scripted,noisy-expert,expert",
    states: Annotated[
        str,
        option("--states", help="Of readable and random-walk, with commas.", group=ENVIRONMENT),
    ] = "readable,random-walk",
    episodes: Annotated[
        str,
        typer.Option(
            help=(
                "Of each set: 100, or by policy expert=3000,random=100; those not named keep their"
                " size."
            ),
            show_default="random=250,scripted=500,noisy-expert=150,expert=1000",
        ),
    ] = "",
    observation: ObservationOption = "state",
    budget: BudgetOption = 1000,
    out: Annotated[
        Path | None, typer.Option(help="Root of the datasets' ids; Minari's own by default.")
    ] = None,
    scores: Annotated[
        list[Path] | None,
        typer.Option(
            help=(
                "File of `knotgym evaluate --out` for the card's table of results, beside those in"
                " the folder `evaluations` beside the card; may be repeated."
            )
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            help=(
                "Of every set. Not 0, with which `evaluate` begins: on the train split its"
                " episodes would begin as those of the sets."
            )
        ),
    ] = 1,
    workers: WorkersOption = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    resume: ResumeOption = False,
    restart: RestartOption = False,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make the fixed benchmark, or a part of it.

    For each of nine set-ups the episodes of four policies, on two sets of states, of the train
    split; and a card over all of them. It says first how long that takes. With --resume, sets that
    are finished are left alone and the rest is made.

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
            observation=observation,
            budget=budget,
            seed=seed,
        )
        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options = run_options(engine, scheduler, workers, "", existing, quiet)
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
            f"--episodes takes a number, or expert=3000,random=100 and the like; got {text!r}"
        )
    return {name: int(count) for name, _, count in pairs}
