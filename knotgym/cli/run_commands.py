"""The commands `knotgym generate` and `knotgym images`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    EngineOption,
    NxOption,
    OverwriteOption,
    QuietOption,
    RestartOption,
    ResumeOption,
    SchedulerOption,
    SeedOption,
    SettingsOption,
    ShardOption,
    WorkersOption,
    code_list,
    default_folder,
    made_from,
    numbers,
    option,
    run_options,
    with_settings,
)
from knotgym.runs.progress import Progress
from knotgym.runs.run_options import Existing

_CHOICE, _SEARCH, _SPLITS = "Which states", "The search", "Splits"


def generate(
    nx: Annotated[
        str | None,
        typer.Option(
            "--nx",
            help="Crossings: 3, or 2,3, or 0-4.",
            show_default="3; with --knot as few as that knot can have",
        ),
    ] = None,
    count: Annotated[
        int,
        typer.Option(
            help="States for each number of crossings, of as many different codes as there are."
        ),
    ] = 40,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to make; knotgym-data/nx3 for --nx 3, nx3-3_1 of that knot."),
    ] = None,
    source: Annotated[
        str,
        option(
            "--source",
            help=(
                '"drawing": states are drawn from their Gauss codes, and legible ones that play'
                ' met come first; "random-walk": states as uniform random actions meet them, only'
                " over-twisted ones left out, without demonstrations."
            ),
            group=_CHOICE,
        ),
    ] = "drawing",
    demonstrations: Annotated[
        bool,
        option(
            "--demonstrations/--no-demonstrations",
            help=(
                "Find an action sequence from the start to the code of every state, by play and"
                " the planner, and write them as Minari datasets. To 6 crossings."
            ),
            group=_CHOICE,
        ),
    ] = True,
    every_code: Annotated[
        int,
        option(
            "--every-code",
            help="Instead of --count: so many states of every code there is.",
            group=_CHOICE,
        ),
    ] = 0,
    split_by: Annotated[
        str,
        option(
            "--split-by",
            help='"state", or "code": train and test share no code.',
            group=_CHOICE,
        ),
    ] = "state",
    knot: Annotated[
        str,
        option(
            "--knot",
            help=(
                "Knot of the rope: 0_1, a prime knot of up to 10 crossings (8_19), a mirror image"
                " (m3_1), or a sum (3_1#4_1); or a file with a closed curve, three numbers a line"
                " or .npy, where action sequences then begin."
            ),
            group=_CHOICE,
        ),
    ] = "0_1",
    codes: Annotated[
        Path | None,
        option(
            "--codes",
            help=(
                "A file of Gauss codes, one a line, to make states of instead of those of --nx;"
                " --every-code says how many of each, 1 if not given."
            ),
            group=_CHOICE,
        ),
    ] = None,
    archive: Annotated[
        Path | None,
        option(
            "--archive",
            help="Begin with the action sequences of another run (its archive.h5).",
            group=_SEARCH,
        ),
    ] = None,
    attempts: Annotated[
        int,
        option(
            "--attempts",
            help=(
                "Drawings for each state wanted of a code, before the code is passed over; ropes"
                " walked for each state wanted of a random walk."
            ),
            group=_SEARCH,
        ),
    ] = 100,
    cycles: Annotated[
        int,
        option(
            "--cycles",
            help="Stop after so many waves of work, with what there is; 0: when all is there.",
            group=_SEARCH,
        ),
    ] = 0,
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
    """Make rope states, split into train and test, and demonstrations that reach their codes.

    Examples:

        knotgym generate --nx 3 --count 40

        knotgym generate --nx 4 --every-code 1

        knotgym generate --nx 7 --count 20 --no-demonstrations

        knotgym generate --knot 8_19 --count 4

        knotgym generate --nx 2-4 --source random-walk
    """
    with Progress(quiet) as progress:
        from knotgym.datasets.minari_dataset import loading_lines
        from knotgym.generate.states.generate_config import GenerateConfig
        from knotgym.generate.states.random_walk import RandomWalkConfig
        from knotgym.generate.states.random_walk_recipe import walk_states
        from knotgym.generate.states.state_recipe import generate as run
        from knotgym.topology.knot_table import UNKNOT, diagram_of

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options = run_options(engine, scheduler, workers, shard, existing, quiet)
        if source not in ("drawing", "random-walk"):
            raise typer.BadParameter(f"--source takes drawing or random-walk, got {source!r}")
        if nx is None:
            named = knot != UNKNOT and not Path(knot).is_file()
            nx = str(diagram_of(knot).nx) if named else "3"
        folder = out or default_folder(
            f"nx{nx}",
            "" if source == "drawing" else source,
            "" if knot == "0_1" else Path(knot).stem,
            f"every{every_code}" if every_code else "",
            "" if split_by == "state" else f"by-{split_by}",
            Path(codes).stem if codes else "",
            "" if demonstrations else "states",
            made_from(archive),
            f"seed{seed}" if seed else "",
        )
        if source == "random-walk":
            for name, given in {
                "--every-code": every_code != 0,
                "--split-by": split_by != "state",
                "--knot": knot != "0_1",
                "--codes": codes is not None,
                "--archive": archive is not None,
                "--cycles": cycles != 0,
            }.items():
                if given:
                    raise typer.BadParameter(f"{name} goes with --source drawing, not random-walk")
            walks = RandomWalkConfig(nx=numbers(nx), count=count, seed=seed, attempts=attempts)
            walk_states(with_settings(walks, settings), folder, options, progress=progress)
            return
        if archive is not None and not demonstrations:
            raise typer.BadParameter("--archive holds action sequences; drop --no-demonstrations")
        listed_codes = code_list(codes)
        config = GenerateConfig(
            nx=tuple(dict.fromkeys(code.nx for code in listed_codes)) or numbers(nx),
            codes=tuple(
                str(code) if code.chirality is None else code.chiral for code in listed_codes
            ),
            count=count,
            every_code=every_code or int(bool(listed_codes)),
            split_by=split_by,
            knot=knot,
            demonstrations=demonstrations,
            seed=seed,
            attempts=attempts,
            cycles=cycles,
        )
        run(with_settings(config, settings), folder, options, archive=archive, progress=progress)
        root = options.shard.folder(folder) / "minari"
        for dataset in sorted(root.glob("knotgym/*/demonstrations-v0"))[-1:]:
            shown = dataset.relative_to(root).as_posix()
            progress.say_how_to_load(loading_lines(shown, root))


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
        str,
        option(
            "--test-nx",
            help="Crossings that only split test-nx shows; the largest, or none.",
            group=_SPLITS,
        ),
    ] = "largest",
    test_share: Annotated[
        float, option("--test-share", help="Share of split test.", group=_SPLITS)
    ] = 0.15,
    code_share: Annotated[
        float,
        option(
            "--code-share",
            help="Share of split test-code, and of codes that only it shows.",
            group=_SPLITS,
        ),
    ] = 0.15,
    vary: Annotated[
        str, typer.Option(help="Of colours,width,background,turn,zoom,noise,blur; all, or none.")
    ] = "none",
    size: Annotated[
        str,
        typer.Option(help="Pixels of a side, 64 to 512; several, such as 64,128, are drawn from."),
    ] = "128",
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
    """Make labelled pictures.

    Of each the Gauss code, the crossings, the rope's coordinates and how hard it is to read.
    Needs the extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128
    """
    with Progress(quiet) as progress:
        from knotgym.generate.images.image_recipe import make_images
        from knotgym.generate.images.images_config import ImagesConfig
        from knotgym.rendering.appearance import VARIED, AppearanceConfig

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options = run_options(engine, scheduler, workers, shard, existing, quiet)
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
        folder = out or default_folder(
            f"images-nx{nx}",
            made_from(archive or states),
            "varied" if varied else "",
            "" if size == "128" else f"{size}px",
            f"seed{seed}" if seed else "",
        )
        make_images(
            with_settings(config, settings),
            folder,
            options,
            archive=archive,
            states=states,
            progress=progress,
        )
