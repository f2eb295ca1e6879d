"""Export a dataset as a folder to upload to Hugging Face.

    README.md           the card, with the YAML front matter for the site and `load_dataset`
    croissant.json      a machine-readable description, with responsible-AI fields
    CITATION.cff
    gallery.png         contact sheet of states
    data/CONFIG/SPLIT-00000-of-00001.parquet      configs: states and steps

Load it with `load_dataset(FOLDER, "steps")`. Floats keep their full precision, but only the Minari
dataset (`--to minari`) has everything that is needed to replay an episode. A folder of pictures is
ready to upload as it is: it has its card and Parquet files already.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

import knotgym
from knotgym.common import InvalidInput, Table
from knotgym.datasets.cards.citation import (
    citation_file,
    filled,
    plain,
    write_text,
    yaml_string,
)
from knotgym.datasets.cards.croissant import write_croissant
from knotgym.datasets.cards.fact_tables import in_words, table
from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episode_verification import Replay, show_episodes
from knotgym.datasets.exports.parquet_tables import rows_of_steps, step_tables, write_parquet
from knotgym.datasets.gallery import episode_tiles, state_tiles, write_gallery
from knotgym.datasets.image_table import arrow
from knotgym.datasets.located import Located
from knotgym.states import STATE_SPLITS, read_states

_OF_FILES = ("path", "bytes", "bytes_per_step", "form")  # of files that aren't exported
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**6, "100K<n<1M"))


def to_huggingface(source: Located, folder: Path, _: Replay) -> str:
    """Write into an empty folder, and return a one-line summary.

    Raises:
        InvalidInput: the sources have no rows, or are pictures.
        MissingExtra: pyarrow isn't installed.
    """
    if source.pictures is not None:
        raise InvalidInput(f"{source.pictures} is ready to upload as it is: it has a card already")
    arrow()
    rows, pages = dict[str, dict[str, int]](), dict[str, str]()  # by config, and split
    for config, split, tables in _tables(source):
        path = folder / f"data/{config}/{split}-00000-of-00001.parquet"
        count, page = write_parquet(path, tables)
        if count:
            rows.setdefault(config, {})[split], pages[config] = count, page
    if not rows:
        raise InvalidInput(f"{source.title} has no rows, so there is nothing to export")
    if source.states is not None:
        tiles = state_tiles(read_states(source.states, images=False))
    else:
        tiles = episode_tiles(source.episodes)
    write_gallery(folder / "gallery.png", tiles)
    write_text(folder / "CITATION.cff", citation_file(source.title))
    counts = {config: sum(splits.values()) for config, splits in rows.items()}
    datasets = [columns_of(path) for path in source.episodes]
    engines = [one.task.engine for one in datasets]
    if source.states is not None:
        engines.append(read_states(source.states, images=False).engine)
    description = (
        f"{', '.join(f'{count} {config}' for config, count in counts.items())} of a closed rope"
        f" (engine {' and '.join(dict.fromkeys(engines))}), labelled with Gauss codes; made by"
        f" knotgym {knotgym.__version__}."
    )
    if datasets:
        pages["steps"] = f"{_facts(datasets)}\n\n{pages['steps']}"
    write_text(folder / "README.md", _card(source.title, engines, description, rows, pages))
    write_croissant(folder, source.title, description)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return f"{size / 1e6:.1f} MB to upload"


def _facts(datasets: Sequence[EpisodeDataset]) -> str:
    """Return what `dataset show` says of episodes, a column for each dataset, in Markdown."""
    every = [show_episodes(one) for one in datasets]
    rows = [
        (name, *(plain(in_words(one[name])) for one in every))
        for name in every[0]
        if name not in _OF_FILES and any(in_words(one[name]) for one in every)
    ]
    return "\n".join(table(("", *(plain(one.name) for one in datasets)), rows))


def _tables(source: Located) -> Iterator[tuple[str, str, Iterable[Table]]]:
    """Yield config, split and tables of each Parquet file."""
    if source.states is not None:
        states = read_states(source.states)
        for split in STATE_SPLITS:
            part = states.take(np.flatnonzero(states.split == split)).table
            yield "states", split, [part] if part.rows else []
    datasets = [columns_of(path) for path in source.episodes]
    if len({one.task.engine for one in datasets}) > 1:
        raise InvalidInput(
            "trajectories exported together must be of one engine; export those of each engine by"
            " themselves"
        )
    pictures = all(one.task.observation in ("pixels", "both") for one in datasets)
    columns = rows_of_steps(datasets, pictures)
    for split in dict.fromkeys(one.task.split for one in datasets):
        own = [one for one in datasets if one.task.split == split]
        tables = (part for one in own for part in step_tables(one, columns))
        yield "steps", split.replace("-", "_"), tables  # Hugging Face's splits have no dashes


def _card(
    title: str,
    engines: Iterable[str],
    description: str,
    rows: Mapping[str, Mapping[str, int]],
    pages: Mapping[str, str],
) -> str:
    configs, tables = list[str](), list[str]()
    for config, splits in rows.items():
        configs += [f"- config_name: {config}", *([] if configs else ["  default: true"])]
        configs += ["  data_files:"]
        for split in splits:
            configs.append(f"  - split: {split}\n    path: data/{config}/{split}-*.parquet")
        tables += ["", f"## {config}", "", *table(("split", "rows"), splits.items()), ""]
        tables.append(pages[config])
    total = sum(sum(splits.values()) for splits in rows.values())
    return filled(
        "huggingface_card.md",
        pretty_name=yaml_string(title),
        size=next((name for most, name in _SIZES if total < most), "1M<n<10M"),
        configs=configs,
        engines=", ".join(dict.fromkeys(engines)),
        title=plain(title),
        description=description,
        gallery="![pictures of the rope](gallery.png)",
        first=next(iter(rows)),
        tables=tables[1:],
    )
