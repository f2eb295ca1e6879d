"""The commands `knotgym dataset ...`, which inspect, check and convert datasets."""

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.options import OverwriteOption, QuietOption
from knotgym.runs.progress import Progress

dataset_app = typer.Typer(no_args_is_help=True, help="Inspect, check and convert datasets.")

PathOrId = Annotated[
    str,
    typer.Argument(
        metavar="PATH-OR-ID",
        help=(
            "A run's folder or its `minari` folder, a states.h5, an episode file, a folder of"
            " pictures, or a Minari dataset id; `show` also takes transcripts."
        ),
    ),
]


@dataset_app.command()
def show(path: PathOrId) -> None:
    """Summarize a dataset.

    Prints crossings, codes, chirality, splits, quality and rejections. For transcripts of `knotgym
    prompt` (a .jsonl file or its folder): success rate, answers, retries and tokens.
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
    columns: Annotated[int, typer.Option(min=1, help="Pictures per row.")] = 8,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Draw a contact sheet of knot diagrams with their codes.

    It shows all states, or the final states of the first 64 episodes, framed green for success and
    red for failure. For a perception table it shows the first 64 pictures.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import gallery as draw
        from knotgym.datasets.located import folder_of

        out = out or folder_of(path) / "gallery.png"
        progress.say(f"{out}: {draw(path, out, columns, overwrite)}")


@dataset_app.command()
def verify(
    path: PathOrId,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print faults only.")] = False,
) -> None:
    """Check a dataset.

    Compares checksums and schema, recomputes Gauss codes with two implementations, replays the
    actions that led to each state, and checks the splits. Exit status 1 on any fault.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import checked, faults
        from knotgym.runs.compilation import compile_first

        compile_first(progress)
        found = 0
        for fault in faults(path, progress):
            found += 1
            line = f"fault: {fault}"
            progress.console.print(line, soft_wrap=True, highlight=False, markup=False)
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
                "All shards of one run; state files or their folders; or trajectory datasets of one"
                " task."
            ),
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help=(
                "Output. For shards: the folder to make, or for shards of collect the Minari root."
                " With --id: the Minari root, Minari's own by default. Otherwise: the file,"
                " states.h5, or episodes.h5 for trajectories."
            )
        ),
    ] = None,
    dataset_id: Annotated[
        str,
        typer.Option("--id", help="Write a Minari dataset with this id, such as knotgym/all-v0."),
    ] = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Merge the shards of one run, or datasets of one kind.

    Data is copied, not encoded again.

    Examples:

        knotgym dataset merge runs/nx4-shard-*-of-8 --out runs/nx4

        knotgym dataset merge tie-shard-*-of-4.json --out tie.json

        knotgym dataset merge a/states.h5 b/states.h5 --out states.h5

        knotgym dataset merge knotgym/tie-nx2/a-v0 knotgym/tie-nx2/b-v0 --id knotgym/both-v0
    """
    if not dataset_id and out is None:
        raise typer.BadParameter("give an output: --out FILE, or --id for a Minari dataset")
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
                "Video to write: .gif, or with the extra video .mp4 or .webm; by default replay.gif"
                " in the folder."
            )
        ),
    ] = None,
    row: Annotated[int, typer.Option(min=0, help="Index of the state or episode.")] = 0,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Replay the actions of a state or an episode, check the result bit for bit, and film it.

    Arrows show the pulls, both codes are printed below, and the last frame says "reached" or
    "failed".
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import film
        from knotgym.datasets.located import folder_of

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
    """Write a self-contained HTML page for browsing a dataset offline.

    States can be rotated in 3D and episodes played. Large sets are sampled, so that the page has at
    most 10 MB.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import page as write
        from knotgym.datasets.located import folder_of

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
                "Output: a file for curves; an .h5 file for compact, or a folder of them for"
                " several datasets; a folder for all other formats."
            )
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            help=(
                "Format: compact (states and actions, pictures are rendered on loading), lerobot or"
                " ogbench; huggingface or minari for a folder ready to upload; curves for the"
                " closed curves of states as .csv, .obj or .npz."
            )
        ),
    ] = "compact",
    video: Annotated[
        str,
        typer.Option(
            help=(
                "With lerobot: pictures as video, h264 or av1, instead of PNG. Video is lossy, see"
                " the card that is written. Needs the extra video."
            )
        ),
    ] = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Convert a dataset to another format, or to a folder ready to upload."""
    with Progress(quiet, lines=False) as progress:
        from knotgym.cli.inspection import export as convert

        progress.stage("exporting")
        progress.say(f"{out}: {convert(path, out, to, overwrite, progress.stage, video)}")
