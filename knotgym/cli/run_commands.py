"""The commands `knotgym generate` and `knotgym images`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import (
    EngineOption,
    ExecutorOption,
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
            help="Numbers of crossings: 3, 2,3 or 0-4.",
            show_default="3, or with --knot the crossing number of that knot",
        ),
    ] = None,
    count: Annotated[
        int,
        typer.Option(
            help="States per number of crossings, spread over as many Gauss codes as possible."
        ),
    ] = 40,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder to write; by default knotgym-data/nx3, or nx3-3_1 with --knot 3_1."
        ),
    ] = None,
    source: Annotated[
        str,
        option(
            "--source",
            help=(
                '"drawing": draw states from their Gauss codes, after readable states found by'
                ' simulated play; "random-walk": take states from uniform random actions, without'
                " over-twisted ones and without demonstrations."
            ),
            group=_CHOICE,
        ),
    ] = "drawing",
    demonstrations: Annotated[
        bool,
        option(
            "--demonstrations/--no-demonstrations",
            help=(
                "Search for an action sequence that reaches the Gauss code of every state, and"
                " write the sequences as Minari datasets. Up to 6 crossings."
            ),
            group=_CHOICE,
        ),
    ] = True,
    every_code: Annotated[
        int,
        option(
            "--every-code",
            help="Instead of --count: number of states for every existing Gauss code.",
            group=_CHOICE,
        ),
    ] = 0,
    split_by: Annotated[
        str,
        option(
            "--split-by",
            help='"state" or "code"; with "code", train and test share no Gauss code.',
            group=_CHOICE,
        ),
    ] = "state",
    knot: Annotated[
        str,
        option(
            "--knot",
            help=(
                "Knot type of the rope: 0_1, a prime knot of up to 10 crossings (8_19), a mirror"
                " image (m3_1) or a sum (3_1#4_1); or a file with a closed curve, as .npy or three"
                " numbers per line, from which action sequences start."
            ),
            group=_CHOICE,
        ),
    ] = "0_1",
    codes: Annotated[
        Path | None,
        option(
            "--codes",
            help=(
                "File of Gauss codes, one per line, to use instead of --nx; --every-code gives the"
                " number of states per code, 1 by default."
            ),
            group=_CHOICE,
        ),
    ] = None,
    archive: Annotated[
        Path | None,
        option(
            "--archive",
            help="Start from the action sequences of another run (its archive.h5).",
            group=_SEARCH,
        ),
    ] = None,
    attempts: Annotated[
        int,
        option(
            "--attempts",
            help=(
                "Drawings per requested state before a Gauss code is skipped; with random-walk,"
                " walks per requested state."
            ),
            group=_SEARCH,
        ),
    ] = 100,
    cycles: Annotated[
        int,
        option(
            "--cycles",
            help="Stop after this many rounds of work and keep the states made; 0 for no limit.",
            group=_SEARCH,
        ),
    ] = 0,
    engine: EngineOption = "mujoco",
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
    """Generate rope states with train and test splits, and demonstrations of their Gauss codes.

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
        options = run_options(executor, scheduler, workers, shard, existing, quiet)
        if source not in ("drawing", "random-walk"):
            raise typer.BadParameter(f"--source takes drawing or random-walk, got {source!r}")
        if nx is None:
            is_table_name = knot != UNKNOT and not Path(knot).is_file()
            nx = str(diagram_of(knot).nx) if is_table_name else "3"
        folder = out or default_folder(
            f"nx{nx}",
            "" if source == "drawing" else source,
            "" if knot == "0_1" else Path(knot).stem,
            f"every{every_code}" if every_code else "",
            "" if split_by == "state" else f"by-{split_by}",
            Path(codes).stem if codes else "",
            "" if demonstrations else "states",
            "" if engine == "mujoco" else engine,
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
                    raise typer.BadParameter(f"{name} needs --source drawing, not random-walk")
            walks = RandomWalkConfig(
                nx=numbers(nx), count=count, engine=engine, seed=seed, attempts=attempts
            )
            walk_states(with_settings(walks, settings), folder, options, progress=progress)
            return
        if archive is not None and not demonstrations:
            raise typer.BadParameter(
                "--archive provides action sequences; remove --no-demonstrations"
            )
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
            engine=engine,
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
        int, typer.Option(help="Total pictures, spread evenly over the numbers of crossings.")
    ] = 20_000,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write; by default knotgym-data/images-nx0-4 for --nx 0-4."),
    ] = None,
    archive: Annotated[
        Path | None, typer.Option(help="Start from the states in a run's archive.h5.")
    ] = None,
    states: Annotated[
        Path | None,
        typer.Option(help="Start from a states.h5; without either, from the included states."),
    ] = None,
    test_nx: Annotated[
        str,
        option(
            "--test-nx",
            help='Numbers of crossings held out for split test-nx; also "largest" or "none".',
            group=_SPLITS,
        ),
    ] = "largest",
    test_share: Annotated[
        float, option("--test-share", help="Share of pictures in split test.", group=_SPLITS)
    ] = 0.15,
    code_share: Annotated[
        float,
        option(
            "--code-share",
            help="Share of pictures in split test-code, and of Gauss codes held out for it.",
            group=_SPLITS,
        ),
    ] = 0.15,
    vary: Annotated[
        str,
        typer.Option(
            help="What to randomize: all, none, or some of"
            " colours,width,background,turn,zoom,noise,blur."
        ),
    ] = "none",
    size: Annotated[
        str,
        typer.Option(
            help="Side in pixels, 64 to 512; from several (64,128) one is drawn at random."
        ),
    ] = "128",
    engine: EngineOption = "mujoco",
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
    """Generate labelled pictures for perception.

    Each comes with its Gauss code, crossings, rope coordinates and a grade of difficulty. Needs the
    extra huggingface: pip install '.[huggingface]'.

    Examples:

        knotgym images --nx 0-4 --count 20000

        knotgym images --nx 2,3 --count 500 --vary all --size 64,128
    """
    with Progress(quiet) as progress:
        from knotgym.generate.images.image_recipe import make_images
        from knotgym.generate.images.images_config import ImagesConfig
        from knotgym.rendering.appearance import VARIED, AppearanceConfig

        existing = Existing(resume=resume, restart=restart, overwrite=overwrite)
        options = run_options(executor, scheduler, workers, shard, existing, quiet)
        sizes = size.split(",")
        if not all(pixels.strip().isdecimal() for pixels in sizes):
            raise typer.BadParameter(
                f"--size takes sides in pixels, such as 128 or 64,128, got {size!r}"
            )
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
            engine=engine,
            seed=seed,
            appearance=AppearanceConfig(vary=varied, sizes=tuple(map(int, sizes))),
        )
        folder = out or default_folder(
            f"images-nx{nx}",
            made_from(archive or states),
            "" if engine == "mujoco" else engine,
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
