"""The commands `knotgym generate` and `knotgym images`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    EngineOption,
    NxOption,
    QuietOption,
    ResumeOption,
    SchedulerOption,
    SeedOption,
    SettingsOption,
    ShardOption,
    WorkersOption,
    code_list,
    numbers,
    run_options,
    with_settings,
)


def generate(
    nx: NxOption = "3",
    count: Annotated[
        int,
        typer.Option(
            help="States for each number of crossings, of as many different codes as there are."
        ),
    ] = 40,
    out: Annotated[
        Path | None, typer.Option(help="Folder to make; knotgym-data/nx3 for --nx 3.")
    ] = None,
    source: Annotated[
        str,
        typer.Option(
            help=(
                '"play": searched and opened up, with the trajectories; "random-walk": saved from'
                " uniform random actions, only over-twisted states left out;"
                ' "drawing": drawn from the codes themselves, quick at any nx, no trajectories.'
            )
        ),
    ] = "play",
    every_code: Annotated[
        int, typer.Option(help="Instead of --count: so many states of every code there is.")
    ] = 0,
    balance: Annotated[
        str,
        typer.Option(
            help='"even" over codes, or "empirical": as often as a random policy meets them.'
        ),
    ] = "even",
    split_by: Annotated[
        str, typer.Option(help='"state", or "code": train and test share no code.')
    ] = "state",
    knot: Annotated[
        str,
        typer.Option(
            help="0_1, 3_1, 4_1, 5_1, or a file with a closed curve, three numbers a line or .npy."
        ),
    ] = "0_1",
    codes: Annotated[
        Path | None,
        typer.Option(
            help=(
                "With --source drawing: a file of Gauss codes, one a line, that are drawn instead"
                " of those of --nx; --every-code says how often, 1 if not given."
            )
        ),
    ] = None,
    archive: Annotated[
        Path | None, typer.Option(help="Go on from the archive of another run (its archive.h5).")
    ] = None,
    attempts: Annotated[
        int,
        typer.Option(
            help="Candidates tried, or ropes walked, for each state wanted, before giving up."
        ),
    ] = 100,
    cycles: Annotated[
        int,
        typer.Option(
            help=(
                "Stop after so many rounds of searching and choosing, with what there is; 0: when"
                " all is there."
            )
        ),
    ] = 0,
    settings: SettingsOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    shard: ShardOption = "",
    resume: ResumeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make states, split into train and test: curated, with the trajectories that reach them, or as
    random play meets them.
    """
    from knotgym.generate.states.drawn_states import DrawnStatesConfig
    from knotgym.generate.states.drawn_states_recipe import draw_state_set
    from knotgym.generate.states.generate_config import GenerateConfig
    from knotgym.generate.states.random_walk import RandomWalkConfig
    from knotgym.generate.states.random_walk_recipe import walk_states
    from knotgym.generate.states.state_recipe import generate as run

    options = run_options(engine, scheduler, workers, shard, resume, quiet)
    folder = out or Path("knotgym-data") / f"nx{nx.replace(' ', '')}"
    if source not in ("play", "random-walk", "drawing"):
        raise typer.BadParameter(f"--source takes play, random-walk or drawing, got {source!r}")
    if source == "drawing":
        for option, given in {
            "--balance": balance != "even",
            "--archive": archive is not None,
        }.items():
            if given:
                raise typer.BadParameter(f"{option} goes with --source play, not with drawing")
        listed = code_list(codes)
        drawings = DrawnStatesConfig(
            nx=tuple(dict.fromkeys(code.nx for code in listed)) or numbers(nx),
            codes=tuple(str(code) if code.chirality is None else code.chiral for code in listed),
            count=count,
            every_code=every_code or int(bool(listed)),
            split_by=split_by,
            knot=knot,
            seed=seed,
            attempts=attempts,
            cycles=cycles,
        )
        draw_state_set(with_settings(drawings, settings), folder, options)
        return
    if codes is not None:
        raise typer.BadParameter(f"--codes goes with --source drawing, not with {source}")
    if source == "random-walk":
        for option, given in {
            "--every-code": every_code != 0,
            "--balance": balance != "even",
            "--split-by": split_by != "state",
            "--knot": knot != "0_1",
            "--archive": archive is not None,
            "--cycles": cycles != 0,
        }.items():
            if given:
                raise typer.BadParameter(f"{option} goes with --source play, not with random-walk")
        walks = RandomWalkConfig(nx=numbers(nx), count=count, seed=seed, attempts=attempts)
        walk_states(with_settings(walks, settings), folder, options)
        return
    config = GenerateConfig(
        nx=numbers(nx),
        count=count,
        every_code=every_code,
        balance=balance,
        split_by=split_by,
        knot=knot,
        seed=seed,
        attempts=attempts,
        cycles=cycles,
    )
    run(with_settings(config, settings), folder, options, archive=archive)


def images(
    nx: NxOption = "0-4",
    count: Annotated[
        int, typer.Option(help="Pictures in all, evenly over the numbers of crossings.")
    ] = 20_000,
    out: Annotated[
        Path | None, typer.Option(help="Folder to make; knotgym-data/images-nx0-4 for --nx 0-4.")
    ] = None,
    archive: Annotated[
        Path | None, typer.Option(help="Set out from the archive of a run (its archive.h5).")
    ] = None,
    states: Annotated[
        Path | None,
        typer.Option(help="Set out from a states.h5; without either, from the states that ship."),
    ] = None,
    test_nx: Annotated[
        str, typer.Option(help="Crossings that only split test-nx shows; the largest, or none.")
    ] = "largest",
    test_share: Annotated[float, typer.Option(help="Share of split test.")] = 0.15,
    code_share: Annotated[
        float, typer.Option(help="Share of split test-code, and of codes that only it shows.")
    ] = 0.15,
    vary: Annotated[
        str, typer.Option(help="Of colours,width,background,turn,zoom,noise,blur; all, or none.")
    ] = "none",
    size: Annotated[
        str,
        typer.Option(help="Pixels of a side, 64 to 512; several, such as 64,128, are drawn from."),
    ] = "128",
    settings: SettingsOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 0,
    engine: EngineOption = "local",
    scheduler: SchedulerOption = "",
    shard: ShardOption = "",
    resume: ResumeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make a perception dataset: pictures with Gauss code, crossings, coordinates and
    difficulty.
    """
    from knotgym.generate.images.image_recipe import make_images
    from knotgym.generate.images.images_config import ImagesConfig
    from knotgym.rendering.appearance import VARIED, AppearanceConfig

    options = run_options(engine, scheduler, workers, shard, resume, quiet)
    sizes = size.split(",")
    if not all(pixels.strip().isdecimal() for pixels in sizes):
        raise typer.BadParameter(f"--size takes pixels such as 128 or 64,128, got {size!r}")
    varied: tuple[str, ...] = VARIED if vary == "all" else ()
    if vary not in ("all", "none"):
        varied = tuple(word.strip() for word in vary.split(","))
    held_nx: tuple[int, ...] | None = None if test_nx == "largest" else ()
    if test_nx not in ("largest", "none"):
        held_nx = numbers(test_nx)
    config = ImagesConfig(
        nx=numbers(nx),
        count=count,
        test_nx=held_nx,
        test_share=test_share,
        code_share=code_share,
        seed=seed,
        appearance=AppearanceConfig(vary=varied, sizes=tuple(map(int, sizes))),
    )
    folder = out or Path("knotgym-data") / f"images-nx{nx.replace(' ', '')}"
    make_images(with_settings(config, settings), folder, options, archive=archive, states=states)
