"""Export Minari datasets as a Minari root whose first level is a Hugging Face repository.

    {out}/knotgym/README.md, CITATION.cff, gallery.png, namespace_metadata.json
    {out}/knotgym/tie-nx3/demonstrations-v0/data/       the datasets, byte for byte, and Minari's
                                                        form of those that lack it

`minari.load_dataset` reads them with MINARI_DATASETS_PATH={out}, and downloads them once they are
uploaded to hf://USER. All ids must begin with the same word, which Minari takes as the repository.
"""

import json
from pathlib import Path

from knotgym.common import Counts, InvalidInput
from knotgym.datasets.cards import citation_file, filled_template, plain, table, write_text
from knotgym.datasets.episode_dataset import FILE, columns_of
from knotgym.datasets.episode_verification import Replay
from knotgym.datasets.gallery import episode_tiles, write_gallery
from knotgym.datasets.located import Located
from knotgym.datasets.minari_form import (
    METADATA,
    copy_file,
    dataset_files,
    metadata_of,
    write_minari,
)

_HEAD = ("dataset", "episodes", "steps", "starts", "goals", "pairs", "policy")


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
            raise InvalidInput(
                f"{dataset} is not a Minari dataset; convert it with knotgym dataset merge --id"
            )
        name, own = metadata.dataset_id, opened.episodes.episodes
        if name in sources:
            raise InvalidInput(f"two datasets have the id {name}: {sources[name]} and {data}")
        steps, counts = int(own["length"].sum()), opened.episodes.distinct().values()
        entries[name] = (own.rows, steps, *counts, metadata.algorithm_name)
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
        for file in dataset_files(data):
            copy_file(file, root / name / "data" / file.name)
        if not (data / METADATA).is_file():
            write_minari(columns_of(root / name), root / name / "data")
    namespace = {"description": "Closed ropes, goals that are Gauss codes."}
    listed = {**namespace, "datasets": sorted(sources), "namespaces": []}
    write_text(repository / "namespace_metadata.json", json.dumps(listed))
    write_text(repository / "CITATION.cff", citation_file(", ".join(sorted(sources))))
    write_gallery(repository / "gallery.png", episode_tiles([*sources.values()]))
    write_text(repository / "README.md", _card(repository.name, entries))
    return f"a Minari root with {len(sources)} datasets; upload the folder in it"


def _card(repository: str, entries: dict[str, tuple[object, ...]]) -> str:
    rows = [tuple(map(plain, (name, *entry))) for name, entry in sorted(entries.items())]
    return filled_template(
        "minari_card.md",
        repository=plain(repository),
        first=json.dumps(rows[0][0]),
        datasets=table(_HEAD, rows),
    )
