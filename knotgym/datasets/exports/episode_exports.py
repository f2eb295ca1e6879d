"""Export episodes to Minari, OGBench and stable-worldmodel.

Minari: datasets as a root whose first level is a Hugging Face repository.

    {out}/knotgym/README.md, CITATION.cff, gallery.png, namespace_metadata.json
    {out}/knotgym/tie-nx3/demonstrations-v0/data/       the datasets, byte for byte, and Minari's
                                                        form of those that lack it

`minari.load_dataset` reads them with MINARI_DATASETS_PATH={out}, and downloads them once they are
uploaded to hf://USER. All ids must begin with the same word, which Minari takes as the repository.

OGBench: data files for its agents and reader.

    {out}/{name}-train.npz      nine of ten episodes
    {out}/{name}-val.npz        every tenth episode
    {out}/{name}.npz            the training file again, under the name that the agents look for

An episode of T actions takes T + 1 consecutive rows of each array:

    observations    float32 (300,), vertices of the rope, or uint8 (size, size, 3); never the goal
    actions         float32 (6,); zeros in the last row, which has no action
    terminals       bool, true in the last row

stable-worldmodel: one HDF5 file, its format "hdf5". An episode of T actions takes T + 1 consecutive
rows of each column; `ep_len` (int32) and `ep_offset` (int64) have one row an episode.

    pixels          uint8 (size, size, 3), the rope without its goal
    observation     float32 (300,), its vertices, metres
    action          float32 (6,); NaN in the last row, which has no action
    reward          float32; that of the action, NaN in the last row

OGBench's names: a name consists of task, crossings and policy, as `tie-nx2-expert-v0`, with the
prefix "visual-" for pictures. Without the policy it is the id of the environment, see
`adapters.OGBenchEnv`.
"""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from knotgym.common import Counts, InvalidInput, atomic_write, require_output
from knotgym.datasets.card_texts import citation_file, filled_template, plain, table, write_text
from knotgym.datasets.episode_dataset import FILE, EpisodeDataset, columns_of
from knotgym.datasets.episode_verification import Replay
from knotgym.datasets.located import Located
from knotgym.datasets.minari_form import METADATA, copy_file, data_files, metadata_of, write_minari
from knotgym.datasets.sheets import write_episode_gallery
from knotgym.envs import OBSERVATIONS

_HEAD = ("dataset", "episodes", "steps", "starts", "goals", "pairs", "policy")
_TENTH = 10  # every tenth episode is for validation


def to_minari(source: Located, root: Path, _: Replay) -> str:
    """Write into an empty folder, and return a one-line summary.

    Raises:
        InvalidInput: one is not a Minari dataset, two have the same id, or the ids don't begin
            with the same word.
    """
    entries: dict[str, tuple[object, ...]] = {}
    sources: dict[str, Path] = {}
    for dataset in source.episodes:
        opened = columns_of(dataset)
        file, data = opened.path, opened.path.parent
        metadata = metadata_of(opened)
        if metadata is None or file.name != FILE:  # a file by itself has no folder to copy
            how = "convert it with knotgym dataset merge --id"
            raise InvalidInput(f"{dataset} is not a Minari dataset; {how}")
        name, episodes = metadata.dataset_id, opened.episodes.episodes
        if name in sources:
            raise InvalidInput(f"two datasets have the id {name}: {sources[name]} and {data}")
        steps, counts = int(episodes["length"].sum()), opened.episodes.distinct().values()
        entries[name] = (episodes.rows, steps, *counts, metadata.algorithm_name)
        sources[name] = data
    words = {name.partition("/")[0] for name in sources}
    if len(words) != 1 or any("/" not in name for name in sources):
        raise InvalidInput(
            "ids in one repository must begin with the same word, as knotgym/tie-nx2/expert-v0, got"
            f" {', '.join(sources)}"
        )
    repository = root / words.pop()
    for name, data in Counts.over(sources.items(), "copying datasets", len(sources)):
        (root / name / "data").mkdir(parents=True)
        for file in data_files(data):
            copy_file(file, root / name / "data" / file.name)
        if not (data / METADATA).is_file():
            write_minari(columns_of(root / name))
    about = {"description": "Closed ropes, goals that are Gauss codes.", "namespaces": []}
    namespace = json.dumps({**about, "datasets": sorted(sources)})
    write_text(repository / "namespace_metadata.json", namespace)
    write_text(repository / "CITATION.cff", citation_file(", ".join(sorted(sources))))
    write_episode_gallery(repository / "gallery.png", [*sources.values()])
    rows = [tuple(map(plain, (name, *entries[name]))) for name in sorted(entries)]
    listed = {"first": json.dumps(rows[0][0]), "datasets": table(_HEAD, rows)}
    card = filled_template("minari_card.md", repository=plain(repository.name), **listed)
    write_text(repository / "README.md", card)
    return f"a Minari root with {len(sources)} datasets; upload the folder in it"


def to_ogbench(source: Located, out: Path, _: Replay, overwrite: bool) -> str:
    """Write the files into the folder `out`, and return a one-line summary.

    OGBench reads ~/.ogbench/data. A dataset with both pictures and vertices gives two sets of
    files.

    Raises:
        InvalidInput: several datasets, fewer than two episodes, or neither pictures nor vertices.
        Occupied: a file exists, and `overwrite` is False.
    """
    dataset = _only(source)
    shown, count = dataset.task.observation, len(dataset)
    shows = OBSERVATIONS[shown].parts or (shown,)
    looks = [name for name in shows if OBSERVATIONS[name].ogbench is not None]
    if count < 2 or not looks:
        raise InvalidInput(
            "OGBench needs at least 2 episodes of pixels, state or both, for its training and its"
            f" validation file; {dataset.path} has {count} of {shown}"
        )
    names = {look: f"{OBSERVATIONS[look].ogbench}{_ogbench_name(dataset)}" for look in looks}
    files = [f"{name}{end}.npz" for name in names.values() for end in ("-train", "-val", "")]
    for wanted in files:
        require_output(out / wanted, folder=False, overwrite=overwrite, reads=[source.root])
    validates = np.arange(count) % _TENTH == min(_TENTH, count) - 1
    with atomic_write(out, *files, overwrite=overwrite) as staged:
        for look, name in names.items():
            for end, chosen in (("-val", validates), ("-train", ~validates)):
                arrays = _arrays(dataset.select(chosen), look)
                np.savez_compressed(staged / f"{name}{end}.npz", allow_pickle=False, **arrays)
            shutil.copyfile(staged / f"{name}-train.npz", staged / f"{name}.npz")
    return f"{count} episodes for ogbench"


def _arrays(dataset: EpisodeDataset, look: str) -> dict[str, Any]:
    (rows, steps), last = dataset.episodes, dataset.episodes.last()
    terminals = np.isin(np.arange(steps.rows), last)
    told = Counts.over(range(rows.rows), "drawing episodes")
    seen = np.concatenate([dataset.select([k]).seen(look, alone=True) for k in told])
    return {"observations": seen, "actions": steps["action"], "terminals": terminals}


def to_worldmodel(source: Located, target: Path, _: Replay) -> str:
    """Write a file, and return a one-line summary.

    Raises:
        InvalidInput: several datasets.
    """
    dataset = _only(source)
    episodes, rows = dataset.episodes, len(dataset)
    lengths = np.diff(episodes.offsets)
    with h5py.File(target, "w", libver="latest") as file:  # the reader asks for SWMR
        file["ep_len"], file["ep_offset"] = lengths.astype(np.int32), episodes.offsets[:-1]
        for k in Counts.over(range(rows), "drawing episodes", rows):
            episode = dataset.select([k])
            columns: dict[str, Any] = {
                "pixels": episode.seen("pixels", alone=True),
                "observation": episode.seen("state", alone=True).astype(np.float32),
            }
            for name in ("action", "reward"):
                columns[name] = episode.episodes.steps[name].astype(np.float32)
                columns[name][-1] = np.nan
            for name, values in columns.items():
                if not k:  # a row a chunk: windows begin anywhere
                    shape = int(lengths.sum()), *values.shape[1:]
                    chunk = (1, *shape[1:]) if values.ndim > 2 else True
                    file.create_dataset(name, shape, values.dtype, chunks=chunk, compression="lzf")
                first = episodes.offsets[k]
                file[name][first : first + len(values)] = values
    return f"{rows} episodes, {target.stat().st_size / 1e6:.1f} MB, for stable-worldmodel"


def _only(source: Located) -> EpisodeDataset:
    if len(source.episodes) > 1:
        raise InvalidInput(f"{source.title} has several datasets; export them one by one")
    return columns_of(source.episodes[0])


def _ogbench_name(dataset: EpisodeDataset) -> str:
    """Return task, crossings, policy and version.

    OGBench splits names at dashes, so a policy has underscores instead.
    """
    task, policies = dataset.task, dataset.episodes.episodes["policy"]
    metadata = metadata_of(dataset)  # checks the id, which names files here
    dataset_id = metadata.dataset_id if metadata else f"{policies[0]}-v0"
    policy, _, version = dataset_id.rpartition("/")[2].rpartition("-")
    return f"{task.name}-{re.sub(r'[^0-9A-Za-z_]', '_', policy)}-{version}"
