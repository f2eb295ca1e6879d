"""Select, split and delete rows of a dataset: states, episodes or pictures.

The result is a file of rows: a state file, an episode file or a Parquet file; or, of episodes, a
Minari dataset. It has under "selection" the sources and the conditions. Pictures and pulls are
copied, not made again.
"""

import re
from collections.abc import Hashable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knotgym.common.atomic_files import atomic_writes
from knotgym.common.errors import InvalidInput
from knotgym.common.streams import Stream, generator
from knotgym.datasets.conditions import matching_rows
from knotgym.datasets.selectable import Destination, Rows, opened, require_target, write_rows

_MOST_ROWS = 10_000_000
_RANGE = re.compile(r"([0-9]{1,12})(?:-([0-9]{1,12}))?")
_PART = re.compile(r"([A-Za-z0-9_]+)=([0-9]{0,9}\.?[0-9]{1,9})")


def select(
    source: str | Path,
    *,
    where: str = "",
    sample: int | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    dataset_id: str = "",
    overwrite: bool = False,
) -> Path:
    """Write the rows that fulfil a condition as a new dataset.

    Args:
        source: a state file, the folder of a run, an included set, a folder or file of pictures, an
            episode file, or the folder or id of a Minari dataset.
        where: a condition on the columns, see `conditions`; "" for all rows.
        sample: keep this many of them, drawn at random; their order stays.
        seed: of the draw.
        out: the new file; with `dataset_id` the Minari root.
        dataset_id: for episodes, the id of the new Minari dataset.

    Returns:
        The new file, or the dataset's folder.

    Raises:
        InvalidInput: `where` isn't a condition on these columns.
        InvalidInput: no row is left, or fewer than `sample` are.
        Occupied: the output exists.
    """
    given = opened(source)
    chosen = matching_rows(where, given.columns) if where else np.ones(len(given.ids), dtype=bool)
    rows = np.flatnonzero(chosen)
    if sample is not None:
        if not 0 < sample <= len(rows):
            raise InvalidInput(f"{len(rows)} rows match, can't sample {sample} of them")
        rows = np.sort(generator(Stream.SELECTION, seed).choice(rows, sample, replace=False))
    how: dict[str, Any] = {"where": where, "sample": sample}
    how = {name: value for name, value in how.items() if value} | ({"seed": seed} if sample else {})
    return write_rows(given, str(source), rows, how, Destination(out, dataset_id, overwrite))


def split(
    source: str | Path,
    parts: str,
    *,
    seed: int = 0,
    out: str | Path | None = None,
    dataset_id: str = "",
    overwrite: bool = False,
) -> list[Path]:
    """Write a dataset as several, by fractions of its rows.

    What belongs together stays together: near-duplicates; rows of one rope;
    episodes with a common start or goal state that has crossings (all start or end in the few plain
    loops). The column `split` isn't changed.

    Args:
        source: as for `select`.
        parts: names and fractions that add up to 1, such as "train=0.8,val=0.2".
        seed: of the random assignment.
        out: as for `select`; "-NAME" is appended to it, before a suffix.
        dataset_id: as for `select`; "-NAME" is inserted before the version.

    Returns:
        The new files, or datasets' folders, in the order of the parts.

    Raises:
        InvalidInput: the parts aren't fractions of 1, or the rows can't be dealt to so many.
        Occupied: an output exists.
    """
    shares = _shares(parts)
    given = opened(source)
    together = _groups(given.keys())
    dealt = _dealt(together, [*shares.values()], generator(Stream.SELECTION, seed, 1))
    if len(set(dealt.tolist())) < len(shares):
        raise InvalidInput(
            f"{source} can't be cut into {len(shares)} parts: its {len(given.ids)} rows share"
            f" starts, goals, walks or near-duplicates, which leaves {together.max() + 1}"
            " separate groups"
        )
    places = []
    for name in shares:
        path = Path(out) if out and not dataset_id else None
        beside = out if path is None else path.with_name(f"{path.stem}-{name}{path.suffix}")
        named = re.sub(r"(?=-v\d+$)", f"-{name}", dataset_id)
        places.append(
            require_target(given, Destination(beside, named, overwrite), [given.digested])
        )
    root = places[0].parents[dataset_id.count("/")]
    names = [place.relative_to(root).as_posix() for place in places]
    with atomic_writes(root, names, overwrite=overwrite) as staged:
        for k, (part, name) in enumerate(zip(shares, names, strict=True)):
            target = Destination(staged, name) if dataset_id else Destination(staged / name)
            how = {"parts": shares, "seed": seed, "part": part}
            write_rows(given, str(source), np.flatnonzero(dealt == k), how, target)
    return places


def delete(
    source: str | Path,
    ids: Sequence[int],
    *,
    out: str | Path | None = None,
    dataset_id: str = "",
    overwrite: bool = False,
) -> Path:
    """Write a dataset without some rows.

    Args:
        source: as for `select`.
        ids: rows of states, numbers of episodes, or `source.row` of pictures.
        out, dataset_id, overwrite: as for `select`.

    Raises:
        InvalidInput: there is no row with an id, or none would be left.
        Occupied: the output exists.
    """
    given = opened(source)
    unknown = sorted({*ids} - {*given.ids.tolist()})
    if unknown:
        raise InvalidInput(f"{source} has no row {', '.join(map(str, unknown[:8]))}")
    left = np.flatnonzero(~np.isin(given.ids, [*ids]))
    how, target = {"deleted": sorted({*ids})}, Destination(out, dataset_id, overwrite)
    return write_rows(given, str(source), left, how, target)


def kept(path: Path) -> str:
    """Say how many rows of its source a selected dataset has."""
    last = opened(path).earlier[-1]
    return f"{last['kept']} of {last['rows']} rows"


def row_numbers(text: str) -> list[int]:
    """Read "3,7-9".

    >>> row_numbers("3,7-9")
    [3, 7, 8, 9]
    """
    out: list[int] = []
    for word in text.split(","):
        found = _RANGE.fullmatch(word.strip())
        first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
        if last < first or last - first > _MOST_ROWS:
            raise InvalidInput(f"rows are numbers such as 3,7-9, got {text!r}")
        out += range(first, last + 1)
    return out


def _shares(parts: str) -> dict[str, float]:
    words = [_PART.fullmatch(word.strip()) for word in parts.split(",")]
    shares = {word[1]: float(word[2]) for word in words if word}
    if len(shares) < len(words):
        raise InvalidInput(f"parts are such as train=0.8,val=0.2, got {parts!r}")
    if len(shares) < 2 or min(shares.values()) <= 0 or abs(sum(shares.values()) - 1) > 1e-6:
        raise InvalidInput(f"parts are at least 2 fractions above 0 that add up to 1, got {shares}")
    return shares


def _groups(keys: Sequence[Sequence[Hashable]]) -> Rows:
    """Number the groups of rows that share keys, directly or by way of others, from 0."""
    root = [*range(len(keys))]

    def find(row: int) -> int:
        while root[row] != row:
            root[row] = root[root[row]]  # halves the path, which keeps the trees flat
            row = root[row]
        return row

    seen: dict[Hashable, int] = {}
    for row, own in enumerate(keys):
        for key in own:
            root[find(row)] = find(seen.setdefault(key, row))
    return np.unique([find(row) for row in range(len(keys))], return_inverse=True)[1]


def _dealt(groups: Rows, shares: Sequence[float], rng: np.random.Generator) -> Rows:
    """Return the part of each row: the largest groups first, each where the most is missing."""
    sizes = np.bincount(groups)
    missing = np.array(shares) * len(groups)
    order = rng.permutation(len(sizes))
    part = np.zeros(len(sizes), dtype=np.int64)
    for group in order[np.argsort(-sizes[order], kind="stable")]:
        part[group] = int(missing.argmax())
        missing[part[group]] -= sizes[group]
    return part[groups]
