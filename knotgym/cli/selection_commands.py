"""The commands `knotgym dataset select`, `split`, `delete` and `import`."""

from pathlib import Path
from typing import Annotated

import typer

from knotgym.cli.dataset_commands import PathOrId
from knotgym.cli.options import OverwriteOption, QuietOption
from knotgym.runs.progress import Progress

OutOption = Annotated[
    Path | None,
    typer.Option(
        help=(
            "Output: a file if the dataset is a file or episodes, else a folder. With --id: the"
            " Minari root, Minari's own by default."
        )
    ),
]
IdOption = Annotated[
    str, typer.Option("--id", help="Write episodes as a Minari dataset with this id.")
]
SeedOption = Annotated[int, typer.Option(min=0, help="Seed of the random choice.")]


def select(
    path: PathOrId,
    where: Annotated[
        str,
        typer.Option(
            help=(
                "Condition on the columns: comparisons, and, or, not, in, + - * / %, such as 'nx =="
                " 3 and success and length < 30'. An unknown column lists those that there are."
            )
        ),
    ] = "",
    split: Annotated[str, typer.Option(help="Keep the rows of this split only.")] = "",
    sample: Annotated[
        int | None, typer.Option(min=1, help="Keep this many of the rows, drawn at random.")
    ] = None,
    seed: SeedOption = 0,
    out: OutOption = None,
    dataset_id: IdOption = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write the states, episodes or pictures that fulfil a condition as a new dataset.

    Examples:

        knotgym dataset select runs/nx3 --where "clearance > 9" --split train --out runs/clear

        knotgym dataset select knotgym/tie-nx3/a-v0 --where "length < 30" --id knotgym/short-v0
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.datasets import subsets

        progress.stage("selecting")
        _require_own(path, out, dataset_id)
        made = subsets.select(
            path,
            where=where,
            split=split,
            sample=sample,
            seed=seed,
            out=out,
            dataset_id=dataset_id,
            overwrite=overwrite,
        )
        progress.say(f"{made}: {subsets.kept(made)}")


def split(
    path: PathOrId,
    parts: Annotated[
        str, typer.Option(help="Names and fractions of the parts, such as train=0.8,val=0.2.")
    ],
    seed: SeedOption = 0,
    out: OutOption = None,
    dataset_id: IdOption = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a dataset as several, OUT-NAME each, by fractions of its rows.

    Near-duplicates, rows of one walk, and episodes with a common start or goal state stay together.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.datasets import subsets

        progress.stage("splitting")
        _require_own(path, out, dataset_id)
        for made in subsets.split(
            path, parts, seed=seed, out=out, dataset_id=dataset_id, overwrite=overwrite
        ):
            progress.say(f"{made}: {subsets.kept(made)}")


def delete(
    path: PathOrId,
    rows: Annotated[
        str,
        typer.Option(
            help=(
                "Which, such as 3,7-9: rows of states, numbers of episodes, or source.row of"
                " pictures."
            )
        ),
    ],
    out: OutOption = None,
    dataset_id: IdOption = "",
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a dataset without some of its rows."""
    with Progress(quiet, lines=False) as progress:
        from knotgym.datasets import subsets

        progress.stage("deleting")
        _require_own(path, out, dataset_id)
        made = subsets.delete(
            path,
            subsets.row_numbers(rows),
            out=out,
            dataset_id=dataset_id,
            overwrite=overwrite,
        )
        progress.say(f"{made}: {subsets.kept(made)}")


def import_curves(
    curves: Annotated[
        list[Path],
        typer.Argument(
            metavar="CURVE...",
            help="Files of closed curves: .csv (x,y,z or curve,x,y,z), .obj or .npz.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="State file to write, such as states.h5.")],
    split: Annotated[str, typer.Option(help="Split of all states: train or test.")] = "train",
    seed: SeedOption = 0,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Lay closed curves as rope states.

    A curve is cut into beads, scaled to the rope's length, relaxed where needed, and judged by the
    limits of generated states. It keeps its Gauss code as seen from +z; its knot is certified.
    """
    with Progress(quiet, lines=False) as progress:
        from knotgym.common.atomic_files import atomic_write, require_output
        from knotgym.generate.states.imported_curves import import_curves as lay
        from knotgym.states.schema import STATE_SPLITS
        from knotgym.states.state_file import write_states

        if split not in STATE_SPLITS:
            raise typer.BadParameter(f"--split takes {' or '.join(STATE_SPLITS)}, got {split!r}")
        progress.stage("laying curves")
        require_output(out, folder=False, overwrite=overwrite)
        states = lay(curves, split=split, seed=seed)
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_states(temporary, states)
        knots = ", ".join(sorted(set(states.knot.tolist())))
        progress.say(f"{out}: {len(states)} states, of {knots}")


def _require_own(path: str, out: Path | None, dataset_id: str) -> None:
    """Refuse linked files, and a plain file in Minari's folder."""
    from knotgym.cli.inspection import refuse_minaris_folder, require_own_files

    require_own_files(path)
    if out is not None and not dataset_id:
        refuse_minaris_folder(out)
