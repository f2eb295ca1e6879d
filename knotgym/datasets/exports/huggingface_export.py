"""Export a dataset as a folder to upload to Hugging Face.

    README.md           the card, with the YAML front matter for the site and `load_dataset`
    croissant.json      a machine-readable description, with responsible-AI fields
    CITATION.cff
    gallery.png         contact sheet of states or pictures
    data/CONFIG/SPLIT-00000-of-00001.parquet      configs: states and steps; or pictures

Load it with `load_dataset(FOLDER, "steps")`. Floats keep their full precision, but only the Minari
dataset (`--to minari`) has everything that is needed to replay an episode.
"""

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import knotgym
from knotgym.common.atomic_files import atomic_write, copy_file, require_output
from knotgym.common.errors import InvalidInput
from knotgym.datasets.cards.citation import (
    citation_file,
    code_span,
    filled,
    plain,
    write_text,
    yaml_string,
)
from knotgym.datasets.cards.fact_tables import table
from knotgym.datasets.episode_dataset import columns_of
from knotgym.datasets.exports.croissant import FileObject, croissant
from knotgym.datasets.exports.parquet_tables import (
    TableColumn,
    picture_columns,
    step_tables,
    write_parquet,
)
from knotgym.datasets.gallery import write_gallery, write_picture_gallery
from knotgym.datasets.image_table import arrow, file_stem, shards
from knotgym.datasets.located import Sources
from knotgym.states.split_names import STATE_SPLITS
from knotgym.states.splits import IMAGE_SPLITS
from knotgym.states.state_file import read_states

_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**6, "100K<n<1M"))


def to_huggingface(
    source: Sources,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write the folder atomically.

    Raises:
        InvalidInput: the sources have no rows.
        Occupied: `out` exists, and `overwrite` is False.
        MissingExtra: pyarrow isn't installed.
    """
    require_output(out, folder=True, overwrite=overwrite)
    arrow()
    with atomic_write(out, overwrite=overwrite) as folder:
        folder.mkdir()
        files = [file for file in _written(source, folder) if file.rows]
        if not files:
            raise InvalidInput(f"{source.title} has no rows, so there is nothing to export")
        rows: Counter[str] = Counter()
        for file in files:
            rows[file.config] += file.rows
        counts = ", ".join(f"{count} {config}" for config, count in rows.items())
        description = (
            f"{counts} of a closed rope in MuJoCo, labelled with Gauss codes; made by knotgym"
            f" {knotgym.__version__}."
        )
        described = croissant(folder, files, source.title, description)
        write_text(folder / "croissant.json", json.dumps(described, indent=1))
        write_text(folder / "CITATION.cff", citation_file(source.title))
        write_text(folder / "README.md", _card(source.title, description, folder, files))


def _written(source: Sources, folder: Path) -> Iterator[FileObject]:
    """Write tables and gallery; yield a description of each file."""
    if source.pictures is not None:
        columns = picture_columns()
        for path in shards(source.pictures):
            split = path.name.split("-")[0]
            if split not in map(file_stem, IMAGE_SPLITS):
                raise InvalidInput(
                    f"{path.name} must begin with a split, as train-00000-of-00001.parquet; splits"
                    f" are {', '.join(map(file_stem, IMAGE_SPLITS))}"
                )
            file = f"data/pictures/{path.name}"
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            copy_file(path, folder / file)
            rows = arrow("pyarrow.parquet").ParquetFile(path).metadata.num_rows
            yield FileObject("pictures", split, file, rows, columns)
        write_picture_gallery(folder / "gallery.png", source.pictures)
    if source.states is not None:
        states = read_states(source.states)
        if len(states):
            write_gallery(folder / "gallery.png", states)
        for split in STATE_SPLITS:
            part = states.taken(np.flatnonzero(states.split == split))
            if len(part):
                file = f"data/states/{split}-00000-of-00001.parquet"
                yield FileObject("states", split, file, *write_parquet(folder / file, [part.table]))
    yield from _steps(source.episodes, folder)


def _steps(paths: Sequence[Path], folder: Path) -> Iterator[FileObject]:
    datasets = [columns_of(path) for path in paths]
    engines = sorted({one.task.engine for one in datasets})
    if len(engines) > 1:
        raise InvalidInput(
            f"trajectories exported together must be of one engine, got {', '.join(engines)};"
            " export those of each engine by themselves"
        )
    pictures = all(one.task.observation in ("pixels", "both") for one in datasets)
    for split in dict.fromkeys(one.task.split for one in datasets):
        own = [one for one in datasets if one.task.split == split]
        tables = (table for one in own for table in step_tables(one, pictures))
        file = f"data/steps/{split}-00000-of-00001.parquet"
        yield FileObject("steps", split, file, *write_parquet(folder / file, tables))


def _card(title: str, description: str, folder: Path, files: Sequence[FileObject]) -> str:
    total, configs, tables = sum(file.rows for file in files), list[str](), list[str]()
    for config in dict.fromkeys(file.config for file in files):
        own = [file for file in files if file.config == config]
        configs += [f"- config_name: {config}", *([] if configs else ["  default: true"])]
        configs += ["  data_files:"]
        for split in dict.fromkeys(file_stem(file.split) for file in own):
            configs.append(f"  - split: {split}\n    path: data/{config}/{split}-*.parquet")
        columns = [(code_span(c.name), _kind(c), plain(c.unit), c.doc) for c in own[0].columns]
        tables += ["", f"## {config}", ""]
        tables += [*table(("split", "rows"), [(file.split, file.rows) for file in own]), ""]
        tables += table(("column", "type", "unit", "contents"), columns)
    gallery = (folder / "gallery.png").is_file()
    return filled(
        "huggingface_card.md",
        pretty_name=yaml_string(title),
        size=next((name for most, name in _SIZES if total < most), "1M<n<10M"),
        configs=configs,
        title=plain(title),
        description=description,
        gallery="![pictures of the rope](gallery.png)" if gallery else "",
        first=files[0].config,
        tables=tables[1:],
    )


def _kind(column: TableColumn) -> str:
    kind = column.kind
    if isinstance(kind, list):
        inner = kind[0] if isinstance(kind[0], str) else "struct"
        return f"list of {kind[1] or 'any number of'} {inner}"
    return kind if isinstance(kind, str) else "struct"
