"""Export a dataset as a folder to upload to Hugging Face.

    README.md           the card, with the YAML front matter for the site and `load_dataset`
    croissant.json      a machine-readable description, with responsible-AI fields
    CITATION.cff
    gallery.png         contact sheet of states
    data/CONFIG/SPLIT-00000-of-00001.parquet      configs: states and steps

Load it with `load_dataset(FOLDER, "steps")`. Floats keep their full precision, but only the Minari
dataset (`--to minari`) has everything that is needed to replay an episode. A folder of pictures is
ready to upload as it is: it has its card and Parquet files already.

Arrays are stored flat, in C order. Column names have an underscore where the state file has a
slash.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import Counts, InvalidInput, Schema, Table
from knotgym.datasets import card_texts as cards
from knotgym.datasets.croissant import write_croissant
from knotgym.datasets.episode_dataset import EpisodeDataset, columns_of
from knotgym.datasets.episode_verification import Replay
from knotgym.datasets.episodes import STEPS, Episodes, columns_in, gauss_codes
from knotgym.datasets.image_table import arrow, picture_column, shown
from knotgym.datasets.located import Located
from knotgym.datasets.png import encode
from knotgym.datasets.sheets import write_episode_gallery
from knotgym.datasets.state_card import write_gallery
from knotgym.datasets.summaries import in_words, show_episodes
from knotgym.envs import OBSERVATIONS
from knotgym.states import SPLITS, States, read_states, repeated

_OF_FILES = ("path", "bytes", "bytes_per_step", "form")  # of files that aren't exported
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (10**6, "100K<n<1M"))
_AT_ONCE = 256  # episodes converted at once
_KEPT = tuple(
    column._replace(name="points") if column.name == "observation" else column
    for column in STEPS.columns
    if column.name not in ("visits", "signs")
)
ROWS_OF_STEPS = Schema("steps", (*columns_in("hub"), *_KEPT, *columns_in("picture")), own=STEPS.own)


def to_huggingface(source: Located, folder: Path, _: Replay) -> str:
    """Write into an empty folder, and return a one-line summary.

    Raises:
        InvalidInput: the sources have no rows, or are pictures.
        MissingExtra: pyarrow isn't installed.
    """
    if source.pictures is not None:
        raise InvalidInput(f"{source.pictures} is ready to upload as it is: it has a card already")
    arrow()
    states = None if source.states is None else read_states(source.states)
    datasets = [columns_of(path) for path in source.episodes]
    # the column `dataset` tells them apart
    for first, other in repeated(dataset.name for dataset in datasets):
        raise InvalidInput(
            f"two datasets have the id {datasets[first].name}: {source.episodes[first]} and"
            f" {source.episodes[other]}"
        )
    rows, pages = dict[str, dict[str, int]](), dict[str, str]()  # by config, and split
    for config, split, tables in _tables(states, datasets):
        path = folder / f"data/{config}/{split}-00000-of-00001.parquet"
        count, page = _write_parquet(path, tables)
        if count:
            rows.setdefault(config, {})[split], pages[config] = count, page
    if not rows:
        raise InvalidInput(f"{source.title} has no rows, so there is nothing to export")
    if states is None:
        write_episode_gallery(folder / "gallery.png", source.episodes)
    else:
        write_gallery(folder / "gallery.png", states)
    cards.write_text(folder / "CITATION.cff", cards.citation_file(source.title))
    counts = {config: sum(splits.values()) for config, splits in rows.items()}
    engines = [dataset.task.engine for dataset in datasets]
    engines += [] if states is None else [states.engine]
    # an episode of T steps has T + 1 rows, one for each state
    words = {"steps": "states in episodes"}
    description = (
        f"{', '.join(f'{n} {words.get(config, config)}' for config, n in counts.items())} of a"
        " closed rope"
        f" (engine {' and '.join(dict.fromkeys(engines))}), labelled with Gauss codes; made by"
        f" knotgym {knotgym.__version__}."
    )
    if datasets:
        pages["steps"] = f"{_facts(datasets)}\n\n{pages['steps']}"
    cards.write_text(folder / "README.md", _card(source.title, engines, description, rows, pages))
    write_croissant(folder, source.title, description)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return f"{size / 1e6:.1f} MB to upload"


def _facts(datasets: Sequence[EpisodeDataset]) -> str:
    """Return what `dataset show` says of episodes, a column for each dataset, in Markdown."""
    every = [show_episodes(dataset) for dataset in datasets]
    rows = [
        (name, *(cards.plain(in_words(facts[name])) for facts in every))
        for name in every[0]
        if name not in _OF_FILES and any(in_words(facts[name]) for facts in every)
    ]
    return "\n".join(cards.table(("", *(cards.plain(dataset.name) for dataset in datasets)), rows))


def _tables(
    states: States | None, datasets: Sequence[EpisodeDataset]
) -> Iterator[tuple[str, str, Iterable[Table]]]:
    """Yield config, split and tables of each Parquet file."""
    if states is not None:
        for split in (name for name, record in SPLITS.items() if record.of_states):
            part = states.take(np.flatnonzero(states.split == split)).table
            yield "states", split, [part] if part.rows else []
    if len({dataset.task.engine for dataset in datasets}) > 1:
        raise InvalidInput("episodes exported together are of one engine; export each by itself")
    pictures = all("picture" in OBSERVATIONS[dataset.task.observation].goal for dataset in datasets)
    tables = [dataset.episodes.steps for dataset in datasets]
    stored = {name: table[name] for table in tables for name in table}
    lacking = [c.name for c in _KEPT if c.optional and c.name not in stored]
    schema = ROWS_OF_STEPS.with_own(stored).without(*lacking, *([] if pictures else ["image"]))
    for split in dict.fromkeys(dataset.task.split for dataset in datasets):
        of_split = [dataset for dataset in datasets if dataset.task.split == split]
        parts = (part for dataset in of_split for part in _step_tables(dataset, schema, pictures))
        yield "steps", split.replace("-", "_"), parts  # Hugging Face's splits have no dashes


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
        tables += ["", f"## {config}", "", *cards.table(("split", "rows"), splits.items()), ""]
        tables.append(pages[config])
    total = sum(map(sum, (splits.values() for splits in rows.values())))
    return cards.filled_template(
        "huggingface_card.md",
        pretty_name=cards.yaml_string(title),
        size=next((name for most, name in _SIZES if total < most), "1M<n<10M"),
        configs=configs,
        engines=", ".join(dict.fromkeys(engines)),
        title=cards.plain(title),
        description=description,
        gallery="![pictures of the rope](gallery.png)",
        first=next(iter(rows)),
        tables=tables[1:],
    )


def _step_tables(dataset: EpisodeDataset, schema: Schema, pictures: bool) -> Iterator[Table]:
    """Yield a dataset's states, one row each, in tables of some episodes.

    Args:
        dataset: columns.
        schema: of the file; optional columns that the dataset lacks hold their value for unknown.
        pictures: whether it has them.
    """
    count, offsets = len(dataset), dataset.episodes.offsets
    for first in range(0, count, _AT_ONCE):
        Counts.tell("writing steps", Counts.from_now(int(offsets[first])), int(offsets[-1]))
        part = dataset.select(np.arange(first, min(first + _AT_ONCE, count)))
        (rows, steps), episode = part.episodes, part.episodes.episode_of()
        columns: dict[str, NDArray[Any]] = {
            **steps,
            "points": steps["observation"],
            "dataset": np.full(steps.rows, part.name),
            "policy": rows["policy"][episode],
            "gauss_code": gauss_codes(steps["visits"]),
            "gauss_code_chiral": gauss_codes(steps["visits"], steps["signs"]),
            "goal_gauss_code": gauss_codes(rows["goal_visits"])[episode],
            "episode": first + episode,
            "step": Episodes.ranges(np.zeros_like(rows["length"]), rows["length"] + 1),
            "is_last": np.isin(np.arange(steps.rows), part.episodes.last()),
            "is_success": part.episodes.goal_reached(part.task),
            "goal_points": rows["goal_points"][episode],
        }
        if pictures:
            columns["image"] = part.seen("pixels")[..., :3]
        yield Table(ROWS_OF_STEPS.with_own(columns), columns).filled(schema)


def _write_parquet(path: Path, tables: Iterable[Table]) -> tuple[int, str]:
    """Append tables of equal columns to one file; return its rows and a page of its columns."""
    parts = iter(tables)
    if (part := next(parts, None)) is None:
        return 0, ""
    path.parent.mkdir(parents=True, exist_ok=True)
    made, rows, page = _arrow_table(part), part.rows, part.schema.page()
    parquet = arrow("pyarrow.parquet")
    with parquet.ParquetWriter(path, made.schema, compression="zstd") as writer:
        writer.write_table(made, row_group_size=1000)
        for part in parts:
            writer.write_table(_arrow_table(part), row_group_size=1000)
            rows += part.rows
    return rows, page


def _encoded(picture: NDArray[np.uint8]) -> bytes:
    Counts.end_item()  # a step is written when its picture is, which takes longest
    return encode(picture)


def _arrow_table(given: Table) -> Any:
    """Convert a table; its metadata say where Hugging Face finds pictures."""
    pa, columns = arrow(), dict[str, Any]()
    for name, values in given.items():
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        if name == "image":
            column = picture_column(map(_encoded, values))
        elif values.ndim > 1:
            column = pa.FixedSizeListArray.from_arrays(pa.array(flat.ravel()), flat.shape[1])
        else:
            column = pa.array(values.tolist() if values.dtype.kind == "U" else values)
        columns[name.replace("/", "_")] = column
    return pa.table(columns, metadata=shown("image") if "image" in columns else None)
