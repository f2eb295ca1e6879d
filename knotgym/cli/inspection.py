"""The work of the `knotgym dataset` commands on a dataset named by a path or an id."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from knotgym.cli.summaries import print_episodes, print_images, print_states, print_transcripts
from knotgym.common.atomic_files import (
    atomic_write,
    require_no_links,
    require_output,
    require_writable,
)
from knotgym.common.errors import Failed, InvalidInput
from knotgym.datasets import verification
from knotgym.datasets.episode_reader import Count, EpisodeReader, episode_file, uncounted
from knotgym.datasets.episode_writer import merge_episodes
from knotgym.datasets.exports.forms import export as convert
from knotgym.datasets.exports.huggingface_export import ToUpload, to_huggingface
from knotgym.datasets.exports.minari_export import to_minari
from knotgym.datasets.foreign_file import try_files
from knotgym.datasets.gallery import write_episode_gallery, write_gallery, write_picture_gallery
from knotgym.datasets.image_table import read_table, shards
from knotgym.datasets.located import (
    Dataset,
    episodes_at,
    name_of,
    resolve_dataset,
    resolve_datasets,
)
from knotgym.datasets.manifest_check import read_manifest
from knotgym.datasets.minari_dataset import compact, dataset_files, merge_datasets
from knotgym.datasets.page.page_data import dataset_name, page_data
from knotgym.datasets.page.page_writer import write_page
from knotgym.generate.merge_shards import merge_shards, shard_folder_of
from knotgym.generate.states.imported_curves import write_curves
from knotgym.prompting.transcripts import transcripts_at
from knotgym.rendering.video import film_frames, require_film, write_film
from knotgym.rope.engines import simulation_of
from knotgym.rope.model import Array, RopeConfig, rope_of
from knotgym.runs.executors import executor
from knotgym.runs.progress import Progress
from knotgym.states.state_file import (
    leads_out,
    merge_states,
    minari_root,
    read_states,
    states_at,
    write_states,
)

_LARGE = 4_000_000  # bytes; larger tables are checked faster by several processes than by one


def demonstrations(path: Path) -> list[Dataset]:
    """Return the trajectory datasets in the folder of a run."""
    return episodes_at(str(path)) if (path / "minari").is_dir() else []


def show(named: str, console: Console) -> None:
    """Print a summary of a dataset or of transcripts."""
    if transcripts_at(named) is not None:
        print_transcripts(Path(named), console)
        return
    for kind, path in resolve_datasets(named):
        if kind == "images":
            print_images(str(path), console)
        elif kind == "states":
            print_states(named, states_at(path), console)
        else:
            print_episodes(str(path), console)


def faults(named: str, progress: Progress) -> Iterator[str]:
    """Check the datasets that a path or an id names; yield their faults.

    Raises:
        InvalidFile: the HDF5 library crashes on one of the files.
    """
    given = [Path(named)]
    if not given[0].exists() and not leads_out(named):
        given = [minari_root() / named]
    try_files([*given, *(file for one in given for file in sorted(one.glob("**/*.h*5")))])
    tables = [file for one in given for file in (one, *one.glob("**/*.parquet")) if file.is_file()]
    large = sum(file.stat().st_size for file in tables) > _LARGE
    with executor(0 if large else 1) as pool:
        for _, path in resolve_datasets(named):
            progress.stage(f"checking {path}")
            yield from verification.faults(path, pool.map, progress.stage)


def checked(named: str) -> str:
    """Describe what `faults` has checked, as counts."""
    counts: Counter[str] = Counter()
    for kind, path in resolve_datasets(named):
        if kind == "images":
            counts["pictures"] += len(read_table(path, columns=["nx"]))
        elif kind == "states":
            counts["Gauss codes"] += len(read_states(states_at(path), images=False))
        if kind != "images":
            inside = episodes_at(str(path)) if kind == "episodes" else demonstrations(path)
            for one in inside:
                reader = EpisodeReader(one.path)
                counts["episodes" if kind == "episodes" else "demonstrations"] += len(reader)
                counts["steps replayed"] += int(reader.lengths.sum())
                reader.close()
        counts["checksums"] += len(read_manifest(path)[0].get("files", {})) if path.is_dir() else 0
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def gallery(named: str, out: Path, columns: int, overwrite: bool) -> str:
    """Write a contact sheet; return a one-line summary."""
    require_output(out, folder=False, overwrite=overwrite)
    found = resolve_datasets(named)
    kind, path = found[0]
    with atomic_write(out, overwrite=overwrite) as temporary:
        if kind == "states":
            states = read_states(states_at(path), images=False)
            write_gallery(temporary, states, columns)
            shown = count = len(states)
            what = "states"
        elif kind == "images":
            shown, what = write_picture_gallery(temporary, path, columns), "pictures"
            count = len(read_table(path, columns=["nx"]))
        else:
            shown = write_episode_gallery(temporary, [one.path for one in found], columns)
            count = sum(len(EpisodeReader(one.path)) for one in found)
            what = "episodes, each at its end"
    return f"{shown} of {count} {what}" if shown < count else f"{count} {what}"


def export(
    named: str,
    out: Path,
    form: str = "compact",
    overwrite: bool = False,
    count: Count = uncounted,
    video: str = "",
) -> str:
    """Export a dataset to another format; return a one-line summary.

    Args:
        named: a path or an id.
        out: a file for one dataset in format compact; otherwise a folder.
        form: the format: compact, lerobot, ogbench, huggingface, minari or curves.
        video: "h264" or "av1" for the pictures of format lerobot as video.
    """
    if video and form != "lerobot":
        raise InvalidInput(f"--video is for --to lerobot, got {video!r} for {form}")
    require_writable(out)  # each exporter then checks what it would replace
    require_own_files(named)
    if form == "huggingface":
        to_huggingface(_sources(named), out, count, overwrite=overwrite)
        size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
        return f"{size / 1e6:.1f} MB to upload"
    if form == "curves":
        path = states_at(resolve_dataset(named, "states").path)
        points = read_states(path, images=False).points
        require_output(out, folder=False, overwrite=overwrite)
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_curves(temporary, [f"state{row}" for row in range(len(points))], points)
        return f"{len(points)} curves"
    found = episodes_at(named)
    if form == "minari":
        to_minari([one.path for one in found], out, overwrite=overwrite)
        return f"a Minari root with {len(found)} datasets; upload the folder in it"
    if form != "compact":
        if len(found) > 1:
            raise InvalidInput(
                f"{named} has {len(found)} datasets; export them to {form} one by one"
            )
        convert(found[0].path, out, form, count, overwrite=overwrite, video=video)
        return f"{len(EpisodeReader(found[0].path))} episodes for {form}"
    refuse_minaris_folder(out)
    if len(found) == 1:
        compact(found[0].path, out, count, overwrite=overwrite)
    else:
        require_output(out, folder=True, overwrite=overwrite)
        with atomic_write(out, overwrite=overwrite) as folder:
            folder.mkdir()
            for one in found:
                compact(one.path, folder / f"{name_of(one.path)}.h5", count)
    readers = [EpisodeReader(path) for path in (sorted(out.iterdir()) if out.is_dir() else [out])]
    size = sum(reader.path.stat().st_size for reader in readers)
    where = f" in {len(readers)} files" if len(readers) > 1 else ""
    return f"{sum(map(len, readers))} episodes{where}, {size / 1e6:.1f} MB"


def require_own_files(named: str) -> None:
    """Require that no file of a dataset is a link to another place.

    Raises:
        InvalidFile: one is; see `require_no_links`.
    """
    root = Path(named) if Path(named).exists() else minari_root() / named
    for kind, path in resolve_datasets(named):
        inside = [one.path for one in demonstrations(path)] if kind == "states" else []
        files = shards(path) if kind == "images" else []
        if kind == "states":
            files = [states_at(path)]
        for dataset in [path] if kind == "episodes" else inside:
            files += dataset_files(episode_file(dataset).parent) if dataset.is_dir() else [dataset]
        require_no_links(root, files)


def _sources(named: str) -> ToUpload:
    """Return the files that a path or an id names, and a title."""
    found = resolve_datasets(named)
    kind, path = found[0]
    title = path.resolve().name
    if kind == "images":
        return ToUpload(title, pictures=path)
    if kind == "states":
        episodes = [one.path for one in demonstrations(path)]
        return ToUpload(title, states=states_at(path), episodes=episodes)
    title = named if len(found) > 1 else dataset_name(path)
    return ToUpload(title, episodes=[one.path for one in found])


def refuse_minaris_folder(out: Path) -> None:
    """Raise InvalidInput if a plain file would be written into Minari's folder."""
    if out.resolve().is_relative_to(minari_root().resolve()):
        raise InvalidInput(
            f"{out} is in Minari's folder, where Minari can't read a plain file: merge with --id"
            " knotgym/name-v0, or give another --out"
        )


def merge_to_minari(
    sources: Sequence[str],
    dataset_id: str,
    root: Path | None,
    overwrite: bool,
    count: Count = uncounted,
) -> str:
    """Merge trajectory datasets into one Minari dataset; return a one-line summary."""
    for source in sources:
        require_own_files(source)
    paths = [resolve_dataset(source, "episodes").path for source in sources]
    made = merge_datasets(paths, dataset_id, root, count, overwrite=overwrite)
    return f"{made}: {len(EpisodeReader(made))} episodes"


def page(named: str, out: Path, overwrite: bool) -> str:
    """Write an HTML page for browsing a dataset; return a one-line summary."""
    require_output(out, folder=False, overwrite=overwrite)
    data = page_data(**_sources(named)._asdict())
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_page(temporary, data)
    return " ".join([f"{data['says']}, {out.stat().st_size / 1e6:.1f} MB.", *data["notices"]])


def merge(sources: Sequence[str], out: Path, overwrite: bool, count: Count = uncounted) -> str:
    """Merge datasets of one kind, or the shards of one run; return a one-line summary."""
    run_shards = [shard for source in sources if (shard := shard_folder_of(source))]
    if run_shards:
        others = len(sources) - len(run_shards)
        if others:
            raise InvalidInput(
                f"shards of a run are only merged with each other; {others} of these"
                f" {len(sources)} are not shards"
            )
        made = merge_shards(run_shards, out, overwrite=overwrite)
        return f"{made} is the whole run, of {len(run_shards)} shards"
    require_output(out, folder=False, overwrite=overwrite)
    refuse_minaris_folder(out)
    for source in sources:
        require_own_files(source)
    found = [resolve_dataset(source) for source in sources]
    kinds = {one.kind for one in found}
    if "images" in kinds:
        raise InvalidInput(
            "perception tables can only be merged as shards of one run (knotgym images --shard)"
        )
    if len(kinds) > 1:
        raise InvalidInput(
            f"states and trajectories can't be merged into one file: {', '.join(sources)}"
        )
    if kinds == {"states"}:
        merged = merge_states([read_states(states_at(path)) for _, path in found], distinct=True)
        with atomic_write(out, overwrite=overwrite) as temporary:
            write_states(temporary, merged)
        return f"{out}: {len(merged)} states"
    paths = [path for _, path in found]
    with atomic_write(out, overwrite=overwrite) as temporary:
        merge_episodes(paths, temporary, concatenate=True, distinct=True, count=count)
    return f"{out}: {len(EpisodeReader(out))} episodes"


def film(named: str, row: int, out: Path, overwrite: bool, progress: Progress) -> str:
    """Replay a state or an episode and write it as a video; return a one-line summary.

    Raises:
        InvalidInput: there is no such row, or it has no recorded actions.
        Failed: the replay ended in another state; nothing is written.
    """
    require_output(out, folder=False, overwrite=overwrite)
    require_film(out)
    kind, path = resolve_dataset(named, "states", "episodes")
    scene = (_state_scene if kind == "states" else _episode_scene)(path, row)
    simulation, steps = simulation_of(1, scene.rope, scene.engine), len(scene.actions)
    simulation.lay(scene.start_qpos[None])
    ropes, pulls = [simulation.points[0].copy()], []
    for step, action in enumerate(scene.actions):
        progress.stage("replaying steps", step, steps)
        beads, forces = simulation.read_actions(action[None])
        pulls.append((int(beads[0]), forces[0] / scene.rope.max_force))
        simulation.act(action[None])
        ropes.append(simulation.points[0].copy())
    if not np.array_equal(simulation.points[0], scene.end):
        raise Failed(
            f"row {row} of {named} ends in another state when replayed: beads differ by up to"
            f" {np.abs(simulation.points[0] - scene.end).max():.3g} m per coordinate"
        )
    progress.stage("writing")
    headings = [f"step {step} of {steps}" for step in range(steps + 1)]
    frames = film_frames(ropes, scene.goal, headings, pulls, scene.reached)
    with atomic_write(out, overwrite=overwrite) as temporary:
        write_film(temporary, frames)
    return f"bit for bit the same, {steps} steps"


class _Scene(NamedTuple):
    """What to replay: actions from a start state to an end state, and the goal shown beside it."""

    engine: str
    rope: RopeConfig
    start_qpos: Array
    actions: NDArray[np.float32]
    end: Array
    goal: Array
    reached: NDArray[np.bool_]


def _state_scene(path: Path, row: int) -> _Scene:
    states = read_states(states_at(path), images=False)
    _require_row(row, len(states))
    if not {"start_qpos", "actions", "steps"} <= states.source.keys():
        raise InvalidInput(
            f"{path} has no recorded actions for its states, so they can't be replayed"
        )
    actions = states.source["actions"][row, : states.source["steps"][row]]
    end = states.points[row]
    reached = np.arange(len(actions) + 1) == len(actions)
    start = states.source["start_qpos"][row]
    return _Scene(states.engine, rope_of(len(end)), start, actions, end, end, reached)


def _episode_scene(path: Path, row: int) -> _Scene:
    reader = EpisodeReader(path)
    _require_row(row, len(reader))
    episode = reader.episode(row)
    reader.close()
    return _Scene(
        reader.task.engine,
        reader.task.rope,
        episode.start_qpos,
        episode.actions,
        episode.points[-1],
        episode.goal_points,
        episode.is_success,
    )


def _require_row(row: int, count: int) -> None:
    if row >= count:
        raise InvalidInput(f"there is no row {row}; the dataset has {count} rows, counted from 0")
