"""The commands `knotgym dataset ...`, which inspect, check, convert and cut datasets."""

from functools import partial
from pathlib import Path

from cyclopts import App

from knotgym.cli.options import APP, Given, command, extra
from knotgym.common import Failed, InvalidInput
from knotgym.datasets import export_help

_command = partial(command, {}, lines=False)
_SOURCE = extra(
    "PATH-OR-ID",
    str,
    ...,
    "A run's folder or its minari folder, a states.h5, an episode file, a folder of pictures, or a"
    " Minari dataset id; show also takes transcripts.",
)
_FILE = extra("out", Path, ..., "File to write: .h5, or .parquet for pictures.")
_SEED = extra("seed", int, 0, "Seed of the random choice.")


@_command("", _SOURCE)
def show(given: Given) -> None:
    """Summarize a dataset.

    Prints crossings, codes, chirality, splits, quality and rejections. For transcripts of `knotgym
    prompt` (a .jsonl file or its folder): success rate, answers, retries and tokens.
    """
    from knotgym.cli.inspection import show as look

    look(given["path_or_id"], given.progress.console)


@_command("run.overwrite", _SOURCE, extra("out", Path))
def gallery(given: Given) -> None:
    """Draw a contact sheet of knot diagrams with their codes.

    It shows all states, or the final states of 64 episodes, framed green for success and red for
    failure, or 64 pictures: a sample even over splits, crossings and outcomes.

    Args:
        out: PNG to write; gallery.png in the folder by default.
    """
    from knotgym.cli.inspection import gallery as draw

    out = _out(given, "gallery.png")
    given.progress.say(f"{out}: {draw(given['path_or_id'], out, given.run.overwrite)}")


@_command("", _SOURCE)
def verify(given: Given) -> None:
    """Check a dataset.

    Compares checksums and schema, recomputes Gauss codes with two implementations, replays the
    actions that led to each state, and checks the splits. Exit status 1 on any fault.
    """
    from knotgym.cli.inspection import checked, faults
    from knotgym.runs import compile_first

    path, progress, count = given["path_or_id"], given.progress, 0
    compile_first(progress)
    for fault in faults(path, progress):
        _print(given, f"fault: {fault}")
        count += 1
    if count:
        raise Failed(f"{path}: {count} faults")
    progress.say(f"{path}: {checked(path)}: no faults")


@_command("run.overwrite", extra("SOURCES", list[str]), extra("out", Path), extra("id", str, ""))
def merge(given: Given) -> None:
    """Merge datasets of one kind. Data is copied, not encoded again.

    Shards of a run are merged by running its command again, without run.shard, where the journals
    of all shards lie.

    Examples:

        knotgym dataset merge a/states.h5 b/states.h5 --out states.h5

        knotgym dataset merge knotgym/a-v0 knotgym/b-v0 --id knotgym/both-v0

    Args:
        sources: State files or their folders; or episodes of one task.
        out: File to write; with --id the Minari root, Minari's own by default.
        id: Write episodes as a Minari dataset with this id.
    """
    sources = given["sources"] or ()
    if not sources:
        raise InvalidInput("name what to merge: two datasets at least")
    from knotgym.datasets import merge as merge_datasets

    given.progress.stage("merging")
    given.progress.say(merge_datasets(sources, given["out"], given["id"], given.run.overwrite))


@_command("run.overwrite", _SOURCE, extra("out", Path), extra("row", int, 0))
def replay(given: Given) -> None:
    """Replay the actions of a state or an episode, check the result bit for bit, and film it.

    Arrows show the pulls, both codes are printed below, and the last frame says "reached" or
    "failed".

    Args:
        out: Video to write: .gif, or with the extra video .mp4 or .webm; by default replay.gif in
            the folder.
        row: Index of the state or episode.
    """
    from knotgym.cli.inspection import film

    out, progress = _out(given, "replay.gif"), given.progress
    filmed = film(given["path_or_id"], given["row"], out, given.run.overwrite, progress)
    progress.say(f"{out}: {filmed}")


@_command("run.overwrite", _SOURCE, extra("out", Path))
def page(given: Given) -> None:
    """Write a self-contained HTML page for browsing a dataset offline.

    States can be rotated in 3D and episodes played. Large sets are sampled, so that the page has at
    most 10 MB.

    Args:
        out: HTML file to write; page.html in the folder by default.
    """
    from knotgym.cli.inspection import page as write

    out = _out(given, "page.html")
    given.progress.stage("writing the page")
    given.progress.say(f"{out}: {write(given['path_or_id'], out, given.run.overwrite)}")


@_command(
    "run.overwrite", _SOURCE, extra("out", Path, ...), extra("to", str, "compact", export_help())
)
def export(given: Given) -> None:
    """Convert a dataset to another format, or to a folder ready to upload.

    Args:
        out: Output: an .h5 file for compact, columns and recording, or a folder of them for several
            datasets; a folder for all other formats.
    """
    from knotgym.control import replay
    from knotgym.datasets import export as convert

    given.progress.stage("exporting")
    path, out, to = given["path_or_id"], given["out"], given["to"]
    given.progress.say(f"{out}: {convert(path, out, to, replay, overwrite=given.run.overwrite)}")


@_command("run.overwrite", _SOURCE, extra("where", str, ""), extra("sample", int), _SEED, _FILE)
def select(given: Given) -> None:
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
    from knotgym.datasets import kept
    from knotgym.datasets import select as select_rows

    given.progress.stage("selecting")
    chosen = {name: given[name] for name in ("where", "sample", "seed", "out")}
    made = select_rows(given["path_or_id"], **chosen, overwrite=given.run.overwrite)
    given.progress.say(f"{made}: {kept(made)}")


@_command("run.overwrite", _SOURCE, extra("parts", str, ...), _SEED, _FILE)
def split(given: Given) -> None:
    """Write a dataset as several files, OUT-NAME each, by fractions of its rows.

    Near-duplicates, rows of one walk, and episodes with a common start or goal state stay together.

    Args:
        parts: Names and fractions of the parts, such as train=0.8,val=0.2.
    """
    from knotgym.datasets import kept
    from knotgym.datasets import split as split_rows

    given.progress.stage("splitting")
    chosen = {name: given[name] for name in ("parts", "seed", "out")}
    for made in split_rows(given["path_or_id"], **chosen, overwrite=given.run.overwrite):
        given.progress.say(f"{made}: {kept(made)}")


@_command("run.overwrite", _SOURCE, extra("rows", str, ...), _FILE)
def delete(given: Given) -> None:
    """Write a dataset without some of its rows as a new file.

    Args:
        rows: Rows of states or pictures, or numbers of episodes, such as 3,7-9.
    """
    from knotgym.datasets import delete as delete_rows
    from knotgym.datasets import kept

    given.progress.stage("deleting")
    chosen = {name: given[name] for name in ("rows", "out")}
    made = delete_rows(given["path_or_id"], **chosen, overwrite=given.run.overwrite)
    given.progress.say(f"{made}: {kept(made)}")


@_command("run.overwrite", extra("CURVES", list[str]), extra("out", Path, ...))
def import_(given: Given) -> None:
    """Write closed curves as states of the rope.

    A curve is cut into beads, scaled to the rope's length, relaxed where needed, and judged by the
    limits of generated states. It keeps its Gauss code as seen from +z; its knot is certified. All
    states are in split train; `dataset split` makes others. Curves that can't be laid are listed,
    and the exit status is then 1, or 2 if there is no other curve.

    Args:
        curves: Files of closed curves: rows x,y,z or name,x,y,z (.csv, .tsv, .txt, .dat, .xyz),
            .vect, .json, .npy or .npz.
        out: State file to write, such as states.h5.
    """
    if not given["curves"]:
        raise InvalidInput("name the files of curves to import")
    from knotgym.common import atomic_write, require_output
    from knotgym.generate import import_curves
    from knotgym.states import write_states

    out, overwrite = given["out"], given.run.overwrite
    given.progress.stage("relaxing curves")
    curves = [Path(name) for name in given["curves"]]
    require_output(out, folder=False, overwrite=overwrite, reads=curves)
    states, refused = import_curves(curves)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_states(temporary, states)
    knots = ", ".join(sorted(set(states.knot.tolist())))
    given.progress.say(f"{out}: {len(states)} states, of {knots}")
    _print(given, *(f"refused: {line}" for line in refused))
    if refused:
        raise Failed(f"{len(refused)} files or curves were refused; {out} holds {len(states)}")


dataset = App(name="dataset", help="Inspect, check and convert datasets.", help_epilogue="", **APP)
for _one in (show, gallery, verify, merge, replay, page, export, select, split, delete, import_):
    dataset.command(_one)


def _print(given: Given, *lines: str) -> None:
    """Print lines of the result, which --quiet doesn't leave out."""
    for line in lines:
        given.progress.console.print(line, soft_wrap=True, highlight=False, markup=False)


def _out(given: Given, name: str) -> Path:
    """Return the output that was typed, or a file of this name beside the dataset."""
    from knotgym.datasets import locate

    return given["out"] or locate(given["path_or_id"]).folder / name
