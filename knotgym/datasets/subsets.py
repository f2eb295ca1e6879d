"""Select, split and delete rows of datasets: states, episodes or pictures.

The result is a file of rows: a state file, an episode file or a Parquet file. It has under
"selection" the sources and the conditions. Pictures and pulls are copied, not made again.
Conditions are SQL, such as `nx = 3 and success and length < 30`. polars evaluates them on a table
of the columns and nothing else: a condition that contains a query, by which SQL could read files,
is refused before it is parsed. As in polars, division by zero is infinite, and NaN is no value.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import knotgym
from knotgym.common import (
    Array,
    Ids,
    InvalidFile,
    InvalidInput,
    MissingExtra,
    Stream,
    atomic_write,
    one_line,
    sha256,
)
from knotgym.datasets import image_table
from knotgym.datasets.episode_dataset import EpisodeDataset, open_episodes, write_episodes
from knotgym.datasets.episodes import gauss_codes
from knotgym.datasets.located import locate, require_file
from knotgym.states import States, families, read_states, resolve, write_states

_RANGE = re.compile(r"\s*([0-9]{1,9})(?:-([0-9]{1,9}))?\s*")
_PART = re.compile(r"([A-Za-z0-9_]+)=([0-9]{0,9}\.?[0-9]{1,9})")
_LONGEST = 2000  # characters
_QUOTED = re.compile(r"'[^']*'|\"[^\"]*\"")
_QUERY = re.compile(r"\b(select|from)\b", re.IGNORECASE)


def select(
    source: str | Path,
    out: str | Path,
    *,
    where: str = "",
    sample: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Path:
    """Write the rows that fulfil a condition as a new file; return its path.

    Args:
        source: a state file, the folder of a run, an included set, a folder or file of pictures, an
            episode file, or the folder or id of a Minari dataset.
        out: the new file.
        where: a condition on the columns in SQL, see this module; "" for all rows.
        sample: keep this many of them, drawn at random; their order stays.
        seed: of the draw.
        overwrite: replace what is there.

    Raises:
        InvalidInput: `where` isn't a condition on these columns.
        InvalidInput: no row is left, or fewer than `sample` are.
        Occupied: the output exists.
    """
    given = opened(source)
    chosen = _matching_rows(where, given.columns()) if where else np.ones(given.size, dtype=bool)
    rows = np.flatnonzero(chosen)
    if sample is not None:
        if not 0 < sample <= len(rows):
            raise InvalidInput(f"{len(rows)} rows match, can't sample {sample} of them")
        rows = np.sort(Stream.SELECTION.generator(seed).choice(rows, sample, replace=False))
    how = {"where": where} if where else {}
    drawn = {"sample": sample, "seed": seed} if sample else {}
    return _write_rows(given, str(source), rows, how | drawn, Path(out), overwrite)


def delete(source: str | Path, rows: str, out: str | Path, *, overwrite: bool = False) -> Path:
    """Write a dataset without some rows as a new file; return its path.

    Args:
        source: as for `select`.
        rows: numbers of rows, which for episodes are those of the episodes, such as "3,7-9".
        out: the new file.
        overwrite: replace what is there.

    Raises:
        InvalidInput: there is no such row, or none would be left.
        Occupied: the output exists.
    """
    given = opened(source)
    left = np.ones(given.size, dtype=bool)
    for word in rows.split(","):
        range_ = _RANGE.fullmatch(word)
        if not range_ or not int(range_[1]) <= (last := int(range_[2] or range_[1])) < given.size:
            raise InvalidInput(
                f"rows of {source} are numbers such as 3,7-9 below {given.size}, got {word!r}"
            )
        left[int(range_[1]) : last + 1] = False
    rest = np.flatnonzero(left)
    return _write_rows(given, str(source), rest, {"deleted": rows}, Path(out), overwrite)


def split(
    source: str | Path, parts: str, out: str | Path, *, seed: int = 0, overwrite: bool = False
) -> list[Path]:
    """Write a dataset as several files, by fractions of its rows; return their paths in order.

    What belongs together stays together: near-duplicates; rows of one rope;
    episodes with a common start or goal state that has crossings (all start or end in the few plain
    loops). The column `split` isn't changed.

    Args:
        source: as for `select`.
        parts: names and fractions that add up to 1, such as "train=0.8,val=0.2".
        out: the new files, "-NAME" appended before the suffix.
        seed: of the random assignment.
        overwrite: replace what is there.

    Raises:
        InvalidInput: the parts aren't fractions of 1, or the rows can't be dealt to so many.
        Occupied: an output exists.
    """
    shares, whole = _shares(parts), Path(out)
    given = opened(source)
    together = _groups(given.shared())
    dealt = _dealt(together, [*shares.values()], Stream.SELECTION.generator(seed, 1))
    if len(set(dealt.tolist())) < len(shares):
        many = f"{together.max() + 1} groups of rows that share something"
        raise InvalidInput(f"{source} can't be cut into {len(shares)} parts: it has {many}")
    names = {part: f"{whole.stem}-{part}{whole.suffix}" for part in shares}
    for name in names.values():
        _require(whole.with_name(name), given, given.digested, overwrite)
    with atomic_write(whole.parent, *names.values(), overwrite=overwrite) as staged:
        for k, (part, name) in enumerate(names.items()):
            rows, how = np.flatnonzero(dealt == k), {"parts": shares, "seed": seed, "part": part}
            _write_rows(given, str(source), rows, how, staged / name)
    return [whole.with_name(name) for name in names.values()]


def kept(path: Path, first: Path | None = None) -> str:
    """Say how many rows of its source a selected dataset has; of a part of a split also how many
    states it shares with the `first` part.
    """
    rows = opened(path)
    said = f"{rows.earlier[-1]['kept']} of {rows.earlier[-1]['rows']} rows"
    if first is None or first == path or not isinstance(rows.data, EpisodeDataset):
        return said
    mine, other = rows.data.episodes.episodes, open_episodes(first).episodes.episodes
    states = {name: {*mine[name].tolist()} for name in ("start", "goal")}
    shared = {name: rows & {*other[name].tolist()} for name, rows in states.items()}
    counts = (f"{len(shared[name])} of its {len(rows)} {name}s" for name, rows in states.items())
    why = "; only states without crossings may" * any(shared.values())
    return f"{said}; {', '.join(counts)} stand in {first.name}, too{why}"


class _Rows(NamedTuple):
    """A dataset as rows: a state, an episode and a picture are one row each.

    Attributes:
        data: the dataset itself.
        digested: the file whose checksum identifies it.
        size: number of rows.
        earlier: the selections by which it was made.
        columns: returns name -> one value per row.
        shared: returns int64 (size, 2), what rows that must stay in one part have in common; -1 if
            nothing.
        write: writes rows to a new file, with the selections by which that is made.
    """

    data: Any
    digested: Path
    size: int
    earlier: Any
    columns: Callable[[], Mapping[str, NDArray[Any]]]
    shared: Callable[[], Ids]
    write: Callable[[Ids, list[Any], Path], Any]


def opened(source: str | Path) -> _Rows:
    """Open a dataset by its path, name or id.

    Raises:
        MissingFile, InvalidInput, InvalidFile: as `locate`; or it is several datasets.
    """
    located = locate(str(source)).only()
    if located.pictures:
        rows = _of_pictures(located.pictures)
    else:
        rows = _of_states(located.states) if located.states else _of_episodes(located.episodes[0])
    made = rows.earlier  # which may be a stranger's
    if not isinstance(made, list) or not all(isinstance(each, dict) for each in made):
        raise InvalidFile(f"{source}: its selection should be a list of objects, got {made!r:.80}")
    return rows


def _of_states(path: Path) -> _Rows:
    states = read_states(path)
    table = states.table
    flat = {name.replace("/", "."): table[name] for name in table if table[name].ndim == 1}
    ropes = states.source.get("seed", np.arange(len(states))[:, None])
    return _Rows(
        states,
        path,
        len(states),
        states.attributes.get("selection", []),
        lambda: {"row": np.arange(len(states)), **flat},
        lambda: _families_and_ropes(states.points, ropes),
        lambda rows, made, out: write_states(out, states.take(rows).replaced({}, selection=made)),
    )


def _of_pictures(path: Path) -> _Rows:
    table = image_table.read_table(path, images=False)
    with InvalidFile.instead(f"{path}: its selection isn't JSON", ValueError):
        earlier = json.loads((table.schema.metadata or {}).get(b"selection", b"[]"))

    def _columns() -> dict[str, NDArray[Any]]:
        # a struct becomes source.rope, ...
        flat, kinds = table.flatten(), image_table.arrow("pyarrow.types")
        return {
            name: np.array(values.to_pylist())
            for name, values in zip(flat.column_names, flat.columns, strict=True)
            if not kinds.is_nested(values.type)
        }

    def _shared() -> Ids:
        columns = _columns()
        ropes = np.stack([columns["source.seed"], columns["source.rope"]], axis=1)
        return _families_and_ropes(image_table.points_of(table), ropes)

    def _write(rows: Ids, made: list[Any], out: Path) -> None:
        taken = image_table.read_table(path).take(rows)
        metadata = {**(taken.schema.metadata or {}), b"selection": json.dumps(made)}
        out.write_bytes(image_table.parquet(taken.replace_schema_metadata(metadata)))

    return _Rows(table, image_table.shards(path)[0], len(table), earlier, _columns, _shared, _write)


def _of_episodes(path: Path) -> _Rows:
    dataset = open_episodes(path)
    (episodes, steps), task = dataset.episodes, dataset.task

    def _columns() -> dict[str, NDArray[Any]]:
        single = _single_of(dataset)
        columns = {
            "episode": np.arange(episodes.rows),
            **{name: values for name, values in episodes.items() if values.ndim == 1},
            "goal_gauss_code": gauss_codes(episodes["goal_visits"]),
            "task": np.array([each.task for each in task.singles])[single],
            "nx": np.array([each.nx for each in task.singles])[single],
            "split": np.full(episodes.rows, task.split),
        }
        if "visits" in steps:
            first, last = dataset.episodes.offsets[:-1], dataset.episodes.last()
            columns |= {name: steps[name][last - 1] for name in ("terminated", "truncated")}
            columns["start_gauss_code"] = gauss_codes(steps["visits"][first])
            columns["final_gauss_code"] = gauss_codes(steps["visits"][last])
        return columns

    def _shared() -> Ids:
        # states without crossings are shared by nearly all episodes
        tangled = np.array([each.sides[0] > 0 for each in task.singles])[_single_of(dataset)]
        goals = np.where(episodes["goal_visits"].any(axis=1), episodes["goal"], -1)
        return np.stack([np.where(tangled, episodes["start"], -1), goals], axis=1)

    def _write(rows: Ids, made: list[Any], out: Path) -> None:
        facts = {**dataset.facts, "selection": made}
        write_episodes(out, [dataset.episodes.select(rows)], task, facts)

    earlier = dataset.attributes.get("selection", [])
    return _Rows(dataset, dataset.path, episodes.rows, earlier, _columns, _shared, _write)


def _families_and_ropes(points: Array, ropes: Ids) -> Ids:
    """Number near-duplicates and, with other numbers, the ropes that rows are frames of."""
    rope = np.unique(ropes, axis=0, return_inverse=True)[1].ravel()
    return np.stack([families(points), len(points) + rope], axis=1)


def _single_of(dataset: EpisodeDataset) -> Ids:
    """Return which of `task.singles` each episode is of, by the crossings of its start and goal.

    A recording doesn't hold the start's crossings, so there the first with the goal's is returned.
    """
    rows, steps = dataset.episodes
    sides = [single.sides for single in dataset.task.singles]
    if "setup" in rows:
        return np.array([sides.index(task.sides) for task in dataset.tasks])[rows["setup"]]
    goals = np.count_nonzero(rows["goal_visits"], axis=1) // 2
    first = dataset.episodes.offsets[:-1]
    starts = steps["crossings"][first] if "crossings" in steps else np.full(len(first), -1)
    return np.argmin([2 * (goals != goal) + (starts != start) for start, goal in sides], axis=0)


def _require(out: Path, given: _Rows, source: Path, overwrite: bool) -> None:
    pictures = not isinstance(given.data, (States, EpisodeDataset))
    require_file(out, [source], overwrite, pictures=pictures)


def _write_rows(
    given: _Rows, source: str, rows: Ids, how: Mapping[str, Any], out: Path, overwrite: bool = False
) -> Path:
    """Write some rows, at least one, as a new file; return its path."""
    if not len(rows):
        raise InvalidInput(f"none of the {given.size} rows of {source} is left")
    _require(out, given, resolve(source), overwrite)
    counts = {"sha256": sha256(given.digested), "rows": given.size, "kept": len(rows)}
    made = {"from": source, **counts, **how, "knotgym": knotgym.__version__}
    with atomic_write(out, overwrite=overwrite) as path:
        given.write(rows, [*given.earlier, made], path)
    return out


def _shares(parts: str) -> dict[str, float]:
    words = [_PART.fullmatch(word.strip()) for word in parts.split(",")]
    shares = {word[1]: float(word[2]) for word in words if word}
    if len({*map(str.casefold, shares)}) < len(words):  # some disks take both for one name
        raise InvalidInput(f"parts are such as train=0.8,val=0.2, got {parts!r}")
    if len(shares) < 2 or min(shares.values()) <= 0 or abs(sum(shares.values()) - 1) > 1e-6:
        raise InvalidInput(f"parts are at least 2 fractions above 0 that add up to 1, got {shares}")
    return shares


def _groups(shared: Ids) -> Ids:
    """Number the groups of rows that share a number, directly or by way of others, from 0."""
    row, column = np.nonzero(shared >= 0)
    key = np.unique(shared[row, column], return_inverse=True)[1]
    group, before = np.arange(len(shared)), np.full(len(shared), -1)
    while (group != before).any():  # each row takes the lowest number among those it shares with
        before, lowest = group.copy(), np.full(len(row), len(shared))
        np.minimum.at(lowest, key, group[row])
        np.minimum.at(group, row, lowest[key])
    return np.unique(group, return_inverse=True)[1]


def _dealt(groups: Ids, shares: Sequence[float], rng: np.random.Generator) -> Ids:
    """Return the part of each row: the largest groups first, each where the most is missing."""
    sizes = np.bincount(groups)
    missing = np.array(shares) * len(groups)
    order = rng.permutation(len(sizes))
    part = np.zeros(len(sizes), dtype=np.int64)
    for group in order[np.argsort(-sizes[order], kind="stable")]:
        part[group] = int(missing.argmax())
        missing[part[group]] -= sizes[group]
    return part[groups]


def _matching_rows(text: str, columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return which rows fulfil a condition: bool (n,).

    Args:
        text: the condition.
        columns: name -> one value per row: truth values, numbers or text. A column with a dot in
            its name, such as quality.clearance, may be named by its last word if that is unique.

    Raises:
        InvalidInput: the text is no condition or names no column; the message is one line.
        MissingExtra: polars isn't installed.
    """
    polars = MissingExtra.imported("polars", "select", "a condition")
    words = [name.rpartition(".")[2] for name in columns]
    named = zip(words, columns.values(), strict=True)
    short = {word: values for word, values in named if words.count(word) == 1}
    frame = polars.DataFrame({**short, **columns}, nan_to_null=True)
    if len(text) > _LONGEST or _QUERY.search(_QUOTED.sub("", text)):
        raise _refused(text, f"it must be a condition of up to {_LONGEST} characters, not a query")
    try:
        condition = polars.sql_expr(text)
        if _compares_truth(condition, frame):
            raise _refused(text, "it compares a truth value with a number; join conditions by and")
        fulfilled = frame.select(condition).to_series()
    except polars.exceptions.ColumnNotFoundError as error:
        raise _refused(text, f"columns are {', '.join(columns)}") from error
    except polars.exceptions.PolarsError as error:
        raise _refused(text, str(error).split("\n")[0]) from error
    if fulfilled.dtype != polars.Boolean or len(fulfilled) != len(frame):
        gives = f"it gives {fulfilled.dtype}, and should be true or false for each row"
        raise _refused(text, gives)
    return np.asarray(fulfilled.fill_null(False).to_numpy(), dtype=bool)


def _compares_truth(expression: Any, frame: Any) -> bool:
    """Whether a part is of truth values and numbers, as of 1 < nx < 4, which is always true."""
    inputs = expression.meta.pop()
    kinds = [frame.select(part).to_series().dtype for part in inputs]
    mixed = "Boolean" in map(str, kinds) and any(kind.is_numeric() for kind in kinds)
    return mixed or any(_compares_truth(part, frame) for part in inputs)


def _refused(text: str, why: str) -> InvalidInput:
    return InvalidInput(one_line(f"not a condition, {text[:200]!r}: {why}"))
