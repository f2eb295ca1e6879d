"""The commands `knotgym dataset ...`, which inspect, check, convert and cut datasets."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from knotgym import common, control, datasets, generate, runs, states
from knotgym.cli.options import APP, DrawSeed, Given, command
from knotgym.common import Failed, InvalidInput

_command = partial(command, {}, lines=False)
Source = Annotated[
    str,
    Parameter(
        name="PATH-OR-ID",
        help="A run's folder or its minari folder, a states.h5, an episode file, a folder of"
        " pictures, or a Minari dataset id; show also takes transcripts.",
    ),
]
File = Annotated[Path, Parameter(help="File to write: .h5, or .parquet for pictures.")]
Format = Annotated[str, Parameter(help=datasets.export_help())]


@_command("")
def show(given: Given, source: Source, /) -> None:
    """Summarize a dataset.

    Prints crossings, codes, chirality, splits, quality and rejections. For transcripts of `knotgym
    prompt` (a .jsonl file or its folder): success rate, answers, retries and tokens.
    """
    given.summarize(source)


@_command("run.overwrite")
def gallery(given: Given, source: Source, /, *, out: Path | None = None) -> None:
    """Draw a contact sheet of knot diagrams with their codes.

    It shows up to 400 states, or the final states of 64 episodes, framed green for success and red
    for failure, or 64 pictures: a sample even over splits, crossings and outcomes.

    Args:
        out: PNG to write; gallery.png in the folder by default.
    """
    _write(given, source, out, "gallery.png", datasets.write_sheet)


@_command("")
def verify(given: Given, source: Source, /, *, sample: int = 0) -> None:
    """Check a dataset.

    Compares checksums and schema, recomputes Gauss codes with two implementations, replays the
    actions that led to each state, and checks the splits. Exit status 1 on any fault.

    Args:
        sample: Episodes to draw and play again, where all would take too long; 0 for all.
    """
    from knotgym.cli.inspection import faults

    runs.compile_first(given.progress)
    count = 0
    for fault in faults(source, given.progress, sample):
        _print(given, f"fault: {fault}")
        count += 1
    if count:
        raise Failed(f"{source}: {count} faults")


@_command("run.overwrite")
def merge(
    given: Given,
    *sources: Annotated[str, Parameter(name="SOURCES")],
    out: Path | None = None,
    id: str = "",
) -> None:
    """Merge datasets of one kind. Data is copied, not encoded again.

    Shards of a run are merged by running its command again, without run.shard, where the journals
    of all shards lie.

    Examples:

        knotgym dataset merge a/states.h5 b/states.h5 --out states.h5

        knotgym dataset merge knotgym/a-v0 knotgym/b-v0 --id knotgym/both-v0

    Args:
        sources: State files or their folders; or episodes that were played alike, whose tasks and
            numbers of crossings may differ.
        out: File to write; with --id the Minari root, Minari's own by default.
        id: Write episodes as a Minari dataset with this id.
    """
    if not sources:
        raise InvalidInput("name what to merge: one dataset or several")
    given.progress.stage("merging")
    given.progress.say(datasets.merge(sources, out, id, given.run.overwrite))


@_command("run.overwrite")
def replay(given: Given, source: Source, /, *, out: Path | None = None, row: int = 0) -> None:
    """Replay the actions of a state or an episode, check the result bit for bit, and film it.

    Arrows show the pulls, both codes are printed below, and the last frame says "reached" or
    "failed".

    Args:
        out: Video to write: .gif, or with the extra video .mp4 or .webm; by default replay.gif in
            the folder.
        row: Index of the state or episode.
    """
    from knotgym.cli.inspection import film

    film(source, row, out, given.run.overwrite, given.progress)


@_command("run.overwrite")
def page(given: Given, source: Source, /, *, out: Path | None = None) -> None:
    """Write a self-contained HTML page for browsing a dataset offline.

    States can be rotated in 3D and episodes played. Large sets are sampled, so that the page has at
    most 10 MB.

    Args:
        out: HTML file to write; page.html in the folder by default.
    """
    given.progress.stage("writing the page")
    _write(given, source, out, "page.html", partial(datasets.write_page, replay=control.replay))


@_command("run.overwrite")
def export(given: Given, source: Source, /, *, out: Path, to: Format = "compact") -> None:
    """Convert a dataset to another format, or to a folder ready to upload.

    Args:
        out: Output: an .h5 file for compact, columns and recording, or a folder of them for several
            datasets; a folder for all other formats.
    """
    given.progress.stage("exporting")
    overwrite = given.run.overwrite
    made = datasets.export(source, out, to, control.replay, overwrite=overwrite)
    given.progress.say(f"{out}: {made}")


@_command("run.overwrite")
def select(
    given: Given,
    source: Source,
    /,
    *,
    where: str = "",
    sample: int | None = None,
    out: File,
    seed: DrawSeed = 0,
) -> None:
    """Write the states, episodes or pictures that fulfil a condition as a new file.

    `dataset merge` makes a Minari dataset of it.

    Examples:

        knotgym dataset select runs/nx3 --where "split = 'train'" --out train.h5

        knotgym dataset select knotgym/a-v0 --where "length < 9" --out short.h5

    Args:
        where: Condition on the columns in SQL, such as "success and length < 30 and policy in
            ('expert', 'play')", or "row not in (3, 7)" to leave rows out. An unknown column lists
            those that there are. Needs the extra select.
        sample: Keep this many of the rows, drawn at random.
    """
    _cut(given, partial(datasets.select, source, where=where, sample=sample, seed=seed, out=out))


@_command("run.overwrite")
def split(given: Given, source: Source, /, *, parts: str, out: File, seed: DrawSeed = 0) -> None:
    """Write a dataset as several files, OUT-NAME each, by fractions of its rows.

    Near-duplicates, rows of one walk, and episodes with a common start or goal state stay together.
    States without crossings don't count there, as nearly all episodes begin or end in one of a few.

    Args:
        parts: Names and fractions of the parts, such as train=0.8,val=0.2.
    """
    _cut(given, partial(datasets.split, source, parts=parts, seed=seed, out=out))


@_command("run.overwrite")
def delete(given: Given, source: Source, /, *, rows: str, out: File) -> None:
    """Write a dataset without some of its rows as a new file.

    Args:
        rows: Rows of states or pictures, or numbers of episodes, such as 3,7-9.
    """
    _cut(given, partial(datasets.delete, source, rows=rows, out=out))


@_command("run.overwrite")
def import_(given: Given, *curves: Annotated[Path, Parameter(name="CURVES")], out: Path) -> None:
    """Write closed curves as states of the rope.

    A curve is cut into beads, scaled to the rope's length, relaxed where needed, and judged by the
    limits of generated states. It keeps its Gauss code as seen from +z; its knot is certified. All
    states are in split train; `dataset split` makes others. Curves that can't be laid are listed,
    and the exit status is then 1, or 2 if there is no other curve.

    Args:
        curves: Files of closed curves: rows x,y,z or name,x,y,z (.csv, .tsv, .txt, .dat, .xyz),
            or arrays (n, 3) (.npy).
        out: State file to write, such as states.h5.
    """
    if not curves:
        raise InvalidInput("name the files of curves to import")
    overwrite = given.run.overwrite
    given.progress.stage("relaxing curves")
    common.require_output(out, folder=False, overwrite=overwrite, reads=curves)
    laid, refused = generate.import_curves(curves)
    with common.atomic_write(out, overwrite=overwrite) as temporary:
        states.write_states(temporary, laid)
    knots = ", ".join(sorted(set(laid.knot.tolist())))
    given.progress.say(f"{out}: {len(laid)} states, of {knots}")
    _print(given, *(f"refused: {line}" for line in refused))
    if refused:
        raise Failed(f"{len(refused)} files or curves were refused; {out} holds {len(laid)}")


dataset = App(name="dataset", help="Inspect, check and convert datasets.", help_epilogue="", **APP)
for _one in (show, gallery, verify, merge, replay, page, export, select, split, delete, import_):
    dataset.command(_one)


def _print(given: Given, *lines: str) -> None:
    """Print lines of the result, which --quiet doesn't leave out."""
    for line in lines:
        given.progress.console.print(line, soft_wrap=True, highlight=False, markup=False)


def _write(
    given: Given, source: str, out: Path | None, name: str, write: Callable[[Path, Any], str]
) -> None:
    """Write a file about a dataset, by default of this name beside it, and say what it is."""
    located, overwrite = datasets.locate(source), given.run.overwrite
    out = out or located.folder / name
    if out.suffix.lower() != Path(name).suffix:
        raise InvalidInput(f"the output must end in {Path(name).suffix}, got {out}")
    common.require_output(out, folder=False, overwrite=overwrite, reads=located.files)
    with common.atomic_write(out, overwrite=overwrite) as temporary:
        written = write(temporary, located)
    given.progress.say(f"{out}: {written}")


def _cut(given: Given, cut: Callable[..., Path | list[Path]]) -> None:
    """Write some rows of a dataset as new files, and say what each holds."""
    given.progress.stage("choosing rows")
    made = cut(overwrite=given.run.overwrite)
    parts = [made] if isinstance(made, Path) else made
    for part in parts:
        given.progress.say(f"{part}: {datasets.kept(part, parts[0])}")
