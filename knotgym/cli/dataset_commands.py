"""`knotgym dataset ...`: look at, check and convert what the other commands made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

dataset_app = typer.Typer(no_args_is_help=True, help="Look at, check and convert datasets.")

PathOrId = Annotated[
    str,
    typer.Argument(
        metavar="PATH-OR-ID", help="A folder or file that knotgym made, or a Minari dataset id."
    ),
]


@dataset_app.command()
def show(path: PathOrId) -> None:
    """Count what a dataset holds: crossings, codes, chirality, splits, quality, rejections."""
    from knotgym.cli.inspection import show as look

    look(path, Console())


@dataset_app.command()
def gallery(
    path: PathOrId,
    out: Annotated[Path, typer.Option(help="PNG to write.")] = Path("gallery.png"),
    columns: Annotated[int, typer.Option(min=1, help="Pictures in a row.")] = 8,
) -> None:
    """Draw a contact sheet of curated states with their codes."""
    from knotgym.cli.inspection import refuse_existing, states_path
    from knotgym.datasets.gallery import write_gallery
    from knotgym.datasets.states import read_states

    refuse_existing(out)
    write_gallery(out, read_states(states_path(path)), columns)


@dataset_app.command()
def verify(
    path: PathOrId,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but faults.")] = False,
) -> None:
    """Check everything: checksums, schema, labels by two labellers, provenance by replay, splits.

    Exit status 1 on any fault.
    """
    from knotgym.cli.inspection import faults

    console, found = Console(), 0
    for fault in faults(path, None if quiet else console):
        found += 1
        console.print(f"fault: {fault}", soft_wrap=True, highlight=False, markup=False)
    if not quiet:
        console.print(f"{found} faults" if found else "no faults", highlight=False)
    if found:
        raise typer.Exit(1)


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
) -> None:
    """Put shards of one run, or datasets of one kind, together, nothing encoded again."""
    from knotgym.cli.inspection import merge as put_together
    from knotgym.cli.inspection import merge_to_minari

    if dataset_id:
        merge_to_minari(sources, dataset_id, out)
    elif out is None:
        raise typer.BadParameter("say where to: --out FILE, or --id for a Minari dataset")
    else:
        put_together(sources, out)


@dataset_app.command()
def replay(
    path: PathOrId,
    out: Annotated[Path, typer.Option(help="Video to write, .mp4 or .gif.")] = Path("replay.gif"),
    row: Annotated[int, typer.Option(min=0, help="Which state or episode.")] = 0,
) -> None:
    """Act out how a state or an episode came to be, check it bit for bit, and film it.

    Its code stands under the picture.
    """
    from knotgym.cli.inspection import film

    film(path, row, out)


@dataset_app.command()
def export(
    path: PathOrId,
    out: Annotated[
        Path,
        typer.Option(help="What to write: a file, .h5, for the compact form; else a folder."),
    ],
    to: Annotated[
        str,
        typer.Option(help="compact (states and actions; pictures are drawn), lerobot or ogbench."),
    ] = "compact",
) -> None:
    """Convert trajectories to another form: the compact one, LeRobot's, OGBench's."""
    from knotgym.cli.inspection import refuse_existing, refuse_minaris_folder
    from knotgym.datasets.exports.forms import export as convert

    if to == "compact":
        refuse_existing(out)
        refuse_minaris_folder(out)
    convert(path, out, to)
