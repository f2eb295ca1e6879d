"""The commands `knotgym dataset ...`, which inspect, check, convert and cut datasets."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from knotgym.cli.options import APP, Overwrite, Quiet
from knotgym.common.errors import Failed, InvalidInput
from knotgym.runs.progress import Progress

dataset = App(
    name="dataset",
    help="Inspect, check and convert datasets.",
    help_epilogue="",
    default_parameter=Parameter(show_default=False),
    **APP,
)

PathOrId = Annotated[
    str,
    Parameter(
        name="PATH-OR-ID",
        help="A run's folder or its minari folder, a states.h5, an episode file, a folder of"
        " pictures, or a Minari dataset id; show also takes transcripts.",
    ),
]
Out = Annotated[
    Path | None,
    Parameter(
        help="Output: a file if the dataset is a file or episodes, else a folder. With --id: the"
        " Minari root, Minari's own by default.",
    ),
]
Source = Annotated[str, Parameter(name="PATH-OR-ID")]
Curve = Annotated[Path, Parameter(name="CURVE")]
Id = Annotated[str, Parameter(name="--id", help="Write episodes as a Minari dataset with this id.")]


def _command(name: str | None = None) -> Callable[[Callable[..., None]], None]:
    """Register a function as a command; its first parameter is the progress display."""

    def register(function: Callable[..., None]) -> None:
        @functools.wraps(function)
        def run(*words: Any, quiet: bool = False, **options: Any) -> None:
            with Progress(quiet, lines=False) as progress:
                function(progress, *words, **options)

        _, *parameters = inspect.signature(function).parameters.values()
        quiet = inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False)
        own = [*parameters, quiet.replace(annotation=Quiet)]
        run.__annotations__ = {one.name: one.annotation for one in own}
        vars(run)["__signature__"] = inspect.Signature(own)
        dataset.command(run, name=name)

    return register


@_command()
def show(progress: Progress, path: PathOrId, /) -> None:
    """Summarize a dataset.

    Prints crossings, codes, chirality, splits, quality and rejections. For transcripts of `knotgym
    prompt` (a .jsonl file or its folder): success rate, answers, retries and tokens.
    """
    from knotgym.cli.inspection import show as look

    look(path, progress.console)


@_command()
def gallery(
    progress: Progress, path: PathOrId, /, *, out: Path | None = None, overwrite: Overwrite = False
) -> None:
    """Draw a contact sheet of knot diagrams with their codes.

    It shows all states, or the final states of the first 64 episodes, framed green for success and
    red for failure. For a perception table it shows the first 64 pictures.

    Args:
        out: PNG to write; gallery.png in the folder by default.
    """
    from knotgym.cli.inspection import gallery as draw
    from knotgym.datasets.located import folder_of

    out = out or folder_of(path) / "gallery.png"
    progress.say(f"{out}: {draw(path, out, 8, overwrite)}")


@_command()
def verify(progress: Progress, path: PathOrId, /) -> None:
    """Check a dataset.

    Compares checksums and schema, recomputes Gauss codes with two implementations, replays the
    actions that led to each state, and checks the splits. Exit status 1 on any fault.
    """
    from knotgym.cli.inspection import checked, faults
    from knotgym.runs.compilation import compile_first

    compile_first(progress)
    found = 0
    for fault in faults(path, progress):
        found += 1
        progress.console.print(f"fault: {fault}", soft_wrap=True, highlight=False, markup=False)
    if found:
        raise Failed(f"{path}: {found} faults")
    progress.say(f"{path}: {checked(path)}: no faults")


@_command()
def merge(
    progress: Progress,
    *sources: Source,
    out: Path | None = None,
    dataset_id: Id = "",
    overwrite: Overwrite = False,
) -> None:
    """Merge datasets of one kind. Data is copied, not encoded again.

    Shards of a run are merged by running its command again, without run.shard, where the journals
    of all shards lie.

    Examples:

        knotgym dataset merge a/states.h5 b/states.h5 --out states.h5

        knotgym dataset merge knotgym/tie-nx2/a-v0 knotgym/tie-nx2/b-v0 --id knotgym/both-v0

    Args:
        sources: State files or their folders; or trajectory datasets of one task.
        out: Output. With --id: the Minari root, Minari's own by default. Otherwise: the file,
            states.h5, or episodes.h5 for trajectories.
    """
    if not sources:
        raise InvalidInput("name what to merge: two datasets at least")
    if any(source.endswith(".journal") for source in sources):
        raise InvalidInput(
            "shards of a run are merged by running its command again, without run.shard, where"
            " their journals lie"
        )
    from knotgym.datasets.merging import merge as merge_datasets

    progress.stage("merging")
    progress.say(merge_datasets(sources, out, dataset_id, overwrite))


@_command()
def replay(
    progress: Progress,
    path: PathOrId,
    /,
    *,
    out: Path | None = None,
    row: int = 0,
    overwrite: Overwrite = False,
) -> None:
    """Replay the actions of a state or an episode, check the result bit for bit, and film it.

    Arrows show the pulls, both codes are printed below, and the last frame says "reached" or
    "failed".

    Args:
        out: Video to write: .gif, or with the extra video .mp4 or .webm; by default replay.gif in
            the folder.
        row: Index of the state or episode.
    """
    from knotgym.cli.inspection import film
    from knotgym.datasets.located import folder_of

    out = out or folder_of(path) / "replay.gif"
    progress.say(f"{out}: {film(path, row, out, overwrite, progress)}")


@_command()
def page(
    progress: Progress, path: PathOrId, /, *, out: Path | None = None, overwrite: Overwrite = False
) -> None:
    """Write a self-contained HTML page for browsing a dataset offline.

    States can be rotated in 3D and episodes played. Large sets are sampled, so that the page has at
    most 10 MB.

    Args:
        out: HTML file to write; page.html in the folder by default.
    """
    from knotgym.cli.inspection import page as write
    from knotgym.datasets.located import folder_of

    out = out or folder_of(path) / "page.html"
    progress.stage("writing the page")
    progress.say(f"{out}: {write(path, out, overwrite)}")


@_command()
def export(
    progress: Progress,
    path: PathOrId,
    /,
    *,
    out: Path,
    to: str = "compact",
    overwrite: Overwrite = False,
) -> None:
    """Convert a dataset to another format, or to a folder ready to upload.

    Args:
        out: Output: a file for curves; an .h5 file for compact and recording, or a folder of them
            for several datasets; a folder for all other formats.
        to: Format: compact (one compressed file, pictures are rendered on loading), recording
            (starts and pulls alone) or ogbench; huggingface or minari for a folder ready to upload;
            curves for the closed curves of states as .csv, .obj or .npz.
    """
    from knotgym.control.verification import replay
    from knotgym.datasets.exports.exporters import export as convert

    progress.stage("exporting")
    progress.say(f"{out}: {convert(path, out, to, replay, overwrite=overwrite)}")


@_command()
def select(
    progress: Progress,
    path: PathOrId,
    /,
    *,
    where: str = "",
    sample: int | None = None,
    seed: int = 0,
    out: Out = None,
    dataset_id: Id = "",
    overwrite: Overwrite = False,
) -> None:
    """Write the states, episodes or pictures that fulfil a condition as a new dataset.

    Examples:

        knotgym dataset select runs/nx3 --where "nx > 2 and split = 'train'" --out hard.h5

        knotgym dataset select knotgym/tie-nx3/a-v0 --where "length < 30" --id knotgym/short-v0

    Args:
        where: Condition on the columns in SQL, such as "success and length < 30 and policy in
            ('expert', 'play')". An unknown column lists those that there are. Needs the extra
            select.
        sample: Keep this many of the rows, drawn at random.
        seed: Seed of the random choice.
    """
    from knotgym.datasets import subsets

    progress.stage("selecting")
    _require_own(path, out, dataset_id)
    made = subsets.select(
        path,
        where=where,
        sample=sample,
        seed=seed,
        out=out,
        dataset_id=dataset_id,
        overwrite=overwrite,
    )
    progress.say(f"{made}: {subsets.kept(made)}")


@_command()
def split(
    progress: Progress,
    path: PathOrId,
    /,
    *,
    parts: str,
    seed: int = 0,
    out: Out = None,
    dataset_id: Id = "",
    overwrite: Overwrite = False,
) -> None:
    """Write a dataset as several, OUT-NAME each, by fractions of its rows.

    Near-duplicates, rows of one walk, and episodes with a common start or goal state stay together.

    Args:
        parts: Names and fractions of the parts, such as train=0.8,val=0.2.
        seed: Seed of the random choice.
    """
    from knotgym.datasets import subsets

    progress.stage("splitting")
    _require_own(path, out, dataset_id)
    for made in subsets.split(
        path, parts, seed=seed, out=out, dataset_id=dataset_id, overwrite=overwrite
    ):
        progress.say(f"{made}: {subsets.kept(made)}")


@_command()
def delete(
    progress: Progress,
    path: PathOrId,
    /,
    *,
    rows: str,
    out: Out = None,
    dataset_id: Id = "",
    overwrite: Overwrite = False,
) -> None:
    """Write a dataset without some of its rows.

    Args:
        rows: Which, such as 3,7-9: rows of states, numbers of episodes, or source.row of pictures.
    """
    from knotgym.datasets import subsets

    progress.stage("deleting")
    _require_own(path, out, dataset_id)
    numbered = subsets.row_numbers(rows)
    made = subsets.delete(path, numbered, out=out, dataset_id=dataset_id, overwrite=overwrite)
    progress.say(f"{made}: {subsets.kept(made)}")


@_command(name="import")
def import_curves(
    progress: Progress, *curves: Curve, out: Path, overwrite: Overwrite = False
) -> None:
    """Write closed curves as states of the rope.

    A curve is cut into beads, scaled to the rope's length, relaxed where needed, and judged by the
    limits of generated states. It keeps its Gauss code as seen from +z; its knot is certified. All
    states are in split train; `dataset split` makes others. Curves that can't be laid are listed,
    and the exit status is then 1, or 2 if there is no other curve.

    Args:
        curves: Files of closed curves: rows x,y,z or name,x,y,z (.csv, .tsv, .txt, .dat, .xyz),
            .obj, .vect, .json, .npy or .npz.
        out: State file to write, such as states.h5.
    """
    if not curves:
        raise InvalidInput("name the files of curves to import")
    from knotgym.common.atomic_files import atomic_write, require_output
    from knotgym.generate.states.imported_curves import import_curves as lay
    from knotgym.states.state_file import write_states

    progress.stage("relaxing curves")
    require_output(out, folder=False, overwrite=overwrite)
    states, refused = lay(curves)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_states(temporary, states)
    knots = ", ".join(sorted(set(states.knot.tolist())))
    progress.say(f"{out}: {len(states)} states, of {knots}")
    for line in refused:
        progress.console.print(f"refused: {line}", soft_wrap=True, highlight=False, markup=False)
    if refused:
        raise Failed(f"{len(refused)} files or curves were refused; {out} holds {len(states)}")


def _require_own(path: str, out: Path | None, dataset_id: str) -> None:
    """Refuse linked files, and a plain file in Minari's folder."""
    from knotgym.datasets.located import refuse_minaris_folder, sources

    sources(path)
    if out is not None and not dataset_id:
        refuse_minaris_folder(out)
