"""A folder to upload to Hugging Face as it is.

    README.md           the card, with the YAML head that the site and `load_dataset` read
    croissant.json      the same for machines, with responsible-AI fields
    CITATION.cff
    gallery.png         of states or pictures
    data/CONFIG/SPLIT-00000-of-00001.parquet      configs: states and steps; or pictures

`load_dataset(FOLDER, "steps")` reads it. Every float is stored whole; but only the Minari dataset
(`--to minari`) holds everything that makes an episode again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import knotgym
from knotgym.atomic_files import atomic_write, copy_file, require_output
from knotgym.datasets.cards.citation import (
    BIBTEX,
    TO_CITE,
    citation_file,
    code_span,
    plain,
    yaml_string,
)
from knotgym.datasets.cards.state_card import table
from knotgym.datasets.episode_reader import Count, EpisodeReader, uncounted
from knotgym.datasets.exports.croissant import FileObject, croissant
from knotgym.datasets.exports.forms import NothingToExport
from knotgym.datasets.exports.parquet_tables import (
    TableColumn,
    picture_columns,
    state_columns,
    state_rows,
    step_columns,
    step_rows,
    write_parquet,
)
from knotgym.datasets.gallery import write_gallery, write_picture_gallery
from knotgym.datasets.image_table import arrow, file_stem, shards
from knotgym.datasets.page.page_data import dataset_name
from knotgym.datasets.splits import IMAGE_SPLITS, STATE_SPLITS
from knotgym.datasets.states import read_states

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**6, "100K<n<1M"))


class ToUpload(NamedTuple):
    """What a folder is made of.

    Attributes:
        title: of the card.
        states: a state file.
        episodes: datasets.
        pictures: the folder of a perception table.
    """

    title: str
    states: Path | None = None
    episodes: Sequence[Path] = ()
    pictures: Path | None = None


def to_huggingface(
    source: ToUpload,
    out: str | os.PathLike[str],
    count: Count = uncounted,
    *,
    overwrite: bool = False,
) -> None:
    """Write the folder, whole or not at all; `count` is told before each episode.

    Raises:
        NothingToExport: there is no row.
        Occupied: `out` exists, and `overwrite` isn't asked for.
        MissingExtra: pyarrow isn't installed.
    """
    require_output(out, folder=True, overwrite=overwrite)
    arrow()
    with atomic_write(out, overwrite=overwrite) as folder:
        folder.mkdir()
        files = [file for file in _written(source, folder, count) if file.rows]
        if not files:
            raise NothingToExport(f"{source.title} holds no rows, so there is nothing to export")
        told = ", ".join(f"{sum(f.rows for f in files if f.config == name)} {name}"
                         for name in dict.fromkeys(file.config for file in files))  # fmt: skip
        description = (
            f"{told} of a closed rope in MuJoCo, labelled with Gauss codes; made by knotgym"
            f" {knotgym.__version__}."
        )
        said = croissant(
            folder,
            files,
            name=source.title,
            description=description,
            version="1.0.0",
            citation=BIBTEX,
        )
        _write(folder / "croissant.json", json.dumps(said, indent=1))
        _write(folder / "CITATION.cff", citation_file(source.title))
        _write(folder / "README.md", "\n".join(_card(source.title, description, folder, files)))


def _written(source: ToUpload, folder: Path, count: Count) -> Iterator[FileObject]:
    """Write the tables, and the gallery; what they are."""
    if source.pictures is not None:
        columns = picture_columns()
        for path in shards(source.pictures):
            split = path.name.split("-")[0]
            if split not in map(file_stem, IMAGE_SPLITS):
                raise NothingToExport(
                    f"{path.name} must begin with a split, as train-00000-of-00001.parquet; there"
                    f" are {', '.join(map(file_stem, IMAGE_SPLITS))}"
                )
            place = f"data/pictures/{path.name}"
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            copy_file(path, folder / place)
            rows = arrow("pyarrow.parquet").ParquetFile(path).metadata.num_rows
            yield FileObject("pictures", split, place, rows, columns)
        write_picture_gallery(folder / "gallery.png", source.pictures)
    if source.states is not None:
        states = read_states(source.states)
        if len(states):
            write_gallery(folder / "gallery.png", states)
        for split in STATE_SPLITS:
            part = states.taken(np.flatnonzero(states.split == split))
            if len(part):
                place = f"data/states/{split}-00000-of-00001.parquet"
                columns = state_columns(part)
                written = write_parquet(folder / place, columns, state_rows(part))
                yield FileObject("states", split, place, written, columns)
    yield from _steps(source.episodes, folder, count)


def _steps(datasets: Sequence[Path], folder: Path, count: Count) -> Iterator[FileObject]:
    readers = [(EpisodeReader(path), dataset_name(path)) for path in datasets]
    if not readers:
        return
    pictures = all(reader.stored in ("pixels", "both") for reader, _ in readers)
    columns = step_columns(pictures, readers[0][0].column(0, "points").shape[1])
    for split in dict.fromkeys(reader.task.split for reader, _ in readers):
        own = [(reader, name) for reader, name in readers if reader.task.split == split]
        rows = (row for reader, name in own for row in step_rows(reader, name, pictures, count))
        place = f"data/steps/{split}-00000-of-00001.parquet"
        yield FileObject(
            "steps", split, place, write_parquet(folder / place, columns, rows), columns
        )
    for reader, _ in readers:
        reader.close()


def _card(title: str, description: str, folder: Path, files: Sequence[FileObject]) -> Iterator[str]:
    """The lines of README.md. JSON strings are YAML too."""
    configs = list(dict.fromkeys(file.config for file in files))
    total = sum(file.rows for file in files)
    size = next((name for most, name in _SIZES if total < most), "1M<n<10M")
    yield from ("---", "license: cc-by-4.0", f"pretty_name: {yaml_string(title)}")
    yield "tags: [knot-theory, gauss-code, mujoco, spatial-reasoning, reinforcement-learning]"
    yield from ("task_categories: [reinforcement-learning, image-to-text]", "language: [en]")
    yield from (f"size_categories: [{json.dumps(size)}]", "configs:")
    for config in configs:
        yield f"- config_name: {config}"
        if config == configs[0]:
            yield "  default: true"
        yield "  data_files:"
        for split in _splits(files, config):
            yield f"  - split: {split}\n    path: data/{config}/{split}-*.parquet"
    yield "dataset_info:"
    for config in configs:
        yield from _info(folder, config, [file for file in files if file.config == config])
    yield from ("---", "", f"# {plain(title)}", "", description, "")
    if (folder / "gallery.png").is_file():
        yield from ("![the rope, picture by picture](gallery.png)", "")
    yield from ("```python", "from datasets import load_dataset", "")
    yield from (f'rows = load_dataset("USER/NAME", "{configs[0]}")', "```", "")
    for config in configs:
        columns = next(file.columns for file in files if file.config == config)
        yield from (f"## {config}", "")
        counts = [(file.split, file.rows) for file in files if file.config == config]
        yield from (*table(("split", "rows"), counts), "")
        rows = [(code_span(one.name), _kind(one), plain(one.unit), one.doc) for one in columns]
        yield from (*table(("column", "type", "unit", "holds"), rows), "")
    yield from TO_CITE
    yield from ("## Licence", "", "[CC-BY-4.0](https://creativecommons.org/licenses/by/4.0/)", "")


def _splits(files: Sequence[FileObject], config: str) -> list[str]:
    return list(dict.fromkeys(file_stem(file.split) for file in files if file.config == config))


def _info(folder: Path, config: str, files: Sequence[FileObject]) -> Iterator[str]:
    """What `datasets` calls a DatasetInfo: features, rows and bytes; a JSON object is YAML too."""
    sizes: Mapping[str, Any] = {file.path: (folder / file.path).stat().st_size for file in files}
    splits = []
    for split in _splits(files, config):
        own = [file for file in files if file_stem(file.split) == split]
        count = {"num_examples": sum(file.rows for file in own)}
        splits.append({"name": split, "num_bytes": sum(sizes[file.path] for file in own), **count})
    yield f"- config_name: {config}"
    yield "  features:"
    for column in files[0].columns:
        yield f"  - {json.dumps({'name': column.name, **_yaml_feature(column)})}"
    yield f"  splits: {json.dumps(splits)}"
    yield f"  download_size: {sum(sizes.values())}"
    yield f"  dataset_size: {sum(sizes.values())}"


def _yaml_feature(column: TableColumn) -> dict[str, Any]:
    """A feature as cards spell it: {"dtype": "int64"}, {"list": "float64", "length": 6}, ..."""

    def spelt(kind: Any) -> dict[str, Any]:
        if isinstance(kind, dict):
            return {"struct": [{"name": name, **spelt(inner)} for name, inner in kind.items()]}
        if isinstance(kind, list):
            inner = spelt(kind[0])
            listed = inner.get("dtype", inner.get("struct"))
            return {"list": listed, **({} if kind[1] is None else {"length": kind[1]})}
        return {"dtype": kind}

    return spelt(column.kind)


def _kind(column: TableColumn) -> str:
    kind = column.kind
    if isinstance(kind, list):
        inner = kind[0] if isinstance(kind[0], str) else "struct"
        return f"list of {kind[1] or 'any number of'} {inner}"
    return kind if isinstance(kind, str) else "struct"


def _write(path: Path, text: str) -> None:
    path.write_text(text + ("" if text.endswith("\n") else "\n"), encoding="utf-8")
