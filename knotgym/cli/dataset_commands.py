"""`knotgym dataset ...`: look at, check and convert what the other commands made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import OverwriteOption, QuietOption
from knotgym.runs.progress import Progress

dataset_app = typer.Typer(no_args_is_help=True, help="Look at, check and convert datasets.")

PathOrId = Annotated[
    str,
    typer.Argument(
        metavar="PATH-OR-ID",
        help=(
            "A run's folder or the `minari` in it, a states.h5, an episode file, a folder of"
            " pictures, or a Minari dataset id; show takes transcripts, too."
        ),
    ),
]


@dataset_app.command()
def show(path: PathOrId) -> None:
    """Count what a dataset holds.

    Crossings, codes, chirality, splits, quality, rejections; of transcripts (a .jsonl of `knotgym
    prompt`, or its folder) successes, answers, retries, tokens.
    """
    with Progress(lines=False) as progress:
        from knotgym.cli.inspection import show as look

        look(path, progress.console)


@dataset_app.command()
def gallery(
    path: PathOrId,
    out: Annotated[
        Path | None, typer.Option(help="PNG to write; gallery.png in the folder by default.")
    ] = None,
    columns: Annotated[int, typer.Option(min=1, help="Pictures in a row.")] = 8,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Draw a contact sheet: knot diagrams, each with its code.

    It shows all states, or the ends of the first 64 episodes, each framed green if it reached its
    goal and red if it failed. Of a perception table it shows the first 64 pictures as they are.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import gallery as draw
        from knotgym.cli.places import folder_of

        out = out or folder_of(path) / "gallery.png"
        progress.say(f"{out}: {draw(path, out, columns, overwrite)}")


@dataset_app.command()
def verify(
    path: PathOrId,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but faults.")] = False,
) -> None:
    """Check everything that a dataset says.

    Checksums, schema, labels by two labellers, provenance by replay, splits. Exit status 1 on any
    fault.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import checked, faults
        from knotgym.runs.progress import compile_first

        compile_first(progress)
        found = 0
        for fault in faults(path, progress):
            found += 1
            told = f"fault: {fault}"
            progress.console.print(told, soft_wrap=True, highlight=False, markup=False)
        if found:
            progress.say(f"{path}: {found} faults")
            raise typer.Exit(1)
        if not quiet:
            progress.say(f"{path}: {checked(path)}: no faults")


@dataset_app.command()
def merge(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="PATH-OR-ID...",
            help=(
                "All the shards of one run; or state files or their folders; or trajectory datasets"
                " of one task."
            ),
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help=(
                "For shards the folder to make, for those of collect the root of the dataset's id;"
                " with --id the root of the id, Minari's own by default; else the file: states.h5,"
                " or episodes.h5 for trajectories."
            )
        ),
    ] = None,
    dataset_id: Annotated[
        str,
        typer.Option("--id", help="Make a Minari dataset of this id, such as knotgym/all-v0."),
    ] = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Put shards of one run, or datasets of one kind, together.

    Nothing is encoded again.

    Examples:

        knotgym dataset merge runs/nx4-shard-*-of-8 --out runs/nx4

        knotgym dataset merge a/states.h5 b/states.h5 --out states.h5

        knotgym dataset merge knotgym/tie-nx2/a-v0 knotgym/tie-nx2/b-v0 --id knotgym/both-v0
    """
    if not dataset_id and out is None:
        raise typer.BadParameter("say where to: --out FILE, or --id for a Minari dataset")
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import merge as put_together
        from knotgym.cli.inspection import merge_to_minari

        progress.stage("merging")
        if dataset_id:
            progress.say(merge_to_minari(sources, dataset_id, out, overwrite, progress.stage))
        elif out is not None:
            progress.say(put_together(sources, out, overwrite, progress.stage))


@dataset_app.command()
def replay(
    path: PathOrId,
    out: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Video to write: .gif, or .mp4 or .webm with the extra video; replay.gif in the"
                " folder by default."
            )
        ),
    ] = None,
    row: Annotated[int, typer.Option(min=0, help="Which state or episode.")] = 0,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Act out how a state or an episode came to be, check it bit for bit, and film it.

    The pull is an arrow, both codes stand below, and the last frame says "reached" or "failed".
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import film
        from knotgym.cli.places import folder_of

        out = out or folder_of(path) / "replay.gif"
        progress.say(f"{out}: {film(path, row, out, overwrite, progress)}")


@dataset_app.command()
def page(
    path: PathOrId,
    out: Annotated[
        Path | None, typer.Option(help="HTML file to write; page.html in the folder by default.")
    ] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write one HTML file to browse a dataset in, without a network.

    States turn in three dimensions, episodes play; 10 MB at most, large sets are sampled.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import page as write
        from knotgym.cli.places import folder_of

        out = out or folder_of(path) / "page.html"
        progress.stage("writing the page")
        progress.say(f"{out}: {write(path, out, overwrite)}")


@dataset_app.command()
def export(
    path: PathOrId,
    out: Annotated[
        Path,
        typer.Option(
            help=(
                "What to write: a file, .h5, for the compact form, a folder of such where there are"
                " several datasets; a folder for the others."
            )
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            help=(
                "compact (states and actions; pictures are drawn), lerobot, ogbench; huggingface"
                " or minari: a folder to upload as it is."
            )
        ),
    ] = "compact",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Convert a dataset to another form, or to a folder to upload."""
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import export as convert

        progress.stage("exporting")
        progress.say(f"{out}: {convert(path, out, to, overwrite, progress.stage)}")
